"""Q-learning: off-policy control.

After a step from (s, a) to reward r and state s', Q(s, a) moves towards r + γ max_b Q(s', b). So it estimates
Q* whatever policy explores.

References: C. Watkins, Learning from delayed rewards, 1989; C. Watkins and P. Dayan, Q-learning, Machine
Learning 8, 1992; R. Sutton and A. Barto, Reinforcement Learning, 2nd ed., 2018, section 6.5.
"""

from __future__ import annotations

from dataclasses import dataclass

from gridworld.agents.tabular.td_control import TabularControl, TabularControlConfig
from gridworld.config.fields import Word
from gridworld.world.mdp import FloatArray


@dataclass
class QLearningConfig(TabularControlConfig):
    """Settings of Q-learning."""

    name: Word = "q_learning"
    algorithm: Word = "q_learning"


class QLearning(TabularControl):
    """Its table estimates Q of the greedy policy."""

    def state_values(self, q: FloatArray) -> FloatArray:
        """max_a Q(s, a), whatever epsilon is."""
        best: FloatArray = q.max(axis=-1)
        return best


SCHEMA = QLearningConfig
AGENT = QLearning
