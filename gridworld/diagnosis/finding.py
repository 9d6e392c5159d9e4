"""What a cause comes to for one run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gridworld.diagnosis.evidence import Evidence
from gridworld.world.mdp import BoolArray


@dataclass(frozen=True, eq=False)
class Finding:
    """One cause, as a run shows it.

    Attributes:
        cause: its name.
        states: (S,), bool, where it explains an error.
        why: what was found, the end of a sentence.
        changes: words for a command line, the best first.
    """

    cause: str
    states: BoolArray
    why: str
    changes: tuple[str, ...]


Cause = Callable[[Evidence], Finding | None]  # None: it is not this run's


def costliest(run: Evidence, states: BoolArray) -> int:
    """The state of these (S,) whose error costs most."""
    return int(np.argmax(np.where(states, run.split.cost, -np.inf)))


def slower(run: Evidence) -> tuple[str, ...]:
    """Words for smaller learning rates."""
    rate = run.setting("learning_rate")
    return tuple(run.change("learning_rate", rate / by) for by in (10, 100))


def faster(run: Evidence) -> tuple[str, ...]:
    """Words for a larger learning rate and for a longer run."""
    rate = run.change("learning_rate", min(10 * run.setting("learning_rate"), 1.0))
    return rate, longer(run, 4)


def longer(run: Evidence, times: int) -> str:
    """The word for a run so many times as long."""
    return f"total_timesteps={times * run.config.total_timesteps}"
