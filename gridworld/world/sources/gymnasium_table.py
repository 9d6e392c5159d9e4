"""Gymnasium's own environments as worlds, from the transition table that they step by.

Environments of Gymnasium's `toy_text` family have a table `P` and a start distribution:

    P[state][action] = [(probability, next state, reward, terminated), ...]
    initial_state_distrib = (N,) probabilities

Ending belongs to the outcome there; `gridworld.world.outcomes` makes it a state. An environment whose steps
are not those of its table is refused: the real one is walked beside the table (`table_walk`), each step must
be an outcome of its row, and as likely as the row says: exactly where all draws can be tried, and else as
far as frequencies tell.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from gridworld.base.errors import InputError, in_short, install_command
from gridworld.world.mdp import Mdp, grid_places
from gridworld.world.outcomes import Outcomes, check_size, mdp_from_outcomes
from gridworld.world.sources.table_walk import walk
from gridworld.world.wrappers import copied, refuse_transformed, step_limit

# What was found of Gymnasium's own classes by their tables, which are walked once in a process.
_WALKED: dict[Any, str] = {}


def compile_gymnasium(env_id: str, kwargs: Mapping[str, Any] | None = None) -> Mdp:
    """Make an environment of Gymnasium and compile its transition table.

    `kwargs` are arguments of `gymnasium.make`. The world has the id as its name, and its step limit.
    """
    env, again = make_env(env_id, kwargs), make_env(env_id, kwargs)
    refuse_transformed(env_id, env)
    if _differ(_table(env_id, env.unwrapped), _table(env_id, again.unwrapped)):
        raise InputError(
            f"env.id={env_id}: has a different table each time it is made, so it cannot be solved exactly; "
            "fix it by env.kwargs, e.g. desc of a FrozenLake"
        )
    mdp = compile_table(again.unwrapped, step_limit(env), env_id)
    env.close()
    again.close()
    return mdp


def compile_table(real: gym.Env[Any, Any], limit: int | None = None, name: str | None = None) -> Mdp:
    """Compile the table of an environment without wrappers, which is left as it is; a copy is stepped.

    `limit` is the step limit of its wrappers. Without a name the world is called by its id or class.
    """
    called = name or (real.spec.id if real.spec is not None else type(real).__name__)
    mdp, table = _compiled(real, called, limit)
    if own := {"step", "reset"} & vars(real).keys():
        raise InputError(f"{called}: its {own.pop()}() was replaced, so it cannot be solved exactly")
    is_gymnasiums = type(real).__module__.startswith("gymnasium.envs.")
    key = (type(real).step, type(real).reset, mdp.text()) if is_gymnasiums and name is None else None
    truth = _WALKED.get(key) or _check_steps(mdp, table, copied(real))
    if key is not None:
        _WALKED[key] = truth
    return replace(mdp, truth=truth)


def has_table(env: Any) -> bool:
    """Whether an environment has a transition table."""
    return getattr(env, "P", None) is not None


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
        raise InputError(
            f"{name}: has no transition table P; env=enumerated can find its states by trying all actions"
        )
    sizes = []
    for what in ("observation", "action"):
        space = getattr(real, f"{what}_space", None)
        if not isinstance(space, gym.spaces.Discrete) or space.start != 0:
            raise InputError(f"{name}: its {what} space is {space}, must be Discrete(n) that starts at 0")
        sizes.append(int(space.n))
    states, actions = sizes
    rows = _rows(name, real.P, states, actions)
    try:
        start = np.array(getattr(real, "initial_state_distrib", None), dtype=np.float64)
    except (TypeError, ValueError):
        start = np.zeros(0)
    if start.shape != (states,):
        raise InputError(
            f"{name}: initial_state_distrib must be the {states} probabilities of starting in each state"
        )
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


def _check_steps(mdp: Mdp, table: Outcomes, env: gym.Env[Any, Any]) -> str:
    """What `walk` says."""
    real, mistake, found = env.unwrapped, None, ""
    try:
        found = walk(mdp, table, env)
    except InputError as error:
        mistake = error
    except Exception as error:  # an environment of the user's own may raise anything
        raise InputError(f"{mdp.name}: cannot be stepped ({short_reason(error)})") from error
    if _differ(table, _table(mdp.name, real)):
        raise InputError(
            f"{mdp.name}: its table P changes when it is reset or stepped, so it cannot be solved exactly; "
            "it must not change"
        )
    if mistake is not None:
        raise mistake
    return found


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


def make_env(
    env_id: str, kwargs: Mapping[str, Any] | None = None, render_mode: str | None = None
) -> gym.Env[Any, Any]:
    """Make an environment by its registered id; "module:id" imports the module first."""
    arguments = dict(kwargs or {})
    if arguments.get("render_mode") is not None:
        raise InputError(
            f"env.kwargs: render_mode={arguments['render_mode']} is not part of the world; leave it out"
        )
    module, _, registered = str(env_id).rpartition(":")
    if module:
        try:
            importlib.import_module(module)
        except (Exception, SystemExit) as error:  # it may raise anything
            reason = f"the module {module} cannot be imported ({short_reason(error)})"
            missing = error.name if isinstance(error, ModuleNotFoundError) else None
            if missing and f"{module}.".startswith(f"{missing}."):
                reason = f"no module {missing}; install it, or add its folder to PYTHONPATH"
            raise InputError(f"env.id={str(env_id)[:80]}: {reason}") from None
    if registered.startswith(("MiniGrid-", "BabyAI-")):
        try:
            importlib.import_module("minigrid")  # registers them
        except ImportError:
            needed = f"needs the package minigrid; install it with {install_command('minigrid')}"
            raise InputError(f"env.id={env_id}: {needed}") from None
    try:
        spec = gym.spec(registered)
    except Exception as error:  # an id may name a module, which may raise anything
        raise InputError(
            f"env.id={str(env_id)[:80]}: is not registered with Gymnasium ({short_reason(error)}); give a "
            "registered id, e.g. FrozenLake-v1"
        ) from None
    if render_mode is not None or "render_mode" in spec.kwargs:  # which not every class takes
        arguments["render_mode"] = render_mode
    try:
        with np.errstate(all="ignore"):
            return gym.make(env_id, **{"disable_env_checker": True, **arguments})
    except Exception as error:  # as above
        shown = ", ".join(f"{key}: {value}" for key, value in arguments.items())[:100]
        given = f"env.kwargs={{{shown}}}: {env_id}" if arguments else f"env.id={env_id}:"
        raise InputError(f"{given} cannot be made ({short_reason(error)})") from None


def short_reason(error: BaseException) -> str:
    """What an exception says, in short."""
    return in_short(error).split(" was raised from the environment creator")[0].rstrip(" .")
