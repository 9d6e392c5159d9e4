"""Inspecting a wrapped environment: its world, its step limit, the observation of each state.

Environments of Gymnasium, its batches, and those of SB3 are recognised by their attributes, so that none of
the libraries need be imported for it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from os import PathLike
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from gridworld.bounds import MOST_STEPS, STEP_LIMIT, at_most
from gridworld.envs.frames.rendering import frame_size
from gridworld.envs.observations import KINDS, ObservationTable, TableObservation, make_observation
from gridworld.errors import InputError
from gridworld.world.grid import GridMdp, compile_mdp
from gridworld.world.layout import Layout, load, positive_int
from gridworld.world.mdp import Mdp
from gridworld.world.sources.gymnasium_table import compile_table
from gridworld.world.sources.making import wrappers_of

_LIMITS = ("_max_episode_steps", "max_episode_steps")  # of TimeLimit, of a native batch
_STATEFUL = "gymnasium.wrappers.stateful_observation"


class Task(NamedTuple):
    """A world and the step limit of its episodes."""

    mdp: Mdp
    max_episode_steps: int


def task_of(env: Any, max_episode_steps: int | None = None) -> Task:
    """Find the world and the step limit of an environment.

    Args:
        env: an environment or a batch of Gymnasium or SB3, wrapped or not: a GridWorld, or one with a
            transition table; a compiled world; or what `load` takes: the name of a map, its file, or a
            `Layout`.
        max_episode_steps: the step limit; None: the environment's own, or 100 where it has none.

    Raises:
        InputError: there is no world in it.
    """
    limit = max_episode_steps
    if isinstance(env, Mdp):
        mdp = env
    elif isinstance(env, str | PathLike | Layout):
        mdp = compile_mdp(load(env))
    else:
        mdp = world_of(env)
        limit = _step_limit(env) if limit is None else limit
    limit = mdp.max_episode_steps if limit is None else limit
    limit = STEP_LIMIT if limit is None else positive_int("max_episode_steps", limit)
    at_most("max_episode_steps", limit, MOST_STEPS)
    return Task(mdp, limit)


def world_of(env: Any) -> Mdp:
    """Find the world of an environment, or compile its transition table.

    Args:
        env: an environment or a batch of Gymnasium or SB3, wrapped or not.

    Raises:
        InputError: it is neither a GridWorld nor an environment with a table that is true.
    """
    mdp = _attribute(env, "mdp")
    if isinstance(mdp, Mdp):
        return mdp
    if _attribute(env, "P") is not None:
        mdp = compile_table(env if isinstance(env, gym.Env) else _of_first(env, "unwrapped"))
        return replace(mdp, max_episode_steps=_step_limit(env))
    raise InputError(
        f"env: {type(env).__name__} has no GridWorld in it and no transition table; must be a GridWorld "
        "environment, one of Gymnasium with a table P, a compiled world, or the name of a map"
    )


def _step_limit(env: Any) -> int | None:
    found = (_attribute(env, name) for name in _LIMITS)
    return next((each for each in found if each is not None), None)


def _attribute(env: Any, name: str) -> Any:
    """An attribute of an environment under its wrappers; of a batch, of its first environment; else None."""
    ways: tuple[Callable[[], Any], ...] = (
        lambda: env.get_wrapper_attr(name),
        lambda: getattr(env.unwrapped, name),
        lambda: _of_first(env, name),
    )
    for ask in ways:
        try:
            return ask()
        except (AttributeError, TypeError):
            continue
    return None


def _of_first(batch: Any, name: str) -> Any:
    """An attribute of a batch's first environment. Other processes would die of one that is not there."""
    has = batch.has_attr(name) if hasattr(batch, "has_attr") else all(batch.call("has_wrapper_attr", name))
    if not has:
        raise AttributeError(name)
    return batch.get_attr(name)[0]


def observation_like(mdp: Mdp, space: gym.Space[Any]) -> ObservationTable:
    """The observation of a world that has this space.

    Raises:
        InputError: there is none.
    """
    for kind in KINDS:
        table = make_observation(mdp, kind, _cell_size(mdp, space)) if _may_be(mdp, kind, space) else None
        if table is not None and table.space == space:
            return table
    raise InputError(
        f"the model sees {space}, and no observation of this world ({mdp.num_states} states) is like that; "
        f"give the environment that it was trained on, or train on one of {', '.join(KINDS)}"
    )


def _may_be(mdp: Mdp, kind: str, space: gym.Space[Any]) -> bool:
    if kind == "image":
        return isinstance(mdp, GridMdp) and space.dtype == np.uint8 and len(space.shape or ()) == 3
    needs = {"coordinates": mdp.places, "own": mdp.own_observation}
    return kind not in needs or needs[kind] is not None


def _cell_size(mdp: Mdp, space: gym.Space[Any]) -> int:
    """Of the images that have this space, as their width has it; 1 where there is none."""
    if not isinstance(mdp, GridMdp):
        return 1
    width = (space.shape or (1,))[-1]
    per_cell, border = frame_size(mdp, 2)[0] - frame_size(mdp, 1)[0], frame_size(mdp, 1)[0]
    return max(1, (width - border) // per_cell + 1)


def observation_of(env: gym.Env[Any, Any], mdp: Mdp) -> ObservationTable:
    """What an agent in a scalar environment sees of each state, through all of its wrappers.

    Args:
        env: the environment.
        mdp: its world.

    Raises:
        InputError: what it sees or does is not a function of the state alone.
    """
    wrappers: list[Any] = list(wrappers_of(env))[::-1]  # from the inside
    seeing = [each for each in wrappers if _sees(each)]
    first = seeing[0] if seeing else None
    if first is None:
        return make_observation(mdp, "none")
    if len(seeing) == 1 and isinstance(first, TableObservation):
        return first.table
    rows: list[Any] = mdp.number.tolist()
    for wrapper in seeing:
        rows = [wrapper.observation(row) for row in rows]
    if not all(isinstance(row, np.ndarray | int | np.integer) for row in rows):
        raise InputError(f"env: its observations are {seeing[-1].observation_space}, which is no plain array")
    return tabulated(env.observation_space, np.asarray(rows))


def tabulated(space: gym.Space[Any], rows: NDArray[Any]) -> ObservationTable:
    """The table of observations `rows` (S, *shape)."""
    return ObservationTable("of its own", space, len(rows), rows)


def _sees(wrapper: Any) -> bool:
    """Whether a wrapper changes observations, by a function of them."""
    name = type(wrapper).__name__
    if type(wrapper).__module__ == _STATEFUL:
        raise InputError(
            f"env: {name} makes observations of more than the state, so no table of the policy can be "
            "evaluated exactly; leave it out"
        )
    if isinstance(wrapper, gym.ActionWrapper):
        raise InputError(f"env: {name} changes actions; an exact score is of the world's own")
    if isinstance(wrapper, gym.ObservationWrapper):
        return True
    if wrapper.observation_space != wrapper.env.observation_space:
        raise InputError(
            f"env: {name} changes observations and is no gymnasium.ObservationWrapper, so that what the "
            "agent sees of a state cannot be asked for"
        )
    return False


def is_discrete(space: gym.Space[Any], number: int) -> bool:
    """Whether a space is that of so many actions."""
    return isinstance(space, spaces.Discrete) and space.n == number and space.start == 0
