"""Worlds as arrays: of a custom file (.npz) or function, and the file that a run keeps of its world.

A custom world, with N states, A actions and at most K outcomes of each:

    next_state         (N, A, K)  whole numbers from 0 to N - 1: the state that follows
    probability        (N, A, K)  of each outcome; 0 where there is none
    reward             (N, A, K)
    terminated         (N, A, K)  booleans: whether the outcome ends the episode
    start              (N,)       the probabilities of starting in each state
    success            (N, A, K)  optional, booleans: which ends are goals; without it, those that pay best
    action_names       (A,)       optional, strings
    places             (N, 3)     optional, panel, row and column of each state in pictures; -1: it has none.
                                  (N, 2): row and column
    max_episode_steps  ()         optional, the step limit
    name               ()         optional, a string

In a deterministic world, the tables may be (N, A), and `probability` may be left out. An example:

    numpy.savez("two_rooms.npz", next_state=[[0, 1], [0, 1]], reward=[[0.0, 0.0], [0.0, 1.0]],
                terminated=[[False, False], [False, True]], start=[1.0, 0.0])

A run's world holds the fields of an `Mdp` as they are. What other programs write, matrices `P` and `R`, .mat,
.MDP and .POMDP, is in `gridworld.world.sources.files` and `gridworld.world.sources.cassandra`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from os import PathLike
from typing import Any

import numpy as np
from gymnasium.spaces import Dict
from numpy.typing import NDArray

from gridworld.base.bounds import positive_int
from gridworld.base.errors import InputError, in_short
from gridworld.base.user_input import as_path, named_object, npz_arrays, npz_bytes, read_users_file
from gridworld.world.mdp import Mdp, frozen, leaves_of
from gridworld.world.outcomes import Outcomes, checked_text, mdp_from_outcomes, verified
from gridworld.world.shown import space_of_text, space_text
from gridworld.world.sources.cassandra import world_of_text
from gridworld.world.sources.files import dense, mat_arrays, outcomes_of_matrices
from gridworld.world.sources.gymnasium_table import mdp_of_table

_TABLES = ("next_state", "probability", "reward", "terminated", "success")
_NEEDED = ("next_state", "reward", "terminated", "start")
_MATRICES = ("P", "R")
_OPTIONAL = ("probability", "success", "action_names", "places", "max_episode_steps", "name")
_LISTS = ("panel_names", "state_names")  # of names, which most worlds do not have
_OWN = "own_observation"
_MOST_BYTES = 4 * 2**30
_MOST_TEXT = 64 * 2**20
_TEXTS = (".mdp", ".pomdp")
_FILES = "an .npz, .mat, .MDP or .POMDP file"
_FORMAT = np.array("gridworld world 1")


def load_world(path: str | PathLike[str]) -> Mdp:
    """Read a world from a file: an .npz, a custom one or a run's `world.npz`, a .mat, an .MDP or a .POMDP.

    The module says what is in them. Without a `name` in it, the world is named after the file. Raises
    InputError if it is no such file.
    """
    where = as_path("env.path", path)
    is_text = (ending := where.suffix.lower()) in _TEXTS
    content = read_users_file("env.path", path, _FILES, _MOST_TEXT if is_text else _MOST_BYTES)
    if is_text:
        return world_of_text(where.stem, content, str(path))
    if ending == ".mat":
        return mdp_from_arrays(where.stem, mat_arrays(content, str(path)), str(path))
    arrays = npz_arrays(path, content, "an .npz file of arrays", _MOST_BYTES)
    if "format" in arrays:
        return _from_fields(arrays, str(path))
    return mdp_from_arrays(where.stem, arrays, str(path))


def mdp_from_arrays(name: str, arrays: Mapping[str, Any], where: str) -> Mdp:
    """Compile the arrays of a custom world, or what numpy makes arrays of, by name; see the module."""
    is_matrices = any(key in arrays for key in _MATRICES)
    needed = _MATRICES if is_matrices else _NEEDED
    optional = ("start", *_OPTIONAL[2:]) if is_matrices else _OPTIONAL
    for key in needed:
        if key not in arrays:
            raise InputError(f"{where}: has no {key}, must contain {', '.join(needed)}")
    if unknown := [key for key in arrays if key not in needed + optional]:
        raise InputError(
            f"{where}: {str(unknown[0])[:50]} is not an array of a world; optional are {', '.join(optional)}"
        )
    given = {
        key: _array(where, key, dense(where, key, value) if key in _MATRICES else value)
        for key, value in arrays.items()
    }
    tables = (
        outcomes_of_matrices(where, given["P"], given["R"], given.get("start"))
        if is_matrices
        else _outcomes(where, given)
    )
    limit: Any = given["max_episode_steps"].tolist() if "max_episode_steps" in given else None
    places = given.get("places")
    if places is not None and places.ndim == 2 and places.shape[1] == 2 and places.dtype.kind in "iu":
        places = np.concatenate([np.where(places[:, :1] < 0, -1, 0), places], axis=1)  # of one panel
    mdp = mdp_from_outcomes(
        where,
        tables,
        action_names=_names(where, "action_names", given.get("action_names")),
        places=places,
        max_episode_steps=limit,
    )
    called = checked_text(where, "name", given["name"]) if "name" in given else name
    return verified(dataclasses.replace(mdp, name=called), where)


def _outcomes(where: str, given: dict[str, NDArray[Any]]) -> Outcomes:
    """The tables among the arrays of a custom world."""
    if given["next_state"].ndim == 2:
        flat = [key for key in _TABLES if key in given and given[key].ndim == 2]
        given |= {key: given[key][:, :, None] for key in flat}
        given.setdefault("probability", np.ones(given["next_state"].shape))
    elif "probability" not in given:
        raise InputError(f"{where}: has no probability; without it, next_state must be (states, actions)")
    return Outcomes(**{key: given[key] for key in (*_TABLES, "start") if key in given})


def build(builder: str | Callable[..., Any], kwargs: Mapping[str, Any] | None = None) -> Mdp:
    """Call a function that makes a world.

    Args:
        builder: the function, or its import path, `package.module.function`. It returns an `Mdp`, `Outcomes`,
            arrays by their names, as the module has them, or a table `P` and its start.
        kwargs: its arguments.

    Returns:
        The world, named after the function unless what that returns has a name.
    """
    where = f"env.builder={_name_of(builder) if callable(builder) else str(builder)[:200]}"
    function = named_object(where, builder) if isinstance(builder, str) else builder
    if not callable(function):
        raise InputError(f"{where}: must be the import path of a function, e.g. my_package.worlds.make")
    mdp, again = (_built(where, function, dict(kwargs or {})) for _ in range(2))
    if mdp.text() != again.text():
        raise InputError(
            f"{where}: returns a different world each time; anything random must follow from env.kwargs, "
            "e.g. a seed"
        )
    return mdp


def _built(where: str, function: Callable[..., Any], kwargs: dict[str, Any]) -> Mdp:
    try:
        found = function(**kwargs)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    except (Exception, SystemExit) as error:  # a function of the user's own may raise anything
        raise InputError(f"{where}: raised {in_short(error)}") from error
    name = _name_of(function)
    if isinstance(found, Mdp):
        plain = {field.name: getattr(found, field.name) for field in dataclasses.fields(Mdp)}
        return verified(Mdp(**plain), where)
    if isinstance(found, Outcomes):
        return verified(dataclasses.replace(mdp_from_outcomes(where, found), name=name), where)
    if isinstance(found, tuple) and len(found) == 2:
        return mdp_of_table(*found, name)
    if isinstance(found, Mapping):
        return mdp_from_arrays(name, found, where)
    raise InputError(
        f"{where}: returned {type(found).__name__}, must return an Mdp, Outcomes, a mapping of arrays, or "
        "(P, start) with a table P[state][action] of (probability, next state, reward, terminated)"
    )


def _name_of(function: Any) -> str:
    return str(getattr(function, "__name__", type(function).__name__))


def _array(where: str, key: str, value: Any) -> NDArray[Any]:
    try:
        array = np.asarray(value)
    except (TypeError, ValueError, RuntimeError):
        array = np.array(None)
    if array.dtype.kind == "O":
        raise InputError(
            f"{where}: {key} is {type(value).__name__}, which is not an array of numbers or text"
        )
    return array


def _names(where: str, key: str, given: NDArray[Any] | None) -> list[str] | None:
    if given is None:
        return None
    if given.ndim != 1 or given.dtype.kind != "U":
        raise InputError(f"{where}: {key} is {given.dtype} {given.shape}, must be one string each")
    return [checked_text(where, key, name) for name in given]


def world_bytes(mdp: Mdp) -> bytes:
    """A world as the content of a file, its tables bit for bit, but for what only `GridMdp` has."""
    arrays = {"format": _FORMAT}
    for field in dataclasses.fields(Mdp):
        value = getattr(mdp, field.name)
        if field.name == _OWN and isinstance(value, dict):
            arrays |= {f"{_OWN}.{n}": np.ascontiguousarray(each) for n, each in enumerate(leaves_of(value))}
        elif field.name == "own_space" and value is not None:
            arrays[field.name] = np.array(space_text(value))
        elif value is not None and not (field.name in _LISTS and not value):
            arrays[field.name] = np.ascontiguousarray(value) if np.ndim(value) else np.array(value)
    return npz_bytes(arrays)


def world_from_bytes(content: bytes, where: str) -> Mdp:
    """Mirrors `world_bytes`."""
    return _from_fields(npz_arrays(where, content, "a world"), where)


def _from_fields(found: dict[str, NDArray[Any]], where: str) -> Mdp:
    fields = {field.name: field for field in dataclasses.fields(Mdp)}
    if not np.array_equal(found.pop("format", np.array("")), _FORMAT):
        raise InputError(f"{where}: not a world of this version, must contain format={_FORMAT}")
    own = _own(found, where)
    needed = {name for name, field in fields.items() if field.default is dataclasses.MISSING}
    if not needed <= found.keys() <= fields.keys():
        raise InputError(
            f"{where}: not a world, must contain {sorted(needed)}, contains {sorted(found)[:20]}"
        )
    values: dict[str, Any] = {**found, **own}
    for key in ("name", "truth"):
        if key in found:
            values[key] = checked_text(where, key, found[key])
    for key in ("action_names", *_LISTS):
        values[key] = tuple(_names(where, key, found.get(key)) or ())
    if (limit := found.get("max_episode_steps")) is not None:
        values["max_episode_steps"] = positive_int(f"{where}: max_episode_steps", limit.tolist())
    frozen(own.get(_OWN))
    tables = {key: frozen(value) for key, value in values.items() if isinstance(value, np.ndarray)}
    return verified(Mdp(**{**values, **tables}), where)


def _own(found: dict[str, NDArray[Any]], where: str) -> dict[str, Any]:
    """The space of what the environment shows, and of a Dict its rows, arrays 0, 1, ... in a file."""
    if "own_space" not in found:
        return {}
    space = space_of_text(str(found.pop("own_space")), where)
    if not isinstance(space, Dict):
        return {"own_space": space}
    parts = {key: found.pop(f"{_OWN}.{n}", None) for n, key in enumerate(space.spaces)}
    return {"own_space": space, _OWN: {key: each for key, each in parts.items() if each is not None}}
