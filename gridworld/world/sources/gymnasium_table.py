"""Gymnasium's own environments as worlds, from the transition table that they step by.

Environments of Gymnasium's `toy_text` family have a table `P` and a start distribution:

    P[state][action] = [(probability, next state, reward, terminated), ...]
    initial_state_distrib = (N,) probabilities; isd in older ones

Ending belongs to the outcome there; `gridworld.world.outcomes` makes it a state. An environment whose steps
are not those of its table is refused: in each state every outcome of each action is tried (`table_rows`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from gridworld.base.errors import InputError
from gridworld.world.mdp import Mdp, grid_places
from gridworld.world.outcomes import Outcomes, check_size, mdp_from_outcomes, verified
from gridworld.world.sources.table_rows import compare_rows

FOLLOWED = "table P, which its steps follow exactly"  # the `truth` of such worlds
# Gymnasium's own classes and tables whose rows were stepped, once in a process.
_COMPARED: set[Any] = set()


def compile_table(real: gym.Env[Any, Any], limit: int | None = None, name: str | None = None) -> Mdp | None:
    """Compile the table of an environment without wrappers, which is left as it is; its rows are stepped.

    `limit` is the step limit of its wrappers. Without a name the world is called by its id or class. None:
    its state cannot be set, so that its rows cannot be stepped.
    """
    called = name or (real.spec.id if real.spec is not None else type(real).__name__)
    mdp, table = _compiled(real, called, limit)
    own = {"step", "reset"} & vars(real).keys()
    is_gymnasiums = type(real).__module__.startswith("gymnasium.envs.") and not own
    settings = sorted((key, each) for key, each in vars(real).items() if isinstance(each, bool | float | str))
    key = (type(real).step, type(real).reset, repr(settings), mdp.text()) if is_gymnasiums else None
    if key not in _COMPARED:
        compared = compare_rows(mdp, table, real)
        if _differ(table, _table(called, real)):
            raise InputError(
                f"{called}: its table P changes when it is reset or stepped, so it cannot be solved "
                "exactly; it must "
                "not change"
            )
        if not compared:
            return None
        if key is not None:
            _COMPARED.add(key)
    return replace(mdp, truth=FOLLOWED)


def has_table(env: Any) -> bool:
    """Whether an environment has a transition table and says where it starts."""
    return getattr(env, "P", None) is not None and _starts(env) is not None


def _starts(env: Any) -> Any:
    return getattr(env, "initial_state_distrib", getattr(env, "isd", None))


def mdp_of_table(table: Any, start: Any, name: str = "P") -> Mdp:
    """Compile a table `P` (see the module) of N states; `start` is (N,) probabilities, or one state."""
    try:
        size = len(table), len(table[0])
    except (TypeError, LookupError):
        size = 0, 0
    if isinstance(start, int | np.integer) and 0 <= start < size[0]:
        start = np.eye(size[0])[start]
    return verified(mdp_from_outcomes(name, _outcomes(name, table, *size, start, "start")), name)


def _compiled(real: gym.Env[Any, Any], name: str, limit: int | None) -> tuple[Mdp, Outcomes]:
    table = _table(name, real)
    known = known_env(real) or _KnownEnv((), lambda env: np.zeros((0, 3), np.int64))
    (num_states, num_actions), places = table.next_state.shape[:2], known.places(real)
    mdp = mdp_from_outcomes(
        name,
        table,
        action_names=known.action_names if len(known.action_names) == num_actions else None,
        places=places if len(places) == num_states else None,
        panel_names=known.panel_names,
        max_episode_steps=limit,
    )
    is_fickle = known.panel_names and getattr(real, "fickle_passenger", False)
    if is_fickle and getattr(real, "fickle_probability", 1) > 0:
        raise InputError(
            f"{name}: fickle_passenger=True changes the destination in a way that its table P lacks, so it "
            "cannot be solved exactly; leave it out, or use env=enumerated"
        )
    return mdp, table


def _table(name: str, real: Any) -> Outcomes:
    """P and the start distribution as arrays; an outcome that a row does not have has probability 0."""
    if not has_table(real):
        raise InputError(f"{name}: has no transition table P with a start distribution")
    sizes = []
    for what in ("observation", "action"):
        space = getattr(real, f"{what}_space", None)
        if not isinstance(space, gym.spaces.Discrete) or space.start != 0:
            raise InputError(f"{name}: its {what} space is {space}, must be Discrete(n) that starts at 0")
        sizes.append(int(space.n))
    states, actions = sizes
    return _outcomes(name, real.P, states, actions, _starts(real), "initial_state_distrib")


def _outcomes(name: str, table: Any, states: int, actions: int, given: Any, key: str) -> Outcomes:
    rows = _rows(name, table, states, actions)
    try:
        start = np.array(given, dtype=np.float64)
    except (TypeError, ValueError):
        start = np.zeros(0)
    if start.shape != (states,):
        raise InputError(f"{name}: {key} must be the {states} probabilities of starting in each state")
    return Outcomes(
        next_state=rows[..., 1].astype(np.int64),
        probability=rows[..., 0].copy(),
        reward=rows[..., 2].copy(),
        terminated=rows[..., 3] == 1,
        start=start,
    )


def _rows(name: str, table: Any, states: int, actions: int) -> NDArray[np.float64]:
    """All outcomes (N, A, K, 4); what fills up a short row leads to where its first outcome leads."""
    check_size(name, states, actions, 1)
    errors = (KeyError, IndexError, TypeError, ValueError, OverflowError)
    try:
        rows = [table[state][action] for state in range(states) for action in range(actions)]
        longest = max(map(len, rows))
    except errors:
        rows, longest = [], 1
    check_size(name, states, actions, longest)
    try:
        filled = [[*row, *[(0.0, *row[0][1:])] * (longest - len(row))] for row in rows]
        found = np.array(filled, dtype=np.float64).reshape(states, actions, longest, 4)
        following = found[..., 1]
        fits = (following >= 0) & (following < states) & (np.floor(following) == following)
        if (fits & np.isin(found[..., 3], (0, 1))).all():
            return found
    except errors:
        pass
    raise InputError(
        f"{name}: its table P must have for each of {states} states and {actions} actions a list of "
        f"(probability, next state from 0 to {states - 1}, reward, terminated)"
    )


def _differ(table: Outcomes, other: Outcomes) -> bool:
    names = ("next_state", "probability", "reward", "terminated", "start")
    tables = ((getattr(table, name), getattr(other, name)) for name in names)
    return not all(np.array_equal(one, two, equal_nan=True) for one, two in tables)


class _KnownEnv(NamedTuple):
    """What is known of a class of environments beside its table; see `Mdp`."""

    action_names: tuple[str, ...]
    places: Callable[[Any], NDArray[np.int64]]
    panel_names: tuple[str, ...] = ()


def _taxi_places(env: Any) -> NDArray[np.int64]:
    """One panel for each passenger and destination: passenger * 4 + destination."""
    cell, panel = np.divmod(np.arange(500), 20)
    return np.stack([panel, cell // 5, cell % 5], axis=1).astype(np.int64)


_KNOWN = {
    "FrozenLakeEnv": _KnownEnv(("left", "down", "right", "up"), lambda env: grid_places(*env.desc.shape)),
    "CliffWalkingEnv": _KnownEnv(("up", "right", "down", "left"), lambda env: grid_places(*env.shape)),
    "TaxiEnv": _KnownEnv(
        ("south", "north", "east", "west", "pickup", "dropoff"),
        _taxi_places,
        tuple(f"{passenger} to {destination}" for passenger in (*"RGYB", "taxi") for destination in "RGYB"),
    ),
}


def known_env(real: Any) -> _KnownEnv | None:
    """What is known of an environment, if anything is."""
    for each in type(real).__mro__:
        if each.__module__.startswith("gymnasium.envs.toy_text."):
            return _KNOWN.get(each.__name__)
    return None
