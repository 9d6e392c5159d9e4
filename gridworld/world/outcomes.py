"""A world from outcomes that end episodes, and the checks of a world's tables.

Sources of worlds say of an outcome that it ends the episode, and where it leads: a state with a number that
agents see. Here such a transition leads to a terminal state: the state with this number, where nothing but
ends leads there; otherwise a further state, which shows the same number. An end is a goal if it pays as much
as the best of all ends that can be reached, unless the source says itself which are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gridworld.base.bounds import positive_int
from gridworld.base.errors import InputError
from gridworld.base.user_input import check_memory
from gridworld.world.mdp import (
    LEAST_REWARD,
    MOST_REWARD,
    BoolArray,
    FloatArray,
    IntArray,
    Mdp,
    checked_reward,
    frozen,
    resting_states,
    steps_from,
    taken,
)
from gridworld.world.shown import misfit

MOST_ACTIONS = 256
MOST_STATES = 1024 * 1024
_ROUNDING = 1e-9  # how far a sum of probabilities may be from 1
_BYTES = 96  # of an outcome in all tables, and while they are made and solved
_MOST_BYTES = 4 * 2**30
_LONGEST_TEXT = 200
_MOST_PLACES = 2**22  # cells of all panels


@dataclass(frozen=True, eq=False, kw_only=True)
class Outcomes:
    """What a source says: N numbered states, A actions, K outcomes of each.

    Attributes:
        next_state: (N, A, K), integers, the number of the state that follows.
        probability: (N, A, K), float64; 0 for an outcome that does not exist.
        reward: (N, A, K), float64.
        terminated: (N, A, K), bool, whether the outcome ends the episode.
        start: (N,), float64, a distribution.
        success: (N, A, K), bool, which ends are goals; None: those that pay best.
    """

    next_state: IntArray
    probability: FloatArray
    reward: FloatArray
    terminated: BoolArray
    start: FloatArray
    success: BoolArray | None = None


def mdp_from_outcomes(
    name: str,
    outcomes: Outcomes,
    *,
    action_names: Sequence[str] | None = None,
    places: IntArray | None = None,
    panel_names: Sequence[str] = (),
    max_episode_steps: int | None = None,
    own_observation: Any = None,
    own_space: Any = None,
) -> Mdp:
    """Compile what a source says into a world, whose states 0 to N - 1 are the numbered ones.

    `action_names` None: their numbers; `places` (N, 3), `own_observation` (N, *shape): see `Mdp`. Refuses
    shapes that do not fit, no probabilities, numbers of no state, or too many of them.
    """
    outcomes = checked(name, outcomes)
    _check_extras(name, outcomes, action_names, places, max_episode_steps)
    if own_observation is not None and (wrong := misfit(own_space, own_observation, len(outcomes.start))):
        raise InputError(f"{name}: own_observation {wrong}")
    ends, success, number, leads_to = _ends(outcomes)
    size, actions, count = len(number), *outcomes.next_state.shape[1:]
    numbered, further = slice(0, len(outcomes.start)), len(number) - len(outcomes.start)
    terminal, goal = np.zeros(size, dtype=np.bool_), np.zeros(size, dtype=np.bool_)
    terminal[ends] = True
    goal[ends] = success

    next_state = np.empty((size, actions, count), dtype=np.int32)
    probability, reward = np.zeros(next_state.shape), np.zeros(next_state.shape)
    next_state[numbered], reward[numbered] = leads_to, outcomes.reward
    probability[numbered] = outcomes.probability
    next_state[terminal] = np.flatnonzero(terminal)[:, None, None]
    probability[terminal] = np.eye(count)[0]
    reward[terminal] = 0.0
    reward[probability == 0] = 0.0
    names = tuple(action_names) if action_names is not None else tuple(map(str, range(actions)))
    return Mdp(
        name=name,
        action_names=names,
        next_state=frozen(next_state),
        probability=frozen(probability),
        reward=frozen(reward),
        terminal=frozen(terminal),
        goal=frozen(goal),
        start=frozen(np.concatenate([outcomes.start, np.zeros(further)])),
        number=frozen(number),
        places=None if places is None else frozen(places[number].astype(np.int64)),
        panel_names=tuple(panel_names),
        max_episode_steps=None if max_episode_steps is None else int(max_episode_steps),
        own_observation=frozen(taken(own_observation, number)),
        own_space=own_space,
    )


def _ends(outcomes: Outcomes) -> tuple[IntArray, BoolArray, IntArray, IntArray]:
    """The terminal states that outcomes need.

    Returns (E,), the terminal states, and which of them are goals; (S,), the number of every state: of the N
    numbered ones, then of further ends; (N, A, K), the state that each outcome leads to.
    """
    size, possible = len(outcomes.start), outcomes.probability > 0
    going_on = possible & ~outcomes.terminated
    playing = steps_from(np.flatnonzero(outcomes.start), outcomes.next_state, going_on) >= 0
    ending = possible & outcomes.terminated
    first = ending & playing[:, None, None]
    success = outcomes.success
    if success is None:
        here = np.arange(size)[:, None, None]
        # Where an episode begins at its end, the step that says so pays nothing, and is compared with none.
        over = ((outcomes.terminated & (outcomes.next_state == here)) | ~possible).all(axis=(1, 2))
        paid = first & ~over[:, None, None] if (first[~over]).any() else first
        success = outcomes.reward == outcomes.reward[paid].max(initial=-np.inf)
        reached = np.isin(np.arange(size), outcomes.next_state[paid & success])
        success = np.where(over[:, None, None] & ~paid, reached[:, None, None], success)
    # An end is known by its number and whether it is a success: the last bit of its key.
    every = 2 * outcomes.next_state.astype(np.int64) + success
    keys = np.unique(every[first])
    others = np.unique(every[ending & ~first])  # what nobody reaches needs no end of its own
    others = others[~np.isin(others // 2, keys // 2)]
    others = others[~(np.isin(others ^ 1, others) & (others % 2 == 1))]
    keys = np.sort(np.concatenate([keys, others]))
    number = keys // 2
    taken = playing[number]
    taken[1:] |= number[1:] == number[:-1]
    states: IntArray = np.where(taken, size - 1 + np.cumsum(taken), number)
    leads_to = outcomes.next_state.astype(np.int64)
    key = every[ending]
    leads_to[ending] = states[np.searchsorted(keys, np.where(np.isin(key, keys), key, key ^ 1))]
    return states, keys % 2 == 1, np.concatenate([np.arange(size), number[taken]]), leads_to


def check_size(name: str, states: int, actions: int, outcomes: int) -> None:
    """Refuse tables that are too large; call it before they are allocated."""
    if states > MOST_STATES or actions > MOST_ACTIONS:
        raise InputError(
            f"{name}: {states:,} states and {actions:,} actions are too many; at most {MOST_STATES:,} "
            f"states and {MOST_ACTIONS} actions can be solved"
        )
    size = states * actions * outcomes * _BYTES
    if size > _MOST_BYTES:
        raise InputError(
            f"{name}: {states:,} states, {actions:,} actions and {outcomes:,} outcomes of each would take "
            f"{size / 2**30:,.1f} GiB of memory; at most {_MOST_BYTES / 2**30:.0f} GiB can be solved"
        )
    check_memory(name, size)


_NUMBERS, _WHOLE, _BOOLEANS = ("fiu", "numbers"), ("iu", "whole numbers"), ("b", "booleans")
_KINDS = {  # of arrays, as numpy's `dtype.kind` names them
    "next_state": _WHOLE,
    "probability": _NUMBERS,
    "reward": _NUMBERS,
    "terminated": _BOOLEANS,
    "success": _BOOLEANS,
    "start": _NUMBERS,
}


def checked(name: str, outcomes: Outcomes) -> Outcomes:
    """Outcomes of any kind of numbers, checked and converted to float64 and int64.

    What is impossible may lead anywhere and pay anything. Less precise probabilities are made to sum to 1.
    """
    _check_kinds(name, outcomes)
    start = _distribution(name, "start", outcomes.start[None])[0]
    probability = _distribution(name, "probability", outcomes.probability)
    possible = probability > 0
    here = np.arange(len(start))[:, None, None]
    leads_to = outcomes.next_state.astype(np.int64)
    exists = (leads_to >= 0) & (leads_to < len(start))
    reward = np.where(possible, outcomes.reward.astype(np.float64), 0.0)
    for row in np.argwhere(possible & ~exists)[:1]:
        raise InputError(
            f"{name}: next_state of state {row[0]}, action {row[1]} is {leads_to[tuple(row)]}, "
            f"must be from 0 to {len(start) - 1}"
        )
    size = np.abs(reward)
    for row in np.argwhere((reward != 0) & ~((size >= LEAST_REWARD) & (size <= MOST_REWARD)))[:1]:
        checked_reward(f"{name}: reward of state {row[0]}, action {row[1]}", float(reward[tuple(row)]))
    return replace(
        outcomes,
        next_state=np.where(exists, leads_to, here),
        probability=probability,
        start=start,
        reward=reward,
    )


def _distribution(name: str, what: str, given: NDArray[Any]) -> FloatArray:
    """Probabilities along the last axis as float64; less precise ones are made to sum to 1."""
    table: FloatArray = np.asarray(given, dtype=np.float64)
    inexact = given.dtype.kind == "f" and given.dtype.itemsize < table.itemsize
    most = max(_ROUNDING, table.shape[-1] * float(np.finfo(given.dtype).eps)) if inexact else _ROUNDING
    wrong = ~((table >= 0).all(axis=-1) & (np.abs(table.sum(axis=-1) - 1) <= most))
    for where in np.argwhere(wrong)[:1]:
        row = table[tuple(where)]
        place = "" if what == "start" else f" of state {where[0]}, action {where[1]}"
        shown = ", ".join([f"{each:.6g}" for each in row[:8]] + ["..."] * (len(row) > 8))
        raise InputError(
            f"{name}: {what}{place} is [{shown}], with sum {row.sum():.12g}; must be probabilities with sum 1"
        )
    return table / table.sum(axis=-1, keepdims=True) if inexact else table


def _check_kinds(name: str, outcomes: Outcomes) -> None:
    given = {what: getattr(outcomes, what) for what in _KINDS}
    if outcomes.success is None:
        del given["success"]
    for what, table in given.items():
        kinds, words = _KINDS[what]
        if not isinstance(table, np.ndarray) or table.dtype.kind not in kinds:
            raise InputError(f"{name}: {what} is {_described(table)}, must be an array of {words}")
    shape = outcomes.next_state.shape
    if len(shape) != 3 or 0 in shape:
        raise InputError(f"{name}: next_state has shape {shape}, must be (states, actions, outcomes)")
    for what, table in given.items():
        wanted = shape[:1] if what == "start" else shape
        if table.shape != wanted:
            raise InputError(
                f"{name}: {what} has shape {table.shape}, next_state has {shape}; must be {wanted}"
            )
    check_size(name, *shape)


def _described(table: Any) -> str:
    return f"{table.dtype} {table.shape}" if isinstance(table, np.ndarray) else type(table).__name__


def _check_extras(
    name: str, outcomes: Outcomes, names: Sequence[str] | None, places: Any, limit: Any
) -> None:
    size, actions = outcomes.next_state.shape[:2]
    if names is not None and len(names) != actions:
        raise InputError(f"{name}: {len(names)} action_names for {actions} actions; give one for each")
    if places is not None and (places.shape != (size, 3) or places.dtype.kind not in "iu"):
        raise InputError(
            f"{name}: places is {places.dtype} {places.shape}, must be whole numbers ({size}, 3): panel, "
            "row and column per state"
        )
    if limit is not None:
        positive_int(f"{name}: max_episode_steps", limit)


def checked_text(where: str, key: str, value: Any) -> str:
    """A short text on one line; refuses anything else."""
    text = value.item() if isinstance(value, np.ndarray) and value.ndim == 0 else value
    if not isinstance(text, str) or not 0 < len(text) <= _LONGEST_TEXT or not text.isprintable():
        raise InputError(f"{where}: {key} is {str(text)[:50]!r}, must be 1 to {_LONGEST_TEXT} letters")
    return str(text)


def verified(mdp: Mdp, where: str) -> Mdp:
    """The same world, if all of its tables are what `Mdp` says; `where` is what messages call it."""
    if not isinstance(mdp.action_names, tuple) or not mdp.action_names:
        raise InputError(f"{where}: action_names is {str(mdp.action_names)[:50]}, must be a tuple of strings")
    for key, texts in (("name", [mdp.name]), ("truth", [mdp.truth]), ("action_names", mdp.action_names)):
        for text in texts:
            checked_text(where, key, text)
    if mdp.max_episode_steps is not None:
        positive_int(f"{where}: max_episode_steps", mdp.max_episode_steps)
    _check_shapes(mdp, where)
    tables = {key: getattr(mdp, key) for key in ("next_state", "probability", "reward", "start")}
    found = checked(where, Outcomes(terminated=np.zeros(mdp.next_state.shape, dtype=np.bool_), **tables))
    for key in ("next_state", "reward"):
        if not np.array_equal(getattr(found, key), getattr(mdp, key)):
            raise InputError(f"{where}: {key} of an outcome of probability 0 must be 0 or a state")
    _check_states(mdp, where)
    if mdp.state_names and len(mdp.state_names) != mdp.num_numbers:
        raise InputError(f"{where}: state_names must be one for each of {mdp.num_numbers} numbers")
    return mdp


def _check_shapes(mdp: Mdp, where: str) -> None:
    shape = np.shape(mdp.next_state)
    size, _, outcomes = shape if len(shape) == 3 else (0, 0, 0)
    expected: dict[str, tuple[Any, tuple[int, ...]]] = {
        "next_state": (np.int32, (size, len(mdp.action_names), outcomes)),
        "probability": (np.float64, shape),
        "reward": (np.float64, shape),
        "start": (np.float64, (size,)),
        "number": (np.int64, (size,)),
        **dict.fromkeys(("terminal", "goal"), (np.bool_, (size,))),
        **({} if mdp.places is None else {"places": (np.int64, (size, 3))}),
    }
    for name, (dtype, wanted) in expected.items():
        table = getattr(mdp, name)
        if not isinstance(table, np.ndarray) or (table.dtype, table.shape) != (dtype, wanted):
            raise InputError(f"{where}: {name} is {_described(table)}, must be {np.dtype(dtype)} {wanted}")
    if mdp.own_observation is not None and (wrong := misfit(mdp.own_space, mdp.own_observation, size)):
        raise InputError(f"{where}: own_observation {wrong}")


def _check_states(mdp: Mdp, where: str) -> None:
    rests = resting_states(mdp.next_state, mdp.probability, mdp.reward)
    number = mdp.number
    for wrong, mistake in (
        (mdp.terminal & ~rests, "is terminal, but has a successor or a reward"),
        (mdp.goal & ~mdp.terminal, "is a goal but not terminal"),
        (mdp.terminal & (mdp.start > 0), "is terminal and also a start"),
        ((number < 0) | (number >= len(number)), f"has a number that is not from 0 to {len(number) - 1}"),
        (() if mdp.places is None else (mdp.places < -1).any(axis=1), "has a place below -1"),
    ):
        if np.any(wrong):
            raise InputError(f"{where}: state {int(np.argmax(wrong))} {mistake}")
    if mdp.places is not None:
        panels, rows, cols = (int(most) + 1 for most in mdp.places.max(axis=0))
        if panels * rows * cols > _MOST_PLACES:
            raise InputError(
                f"{where}: places are {panels:,} panels of {rows:,} rows and {cols:,} columns; pictures have "
                f"room for {_MOST_PLACES:,} cells"
            )
