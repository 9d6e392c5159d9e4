"""What a cause comes to for one run."""

from __future__ import annotations

import math
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


ADAM = "torch.optim.Adam"
_ENOUGH = {False: 3000, True: 500}  # updates, by whether it is an actor-critic
_MEETINGS = 10  # of a random walk with the goal
_FAR = 10  # times the learning rate
_MOST = 100  # times as long

Cause = Callable[[Evidence], Finding | None]  # None: it is not this run's


def costliest(run: Evidence, states: BoolArray) -> int:
    """The state of these (S,) whose error costs most."""
    return int(np.argmax(np.where(states, run.split.cost, -np.inf)))


def slower(run: Evidence) -> tuple[str, ...]:
    """Words for smaller learning rates: of a network, first the usual one where its own is above it."""
    first = min(0.1, run.usual_rate / max(run.setting("learning_rate"), 1e-300))
    return tuple(run.multiplied("learning_rate", by) for by in (first, first / 10))


def falling(run: Evidence) -> tuple[str, ...]:
    """The word for a learning rate that falls to 0; none where it does."""
    if run.falls("learning_rate"):
        return ()
    rate = run.setting("learning_rate")
    return (
        run.change("learning_rate", f"{LINEAR}{rate if run.is_tabular else min(rate, run.usual_rate):g}"),
    )


def faster(run: Evidence) -> tuple[str, ...]:
    """Words for a network that learns too slowly: what scales its steps, the usual rate, and a longer run."""
    adam = (run.change("policy_kwargs.optimizer_class", ADAM),) if run.has_plain_steps else ()
    by = run.usual_rate / max(run.setting("learning_rate"), 1e-300)
    return *adam, *((run.multiplied("learning_rate", by),) if by > 2 else ()), longer(run, 4)


def longer(run: Evidence, times: int) -> str:
    """The words for a run at least so many times as long: for enough updates, and to meet the goal often.

    At a learning rate far below the usual one no length helps, so that changes too.
    """
    total = run.config.total_timesteps
    updates = 1.0 if run.is_tabular else _ENOUGH[run.is_actor_critic] / max(run.updates, 1.0)
    goals = _MEETINGS * run.steps_to_goal / total if np.isfinite(run.steps_to_goal) else 1.0
    word = f"total_timesteps={total * max(times, math.ceil(min(max(updates, goals), _MOST)))}"
    by = run.usual_rate / max(run.setting("learning_rate", 1.0), 1e-300)
    return f"{word} {run.multiplied('learning_rate', by)}" if by > _FAR else word
