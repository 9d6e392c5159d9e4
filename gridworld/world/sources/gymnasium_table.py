"""Gymnasium's own environments as worlds, from the transition table that they step by.

FrozenLake, CliffWalking and Taxi have a table `P` and a start distribution:

    P[state][action] = [(probability, next state, reward, terminated), ...]
    initial_state_distrib = (N,) probabilities

Ending belongs to the outcome there; `gridworld.world.outcomes` makes it a state. That these step by their
tables is held by the tests; whatever else has a `P` is searched like any other environment.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple, cast

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from gridworld.base.errors import InputError
from gridworld.world.mdp import Mdp, grid_places
from gridworld.world.outcomes import Outcomes, check_size, mdp_from_outcomes, verified

FOLLOWED = "table P, which its steps follow exactly"  # the `truth` of such worlds


def compile_table(real: gym.Env[Any, Any], limit: int | None = None, name: str | None = None) -> Mdp:
    """Compile the table of an environment that `has_table`; `limit` is the step limit of its wrappers.

    Without a name the world is called by its id or class.
    """
    called, given = name or (real.spec.id if real.spec is not None else type(real).__name__), cast(Any, real)
    sizes, known = (int(given.observation_space.n), int(given.action_space.n)), _KNOWN[type(real).__name__]
    table = _outcomes(called, given.P, *sizes, given.initial_state_distrib, "initial_state_distrib")
    mdp = mdp_from_outcomes(
        called,
        table,
        action_names=known.action_names,
        places=known.places(real),
        panel_names=known.panel_names,
        max_episode_steps=limit,
    )
    return replace(mdp, truth=FOLLOWED)


def has_table(env: Any) -> bool:
    """Whether an environment is one of Gymnasium's own that steps by its table."""
    kind = type(env)
    if not kind.__module__.startswith("gymnasium.envs.toy_text.") or kind.__name__ not in _KNOWN:
        return False
    is_fickle = getattr(env, "fickle_passenger", False) and getattr(env, "fickle_probability", 1) > 0
    is_own = {kind.step.__module__, kind.reset.__module__} != {kind.__module__}
    return not (is_own or is_fickle or {"step", "reset"} & vars(env).keys())  # which its table lacks


def mdp_of_table(table: Any, start: Any, name: str = "P") -> Mdp:
    """Compile a table `P` (see the module) of N states; `start` is (N,) probabilities, or one state."""
    try:
        size = len(table), len(table[0])
    except (TypeError, LookupError):
        size = 0, 0
    if isinstance(start, int | np.integer) and 0 <= start < size[0]:
        start = np.eye(size[0])[start]
    return verified(mdp_from_outcomes(name, _outcomes(name, table, *size, start, "start")), name)


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
