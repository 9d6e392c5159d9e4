"""What the pictures of a run are drawn from, and how the function that draws one is found.

Which pictures there are is declared in `gridworld.config.train`. Each names a function of this package
that takes a `Subject` and returns a `Draw`.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray

from gridworld.base.serialization import State
from gridworld.config.train import TrainConfig
from gridworld.envs.rendering import Frame
from gridworld.visualization.animation import Animation
from gridworld.world.evaluation import Evaluator, PolicySnapshot

_MOST = 48  # moments of a history
_MOST_NUMBERS = 5_000_000  # of all moments together: some 25 MB

# A picture for a cell size in pixels; None: the picture's own.
Draw = Callable[[int | None], Frame | Animation]


@dataclass(frozen=True, eq=False)
class Moment:
    """What is kept of an evaluation."""

    step: int
    values: NDArray[np.float32]  # (S,)
    greedy: NDArray[np.uint8]  # (S,)


class PolicyHistory:
    """Every evaluation of a short training, every second, fourth, ... of a long one, and always the last."""

    def __init__(self, num_states: int) -> None:
        self._most = max(4, min(_MOST, _MOST_NUMBERS // num_states))
        self._every = 1
        self._seen = 0
        self._kept: list[Moment] = []
        self._last: Moment | None = None

    def add(self, step: int, snapshot: PolicySnapshot) -> None:
        """Take in one more evaluation, after `step` environment steps."""
        self._last = Moment(step, snapshot.values.astype(np.float32), snapshot.greedy.astype(np.uint8))
        if self._seen % self._every == 0:
            if len(self._kept) == self._most:
                del self._kept[1::2]
                self._every *= 2
            if self._seen % self._every == 0:
                self._kept.append(self._last)
        self._seen += 1

    def moments(self) -> list[Moment]:
        """The kept evaluations from the first to the last, at most 49."""
        if self._last is None or (self._kept and self._kept[-1] is self._last):
            return list(self._kept)
        return [*self._kept, self._last]

    def get_state(self) -> State:
        """The kept evaluations, and how many were seen."""
        moments = self.moments()
        return {
            "every": self._every,
            "seen": self._seen,
            "kept": len(self._kept),
            "steps": [moment.step for moment in moments],
            "values": [moment.values for moment in moments],
            "greedy": [moment.greedy for moment in moments],
        }

    def set_state(self, state: State) -> None:
        """Continue from a state."""
        columns = state["steps"], state["values"], state["greedy"]
        moments = [Moment(*moment) for moment in zip(*columns, strict=True)]
        self._every, self._seen = int(state["every"]), int(state["seen"])
        self._kept = moments[: state["kept"]]
        self._last = moments[-1] if moments else None


@dataclass(frozen=True, eq=False)
class Subject:
    """What pictures are of: an agent after some training in its world."""

    config: TrainConfig
    is_trusted: bool  # whether the environment that the settings name may be made, which runs its code
    evaluator: Evaluator
    snapshot: PolicySnapshot
    steps: int  # environment steps that it was trained for
    visits: NDArray[np.int64] | None  # (S, A), how often it acted so while it learned; None: not known
    history: PolicyHistory | None = None  # the policy over training, where it was kept


def agents_gamma(subject: Subject) -> float:
    """The discount that the agent learns with; the evaluation's where it has none of its own."""
    return float(getattr(subject.config.agent, "gamma", subject.evaluator.solution.gamma))


def drawer(name: str) -> Callable[[Subject], Draw]:
    """The function `module.function` of this package. It computes once what does not depend on the size."""
    module, _, function = name.partition(".")
    return cast(
        "Callable[[Subject], Draw]", getattr(importlib.import_module(f"{__package__}.{module}"), function)
    )
