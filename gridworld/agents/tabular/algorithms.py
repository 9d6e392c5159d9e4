"""The tabular algorithms: a class each, and its settings, which build it.

A new one is two such classes, a row in `SCHEMAS`, and a yaml in `conf/agent` that chooses its schema.

Reference: R. Sutton and A. Barto, Reinforcement Learning, 2nd ed., 2018, sections 6.4 to 6.6.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gridworld.agents import Hook, SafePoint, TrainingContext
from gridworld.agents.tabular.td_control import (
    TabularAgent,
    TabularConfig,
    TabularControl,
    TabularControlConfig,
    epsilon_greedy,
)
from gridworld.base.errors import InputError
from gridworld.base.serialization import State
from gridworld.config.fields import Privilege, Word, setting
from gridworld.config.train import AgentConfig
from gridworld.world.evaluation import PolicySnapshot
from gridworld.world.mdp import BoolArray, FloatArray, IntArray
from gridworld.world.solver import value_iteration

if TYPE_CHECKING:
    from gridworld.envs.vector_env import Step


class QLearning(TabularControl):
    """Off-policy: Q(s, a) moves towards r + γ max_b Q(s', b), so it estimates Q of the greedy policy.

    C. Watkins, Learning from delayed rewards, 1989; C. Watkins and P. Dayan, Q-learning, 1992.
    """

    def state_values(self, q: FloatArray) -> FloatArray:
        """max_a Q(s, a), whatever epsilon is."""
        best: FloatArray = q.max(axis=-1)
        return best


@dataclass
class QLearningConfig(TabularControlConfig):
    name: Word = "q_learning"
    algorithm: Word = "q_learning"

    def build(self, context: TrainingContext) -> QLearning:
        return QLearning(self, context)


class ExpectedSarsa(TabularControl):
    """On-policy, without the noise of the next action's draw: towards r + γ Σ_b π(b | s') Q(s', b).

    H. van Seijen, H. van Hasselt, S. Whiteson and M. Wiering, A theoretical and empirical analysis of
    expected Sarsa, 2009.
    """

    def state_values(self, q: FloatArray) -> FloatArray:
        """Σ_a π(a | s) Q(s, a) under the ε-greedy policy π of the moment."""
        expected: FloatArray = (epsilon_greedy(q, self.exploration_rate) * q).sum(axis=-1)
        return expected


@dataclass
class ExpectedSarsaConfig(TabularControlConfig):
    name: Word = "expected_sarsa"
    algorithm: Word = "expected_sarsa"

    def build(self, context: TrainingContext) -> ExpectedSarsa:
        return ExpectedSarsa(self, context)


class Sarsa(ExpectedSarsa):
    """On-policy: towards r + γ Q(s', a'), where a' is the action that is taken next.

    a' is drawn before the update, as in the book. Where the step limit cuts an episode off, an a' is drawn
    for the target alone. G. Rummery and M. Niranjan, On-line Q-learning using connectionist systems, 1994.
    """

    def __init__(self, config: SarsaConfig, context: TrainingContext) -> None:
        super().__init__(config, context)
        self._drawn = self._actions  # (num_envs,), a' of every environment, drawn for the update

    def _values_ahead(self, reached: IntArray) -> FloatArray:
        self._drawn = self._act(reached)
        return self.q[reached, self._drawn]

    def _next_actions(self, step: Step) -> IntArray:
        if step.which.size:
            self._drawn[step.which] = self._act(step.states[step.which])
        return self._drawn


@dataclass
class SarsaConfig(TabularControlConfig):
    name: Word = "sarsa"
    algorithm: Word = "sarsa"

    def build(self, context: TrainingContext) -> Sarsa:
        return Sarsa(self, context)


class ValueIteration(TabularAgent):
    """Q* under the agent's own discount, solved for when it is built, for comparison with what learns.

    `optimal` (S, A) is True for every action as good as the best.
    """

    def __init__(self, config: ValueIterationConfig, context: TrainingContext) -> None:
        mdp = context.envs.mdp
        solution = value_iteration(mdp, config.gamma)
        if not np.isfinite(solution.q).all():
            worst = mdp.state_name(int(np.argmin(solution.v)))
            raise InputError(
                f"agent.gamma={config.gamma}: no end can be reached from {worst}, which costs infinitely "
                "much; use a gamma below 1"
            )
        self.config, self.q = config, solution.q
        self.optimal: BoolArray = solution.optimal

    def learn(
        self, total_timesteps: int, on_step: Hook, on_safe_point: SafePoint = None, state: State | None = None
    ) -> None:
        on_step(0)  # nothing is left to learn

    def get_state(self) -> State:
        return {}

    def snapshot(self) -> PolicySnapshot:
        """Greedy is the first of the optimal actions; the sampled policy takes any of them."""
        return PolicySnapshot(
            greedy=self.optimal.argmax(axis=1),
            sampled=self.optimal / self.optimal.sum(axis=1, keepdims=True),
            values=self.q.max(axis=1),
            q=self.q.copy(),
        )

    def arrays(self) -> dict[str, NDArray[Any]]:
        return {"q": self.q, "optimal": self.optimal}

    def load(self, path: Path) -> None:
        arrays = self.read(path)
        if not arrays["optimal"].any(axis=1).all():
            raise InputError(f"{path}: optimal has no action for some states")
        self.q, self.optimal = arrays["q"], arrays["optimal"]


@dataclass
class ValueIterationConfig(TabularConfig):
    """The exact optimum under `gamma`; nothing is trained."""

    name: Word = "value_iteration"
    algorithm: Word = setting("value_iteration", Privilege("plans with the tables", "value_iteration"))

    def build(self, context: TrainingContext) -> ValueIteration:
        return ValueIteration(self, context)


SCHEMAS: dict[str, type[AgentConfig]] = {
    "expected_sarsa": ExpectedSarsaConfig,
    "q_learning": QLearningConfig,
    "sarsa": SarsaConfig,
    "value_iteration": ValueIterationConfig,
}
