"""Tabular agents: Q-learning, SARSA, expected SARSA, and the exact optimum.

Nothing here needs more than numpy: a run of these agents never imports torch.
"""

from gridworld.agents.tabular.algorithms import SCHEMAS

__all__ = ["SCHEMAS"]
