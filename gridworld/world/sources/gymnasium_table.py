"""Gymnasium's own environments as worlds, from the transition table that they step by.

Environments of Gymnasium's `toy_text` family have a table `P` and a start distribution:

    P[state][action] = [(probability, next state, reward, terminated), ...]
    initial_state_distrib = (N,) probabilities

Ending belongs to the outcome there; `gridworld.world.outcomes` makes it a state. An environment whose steps
are not those of its table is refused: the real one is walked beside the table (`table_walk`), each step must
be an outcome of its row, and as frequent as the row says, as far as that can be told.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from gridworld.errors import InputError, in_short, install_command
from gridworld.world.mdp import IntArray, Mdp, grid_places
from gridworld.world.outcomes import Outcomes, check_size, mdp_from_outcomes
from gridworld.world.sources.table_walk import walk
from gridworld.world.wrappers import copied, refuse_transformed, step_limit

# What was found of Gymnasium's own classes by their tables, which are walked once in a process.
_WALKED: dict[tuple[type, str] | None, str] = {}


def compile_gymnasium(env_id: str, kwargs: Mapping[str, Any] | None = None) -> Mdp:
    """Make an environment of Gymnasium and compile its transition table.

    `kwargs` are arguments of `gymnasium.make`. The world has the id as its name, and its step limit.
    """
    arguments = dict(kwargs or {})
    env = make_env(env_id, arguments)
    refuse_transformed(env_id, env)
    mdp, table = _compiled(env.unwrapped, env_id, step_limit(env))
    # Only now: a large environment takes long, and may be refused. Its own step limit may be set otherwise.
    again = make_env(env_id, {**arguments, "max_episode_steps": -1})
    if _differ(table, _table(mdp.name, again.unwrapped)):
        raise InputError(
            f"env.id={env_id}: has another table each time that it is made, so no exact truth is known; "
            "give what it draws as env.kwargs, e.g. desc of a FrozenLake"
        )
    truth = _check_steps(mdp, table, again)
    env.close()
    again.close()
    return replace(mdp, truth=truth)


def compile_table(real: gym.Env[Any, Any], limit: int | None = None) -> Mdp:
    """Compile the table of an environment without wrappers, which is left as it is; a copy is stepped.

    `limit` is the step limit of its wrappers. The world has the environment's id, or else its class, as name.
    """
    mdp, table = _compiled(real, real.spec.id if real.spec is not None else type(real).__name__, limit)
    if own := {"step", "reset"} & vars(real).keys():
        raise InputError(f"{mdp.name}: its {own.pop()}() was replaced, so nothing exact is known of it")
    key = (type(real), mdp.text()) if type(real).__module__.startswith("gymnasium.envs.") else None
    truth = _WALKED.get(key) or _check_steps(mdp, table, copied(real))
    if key is not None:
        _WALKED[key] = truth
    return replace(mdp, truth=truth)


def has_table(env: Any) -> bool:
    """Whether an environment has a transition table."""
    return getattr(env, "P", None) is not None


def _compiled(real: gym.Env[Any, Any], name: str, limit: int | None) -> tuple[Mdp, Outcomes]:
    table = _table(name, real)
    known = known_env(real)
    num_states, num_actions = table.next_state.shape[:2]
    names = known.action_names if known is not None and len(known.action_names) == num_actions else None
    places = known.places(real) if known is not None else None
    mdp = mdp_from_outcomes(
        name,
        table,
        action_names=names,
        places=places if places is not None and len(places) == num_states else None,
        panel_names=known.panel_names if known is not None else (),
        max_episode_steps=limit,
    )
    if known and getattr(real, "fickle_passenger", False) and getattr(real, "fickle_probability", 1) > 0:
        raise InputError(
            f"{name}: fickle_passenger=True changes the destination in a way that its table P does not have, "
            "so no exact truth is known; leave it out"
        )
    return mdp, table


def _table(name: str, real: Any) -> Outcomes:
    """P and the start distribution as arrays; an outcome that a row does not have has probability 0."""
    if not has_table(real):
        raise InputError(
            f"{name}: has no transition table P, so its truth cannot be read off; env=enumerated may fit, "
            "which tries out what a deterministic environment does"
        )
    sizes = []
    for what in ("observation", "action"):
        space = getattr(real, f"{what}_space", None)
        if not isinstance(space, gym.spaces.Discrete) or space.start != 0:
            raise InputError(f"{name}: its {what} space is {space}, must be Discrete(n) that starts at 0")
        sizes.append(int(space.n))
    states, actions = sizes
    check_size(name, states, actions, 1)
    rows, counts = _rows(name, real.P, states, actions)
    longest = int(counts.max())
    check_size(name, states, actions, longest)

    try:
        start = np.array(getattr(real, "initial_state_distrib", None), dtype=np.float64)
    except (TypeError, ValueError):
        start = np.zeros(0)
    if start.shape != (states,):
        raise InputError(
            f"{name}: initial_state_distrib must be the {states} probabilities of starting in each state"
        )

    ends = np.cumsum(counts)
    pair = np.repeat(np.arange(states * actions), counts)
    column = np.arange(len(rows)) - np.repeat(ends - counts, counts)
    # What fills up a short row leads where its first outcome leads, so that it adds no predecessor.
    padded = np.repeat(rows[ends - counts][:, None], longest, axis=1)
    padded[:, :, 0] = 0.0
    padded[pair, column] = rows
    padded = padded.reshape(states, actions, longest, 4)
    return Outcomes(
        next_state=padded[..., 1].astype(np.int64),
        probability=padded[..., 0].copy(),
        reward=padded[..., 2].copy(),
        terminated=padded[..., 3] == 1,
        start=start,
    )


def _rows(name: str, table: Any, states: int, actions: int) -> tuple[NDArray[np.float64], IntArray]:
    """All outcomes (M, 4) in the order of states and actions, and how many each of these has (S * A,)."""
    try:
        of_pairs = [table[state][action] for state in range(states) for action in range(actions)]
        rows = np.array([outcome for row in of_pairs for outcome in row], dtype=np.float64)
        counts = np.array([len(row) for row in of_pairs])
        if (counts > 0).all() and _are_outcomes(rows, states):
            return rows, counts
    except (KeyError, IndexError, TypeError, ValueError, OverflowError):
        pass
    raise InputError(
        f"{name}: its table P must have for each of {states} states and {actions} actions a list of "
        f"(probability, next state from 0 to {states - 1}, reward, terminated)"
    )


def _are_outcomes(rows: NDArray[np.float64], states: int) -> bool:
    """Whether all rows (M, 4) lead to states and end, or not."""
    if rows.ndim != 2 or rows.shape[1] != 4:
        return False
    are_states = (rows[:, 1] >= 0) & (rows[:, 1] < states) & (np.floor(rows[:, 1]) == rows[:, 1])
    return bool(are_states.all() and np.isin(rows[:, 3], (0, 1)).all())


def _differ(table: Outcomes, other: Outcomes) -> bool:
    names = ("next_state", "probability", "reward", "terminated", "start")
    return not all(np.array_equal(getattr(table, name), getattr(other, name)) for name in names)


def _check_steps(mdp: Mdp, table: Outcomes, env: gym.Env[Any, Any]) -> str:
    """What `walk` says."""
    real, mistake, found = env.unwrapped, None, ""
    try:
        found = walk(mdp, table, env, known_env(real) is not None)
    except InputError as error:
        mistake = error
    except Exception as error:  # an environment of the user's own may raise anything
        raise InputError(f"{mdp.name}: cannot be stepped ({short_reason(error)})") from error
    if _differ(table, _table(mdp.name, real)):
        raise InputError(
            f"{mdp.name}: its table P changes when it is reset or stepped, so no exact truth is known; must "
            "stay what it is from when the environment was made"
        )
    if mistake is not None:
        raise mistake
    return found


@dataclass(frozen=True)
class _KnownEnv:
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


_PACKAGES = {"MiniGrid-": "minigrid", "BabyAI-": "minigrid"}  # which register ids that begin so


def make_env(
    env_id: str, kwargs: Mapping[str, Any] | None = None, render_mode: str | None = None
) -> gym.Env[Any, Any]:
    """Make an environment by its registered id; "module:id" imports the module first."""
    arguments = dict(kwargs or {})
    if arguments.get("render_mode") is not None:
        raise InputError(
            f"env.kwargs: render_mode={arguments['render_mode']} is no part of the world; leave it out"
        )
    module, _, registered = str(env_id).rpartition(":")
    if module:
        _import_module(env_id, module)
    for beginning, package in _PACKAGES.items():
        if registered.startswith(beginning):
            try:
                importlib.import_module(package)
            except ImportError:
                needed = f"needs the package {package}; install it with {install_command(package)}"
                raise InputError(f"env.id={env_id}: {needed}") from None
    try:
        gym.spec(registered)
    except Exception as error:  # an id may name a module, which may raise anything
        raise InputError(
            f"env.id={str(env_id)[:80]}: is no environment that Gymnasium knows ({short_reason(error)}); "
            "give a registered id, e.g. FrozenLake-v1"
        ) from None
    try:
        with np.errstate(all="ignore"):
            return gym.make(env_id, **{"disable_env_checker": True, **arguments, "render_mode": render_mode})
    except Exception as error:  # as above
        shown = ", ".join(f"{key}: {value}" for key, value in arguments.items())[:100]
        given = f"env.kwargs={{{shown}}}: {env_id}" if arguments else f"env.id={env_id}:"
        raise InputError(f"{given} cannot be made ({short_reason(error)})") from None


def short_reason(error: BaseException) -> str:
    """What an exception says, in short."""
    return in_short(error).split(" was raised from the environment creator")[0].rstrip(" .")


def _import_module(env_id: str, module: str) -> None:
    """Import what an id "module:id" names, which registers the environment."""
    try:
        importlib.import_module(module)
    except (Exception, SystemExit) as error:  # it may raise anything
        reason = f"the module {module} cannot be imported ({short_reason(error)})"
        missing = error.name if isinstance(error, ModuleNotFoundError) else None
        if missing and f"{module}.".startswith(f"{missing}."):
            reason = f"there is no module {missing}; install it, or name its folder in PYTHONPATH"
        raise InputError(f"env.id={str(env_id)[:80]}: {reason}") from None
