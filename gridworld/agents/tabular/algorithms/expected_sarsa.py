"""Expected SARSA: on-policy control without the noise of the next action's draw.

After a step from (s, a) to reward r and state s', Q(s, a) moves towards r + γ Σ_b π(b | s') Q(s', b), where π
is the ε-greedy policy of the moment. So it estimates Q of the policy that it explores with.

References: H. van Seijen, H. van Hasselt, S. Whiteson and M. Wiering, A theoretical and empirical analysis of
expected Sarsa, 2009; R. Sutton and A. Barto, Reinforcement Learning, 2nd ed., 2018, section 6.6.
"""

from __future__ import annotations

from dataclasses import dataclass

from gridworld.agents.tabular.epsilon_greedy import expected_value
from gridworld.agents.tabular.td_control import TabularControl, TabularControlConfig
from gridworld.config.fields import Word
from gridworld.world.mdp import FloatArray


@dataclass
class ExpectedSarsaConfig(TabularControlConfig):
    """Settings of expected SARSA."""

    name: Word = "expected_sarsa"
    algorithm: Word = "expected_sarsa"


class ExpectedSarsa(TabularControl):
    """Its table estimates Q of the ε-greedy policy."""

    def state_values(self, q: FloatArray) -> FloatArray:
        """Σ_a π(a | s) Q(s, a) under the ε-greedy π."""
        return expected_value(q, self.exploration_rate)


SCHEMA = ExpectedSarsaConfig
AGENT = ExpectedSarsa
