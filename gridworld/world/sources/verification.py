"""Whether the tables of a world are what `Mdp` says: of a world that was read or that a user's function made.

Whatever indexes the tables relies on it, so that a damaged file is one sentence and never an error later.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from gridworld.errors import InputError
from gridworld.world.layout import positive_int
from gridworld.world.mdp import Mdp
from gridworld.world.outcomes import Outcomes, checked, thresholds_of

_LONGEST_TEXT = 200
_MOST_PLACES = 2**22  # cells of all panels
_SAME = 1e-9  # how far a threshold may be from the sum of its probabilities


def checked_text(where: str, key: str, value: Any) -> str:
    """A short text on one line; refuses anything else."""
    text = value.item() if isinstance(value, np.ndarray) and value.ndim == 0 else value
    if not isinstance(text, str) or not 0 < len(text) <= _LONGEST_TEXT or not text.isprintable():
        raise InputError(f"{where}: {key} is {str(text)[:50]!r}, must be 1 to {_LONGEST_TEXT} letters")
    return str(text)


def verified(mdp: Mdp, where: str) -> Mdp:
    """The same world, if all of its tables are what `Mdp` says; `where` is what messages call it."""
    for key in ("name", "truth"):
        checked_text(where, key, getattr(mdp, key))
    if not isinstance(mdp.action_names, tuple) or not mdp.action_names:
        raise InputError(f"{where}: action_names is {str(mdp.action_names)[:50]}, must be a tuple of strings")
    for name in mdp.action_names:
        checked_text(where, "action_names", name)
    if mdp.max_episode_steps is not None:
        positive_int(f"{where}: max_episode_steps", mdp.max_episode_steps)
    _check_shapes(mdp, where)
    found = checked(
        where,
        Outcomes(
            next_state=mdp.next_state,
            probability=mdp.probability,
            reward=mdp.reward,
            terminated=np.zeros(mdp.next_state.shape, dtype=np.bool_),
            start=mdp.start,
        ),
    )
    for key in ("next_state", "reward"):
        if not np.array_equal(getattr(found, key), getattr(mdp, key)):
            raise InputError(f"{where}: {key} of an outcome of probability 0 must be 0 or a state")
    _check_ends(mdp, where)
    _check_thresholds(mdp, where)
    _check_numbers(mdp, where)
    if mdp.state_names and len(mdp.state_names) != mdp.num_numbers:
        raise InputError(f"{where}: state_names must be one for each of {mdp.num_numbers} numbers")
    return mdp


def _check_shapes(mdp: Mdp, where: str) -> None:
    shape = np.shape(mdp.next_state)
    size, actions, outcomes = shape if len(shape) == 3 else (0, 0, 0)
    per_state = {"terminal": np.bool_, "goal": np.bool_, "absorbing": np.bool_, "number": np.int64}
    expected: dict[str, tuple[Any, tuple[int, ...]]] = {
        "next_state": (np.int32, (size, len(mdp.action_names), outcomes)),
        "probability": (np.float64, shape),
        "reward": (np.float64, shape),
        "thresholds": (np.float64, (size, actions, max(outcomes - 1, 0))),
        "start": (np.float64, (size,)),
        **{name: (dtype, (size,)) for name, dtype in per_state.items()},
    }
    if mdp.places is not None:
        expected["places"] = (np.int64, (size, 3))
    for name, (dtype, wanted) in expected.items():
        table = getattr(mdp, name)
        if not isinstance(table, np.ndarray) or table.dtype != dtype or table.shape != wanted:
            told = f"{table.dtype} {table.shape}" if isinstance(table, np.ndarray) else type(table).__name__
            raise InputError(f"{where}: {name} is {told}, must be {np.dtype(dtype)} {wanted}")
    shown = mdp.own_observation
    if shown is not None and (
        not isinstance(shown, np.ndarray) or shown.dtype.kind not in "biuf" or shown.shape[:1] != (size,)
    ):
        raise InputError(f"{where}: own_observation must be numbers, the first of its axes {size} states")


def _check_ends(mdp: Mdp, where: str) -> None:
    own = np.arange(mdp.num_states)[:, None, None]
    possible = mdp.probability > 0
    stays = (~possible | (mdp.next_state == own)).all(axis=(1, 2))
    unpaid = (~possible | (mdp.reward == 0)).all(axis=(1, 2))
    _refuse(mdp, where, mdp.terminal & ~mdp.absorbing, "is terminal and not absorbing")
    _refuse(mdp, where, mdp.absorbing & ~(stays & unpaid), "is absorbing and goes on, or pays")
    _refuse(mdp, where, mdp.goal & ~mdp.terminal, "is a goal and not terminal")
    _refuse(mdp, where, mdp.terminal & (mdp.start > 0), "is terminal and a start")


def _check_thresholds(mdp: Mdp, where: str) -> None:
    if not mdp.thresholds.size:
        return
    sums = thresholds_of(mdp.probability)
    last = np.isinf(sums)  # behind the last possible outcome
    near = np.abs(np.where(last, 0.0, mdp.thresholds - np.where(last, 0.0, sums))) <= _SAME
    fine = np.where(last, mdp.thresholds >= 1 - _SAME, near)
    fine[:, :, 1:] &= mdp.thresholds[:, :, 1:] >= mdp.thresholds[:, :, :-1]
    _refuse(mdp, where, ~fine.all(axis=(1, 2)), "has thresholds that are not the sums of its probabilities")


def _check_numbers(mdp: Mdp, where: str) -> None:
    wrong = (mdp.number < 0) | (mdp.number >= mdp.num_states)
    _refuse(mdp, where, wrong, f"has a number that is not from 0 to {mdp.num_states - 1}")
    if mdp.places is not None:
        _refuse(mdp, where, (mdp.places < -1).any(axis=1), "has a place below -1")
        panels, rows, cols = (int(most) + 1 for most in mdp.places.max(axis=0))
        if panels * rows * cols > _MOST_PLACES:
            raise InputError(
                f"{where}: places are {panels:,} panels of {rows:,} rows and {cols:,} columns; pictures have "
                f"room for {_MOST_PLACES:,} cells"
            )


def _refuse(mdp: Mdp, where: str, wrong: Any, told: str) -> None:
    if wrong.any():
        raise InputError(f"{where}: state {int(np.argmax(wrong))} {told}")
