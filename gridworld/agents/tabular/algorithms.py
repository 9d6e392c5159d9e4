"""The tabular algorithms: settings and a class each, in `ALGORITHMS` by what `agent.algorithm` calls them.

A new one is two such classes and a row there, and a yaml in `conf/agent` that chooses its schema.

Reference: R. Sutton and A. Barto, Reinforcement Learning, 2nd ed., 2018, sections 6.4 to 6.6.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gridworld.agents import Hook, PolicySnapshot, SafePoint, TrainingContext
from gridworld.agents.tabular.td_control import (
    TabularConfig,
    TabularControl,
    TabularControlConfig,
    epsilon_greedy,
    model_bytes,
    read_model,
)
from gridworld.config.fields import Word, privilege
from gridworld.errors import InputError
from gridworld.storage.serialization import State
from gridworld.world.mdp import BoolArray, FloatArray, IntArray
from gridworld.world.solver import value_iteration

if TYPE_CHECKING:
    from gridworld.envs.vector_env import Ended


@dataclass
class QLearningConfig(TabularControlConfig):
    name: Word = "q_learning"
    algorithm: Word = "q_learning"


class QLearning(TabularControl):
    """Off-policy: Q(s, a) moves towards r + γ max_b Q(s', b), so it estimates Q of the greedy policy.

    C. Watkins, Learning from delayed rewards, 1989; C. Watkins and P. Dayan, Q-learning, 1992.
    """

    def state_values(self, q: FloatArray) -> FloatArray:
        """max_a Q(s, a), whatever epsilon is."""
        best: FloatArray = q.max(axis=-1)
        return best


@dataclass
class ExpectedSarsaConfig(TabularControlConfig):
    name: Word = "expected_sarsa"
    algorithm: Word = "expected_sarsa"


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
class SarsaConfig(TabularControlConfig):
    name: Word = "sarsa"
    algorithm: Word = "sarsa"


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
        ahead: FloatArray = self.q[reached, self._drawn]
        return ahead

    def _next_actions(self, states: IntArray, ended: Ended | None) -> IntArray:
        if ended is not None:
            self._drawn[ended.which] = self._act(states[ended.which])
        return self._drawn


@dataclass
class ValueIterationConfig(TabularConfig):
    """The exact optimum under `gamma`; nothing is trained."""

    name: Word = "value_iteration"
    algorithm: Word = field(
        default="value_iteration", metadata=privilege("plans with the tables", "value_iteration")
    )


class ValueIteration:
    """Q* under the agent's own discount, solved for when it is built, for comparison with what learns.

    Attributes:
        q: (S, A), Q*.
        optimal: (S, A), True for every action as good as the best.
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
        self._algorithm = config.algorithm
        self.q: FloatArray = solution.q
        self.optimal: BoolArray = solution.optimal

    @property
    def model(self) -> FloatArray:
        return self.q

    def learn(
        self, total_timesteps: int, on_step: Hook, on_safe_point: SafePoint = None, state: State | None = None
    ) -> None:
        """See `gridworld.agents.Agent.learn`. Nothing is left to learn: 0 steps."""
        on_step(0)

    def class_without_state(self) -> None:
        """See `gridworld.agents.Agent.class_without_state`."""

    def get_state(self) -> State:
        """See `gridworld.agents.Agent.get_state`. There is none: it is solved for again."""
        return {}

    def snapshot(self) -> PolicySnapshot:
        """Greedy is the first of the optimal actions; the sampled policy takes any of them."""
        return PolicySnapshot(
            greedy=self.optimal.argmax(axis=1),
            sampled=self.optimal / self.optimal.sum(axis=1, keepdims=True),
            values=self.q.max(axis=1),
            q=self.q.copy(),
        )

    def model_file(self) -> bytes:
        return model_bytes(self._algorithm, {"q": self.q, "optimal": self.optimal})

    def load(self, path: Path) -> None:
        arrays = read_model(path, self._algorithm, {"q": self.q, "optimal": self.optimal})
        if not arrays["optimal"].any(axis=1).all():
            raise InputError(f"{path}: optimal has no action for some states")
        self.q, self.optimal = arrays["q"], arrays["optimal"]


ALGORITHMS: dict[str, tuple[type[TabularConfig], Any]] = {
    "expected_sarsa": (ExpectedSarsaConfig, ExpectedSarsa),
    "q_learning": (QLearningConfig, QLearning),
    "sarsa": (SarsaConfig, Sarsa),
    "value_iteration": (ValueIterationConfig, ValueIteration),
}
