"""SARSA: on-policy control.

After a step from (s, a) to reward r and state s', Q(s, a) moves towards r + γ Q(s', a'), where a' is the
action that is taken next. So it estimates Q of the policy that it explores with. a' is drawn before the
update, as in the book. Where the step limit cuts an episode off, an a' is drawn for the target alone.

References: G. Rummery and M. Niranjan, On-line Q-learning using connectionist systems, 1994; R. Sutton and
A. Barto, Reinforcement Learning, 2nd ed., 2018, section 6.4.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from gridworld.agents import TrainingContext
from gridworld.agents.tabular.epsilon_greedy import expected_value
from gridworld.agents.tabular.td_control import TabularControl, TabularControlConfig
from gridworld.config.fields import Word
from gridworld.world.mdp import FloatArray, IntArray

if TYPE_CHECKING:
    from gridworld.envs.vector_env import Ended


@dataclass
class SarsaConfig(TabularControlConfig):
    """Settings of SARSA."""

    name: Word = "sarsa"
    algorithm: Word = "sarsa"


class Sarsa(TabularControl):
    """Its table estimates Q of the ε-greedy policy."""

    def __init__(self, config: SarsaConfig, context: TrainingContext) -> None:
        super().__init__(config, context)
        self._drawn = self._actions  # (num_envs,), a' of every environment, drawn for the update

    def state_values(self, q: FloatArray) -> FloatArray:
        """Σ_a π(a | s) Q(s, a) under the ε-greedy π."""
        return expected_value(q, self.exploration_rate)

    def _values_ahead(self, reached: IntArray) -> FloatArray:
        self._drawn = self._act(reached)
        ahead: FloatArray = self.q[reached, self._drawn]
        return ahead

    def _next_actions(self, states: IntArray, ended: Ended | None) -> IntArray:
        if ended is not None:
            self._drawn[ended.which] = self._act(states[ended.which])
        return self._drawn


SCHEMA = SarsaConfig
AGENT = Sarsa
