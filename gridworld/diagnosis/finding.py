"""What a cause comes to for one run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gridworld.config.agents import LINEAR
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
    return tuple(run.multiplied("learning_rate", by) for by in (0.1, 0.01))


def falling(run: Evidence) -> tuple[str, ...]:
    """The word for a learning rate that falls to 0; none where it does."""
    if run.falls("learning_rate"):
        return ()
    return (run.change("learning_rate", f"{LINEAR}{run.setting('learning_rate'):g}"),)


def faster(run: Evidence) -> tuple[str, ...]:
    """Words for a larger learning rate and for a longer run."""
    return run.multiplied("learning_rate", 10, most=1.0), longer(run, 4)


def longer(run: Evidence, times: int) -> str:
    """The word for a run so many times as long."""
    return f"total_timesteps={times * run.config.total_timesteps}"
