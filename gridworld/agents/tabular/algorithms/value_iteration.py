"""The exact optimum as an agent, for comparison with agents that learn.

It is solved for when it is built (`gridworld.world.exact.solver`), so training takes no environment step,
and the run's certificate stands at step 0.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from gridworld.agents import PolicySnapshot, TrainingContext
from gridworld.agents.tabular.model_file import model_bytes, read_model
from gridworld.agents.tabular.settings import TabularConfig
from gridworld.config.fields import Word, privilege
from gridworld.errors import InputError
from gridworld.storage.serialization import State
from gridworld.world.exact.solver import value_iteration
from gridworld.world.mdp import BoolArray, FloatArray


@dataclass
class ValueIterationConfig(TabularConfig):
    """The exact optimum under `gamma`; nothing is trained."""

    name: Word = "value_iteration"
    algorithm: Word = field(
        default="value_iteration", metadata=privilege("plans with the tables", "value_iteration")
    )


class ValueIteration:
    """Q* under the agent's own discount.

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
                f"agent.gamma={config.gamma}: from {worst} no end can be reached, "
                "which costs without end; take a gamma below 1"
            )
        self._algorithm = config.algorithm
        self.q: FloatArray = solution.q
        self.optimal: BoolArray = solution.optimal

    @property
    def model(self) -> FloatArray:
        """Q*."""
        return self.q

    def learn(
        self,
        total_timesteps: int,
        on_step: Callable[[int], int],
        on_safe_point: Callable[[int], None] | None = None,
        state: State | None = None,
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
        """See `gridworld.agents.Agent.model_file`."""
        return model_bytes(self._algorithm, {"q": self.q, "optimal": self.optimal})

    def load(self, path: Path) -> None:
        """See `gridworld.agents.Agent.load`."""
        arrays = read_model(path, self._algorithm, {"q": self.q, "optimal": self.optimal})
        if not arrays["optimal"].any(axis=1).all():
            raise InputError(f"{path}: optimal names no action in some states")
        self.q, self.optimal = arrays["q"], arrays["optimal"]


SCHEMA = ValueIterationConfig
AGENT = ValueIteration
