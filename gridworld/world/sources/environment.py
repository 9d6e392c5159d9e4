"""An environment of Gymnasium by its id, or in hand, as a world: by its table where it has one, else by
search.

A world here and a transition table are shortcuts: what they say is what trying every action would find.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import seeding

from gridworld.base.errors import InputError, in_short, install_command
from gridworld.world.door import known
from gridworld.world.door.layers import Env, layers_of, random_states, state_of
from gridworld.world.door.search import traits
from gridworld.world.door.world import Found, enumerated
from gridworld.world.mdp import Mdp
from gridworld.world.outcomes import MOST_STATES
from gridworld.world.sources.gymnasium_table import compile_table, has_table

_IF_DRAWN = 40  # instances that are compared if making one draws random numbers


def enumerate_env(
    env_id: str,
    kwargs: Mapping[str, Any] | None = None,
    *,
    ignore: Sequence[str] = (),
    most_states: int = MOST_STATES,
) -> Mdp:
    """Compile an environment by trying every action in a copy of every state, with every draw of `np_random`.

    Args:
        env_id: its registered id.
        kwargs: the arguments of `gymnasium.make`.
        ignore: attributes of the environment that are not part of its state.
        most_states: more are refused as soon as they are found.

    Returns:
        The world; its `truth` is "enumerated, N states", of what, and without which attributes. Its states
        are what a history of observations and rewards leaves open of the environment's own, see `beliefs`.
    """
    bounds = {"ignore": ignore, "most_states": most_states}
    return found_by(partial(make_env, env_id, kwargs), f"env.id={env_id}", env_id, **bounds).mdp


def compile_id(env_id: str, kwargs: Mapping[str, Any] | None = None) -> Mdp:
    """Compile an environment by its transition table if it has one that its steps follow, else by search."""
    with closing(make_env(env_id, kwargs)) as env:
        if (mdp := shortcut(env, env_id)) is None:
            return found_by(partial(make_env, env_id, kwargs), f"env.id={env_id}", env_id).mdp
        with closing(make_env(env_id, kwargs)) as again:
            other = shortcut(again, env_id)
        if other is None or other.digest() != mdp.digest():
            raise InputError(
                f"env.id={env_id}: has a different table each time it is made, so it cannot be solved "
                "exactly; fix "
                "it by env.kwargs, e.g. desc of a FrozenLake"
            )
        return mdp


def shortcut(env: gym.Env[Any, Any], name: str | None = None) -> Mdp | None:
    """The world of an environment's transition table, if no wrapper changes it and it has one; else None."""
    *outer, real = layers_of(env)
    is_plain = all(known.is_neutral(each) or known.is_limit(each) for each in outer)
    if not is_plain or not has_table(real) or hasattr(real, "action_masks"):
        return None
    return compile_table(real, step_limit(env), name)


def found_of(
    env: gym.Env[Any, Any],
    where: str = "env",
    name: str = "",
    **bounds: Any,
) -> Found:
    """What trying every action finds of an environment, wrappers included; `bounds`: see `enumerated`."""
    called = name or (env.spec.id if env.spec is not None else type(env.unwrapped).__name__)
    return enumerated(where, env, name=called, **bounds)


def found_by(make: Callable[[], Env], where: str = "env", name: str = "", **bounds: Any) -> Found:
    """The same of what a function makes, which must be the same world each time."""
    before = random_states()
    with closing(make()) as env:
        is_drawn = random_states() != before or _has_drawn(env)
        found, own = found_of(env, where, name, **bounds), traits(env)
    for _ in range(_IF_DRAWN if is_drawn else 1):
        with closing(make()) as again:
            if traits(again) == own:
                continue
            if found_of(again, where, name, **bounds).mdp.digest() != found.mdp.digest():
                raise InputError(
                    f"{where}: is another world each time it is made, so it cannot be solved exactly; "
                    "fix what it "
                    "draws by its arguments, or draw it in reset()"
                )
    return found


def _has_drawn(env: Env) -> bool:
    """Whether an environment that was just made has drawn from its own generator."""
    own: Any = env.unwrapped
    if (generator := vars(own).get("_np_random")) is None:
        return False
    seed = own._np_random_seed
    return seed is None or seed < 0 or state_of(seeding.np_random(seed)[0]) != state_of(generator)


def step_limit(env: gym.Env[Any, Any]) -> int | None:
    """The least step limit of an environment's wrappers; None: there is none."""
    limits = [int(vars(each)["_max_episode_steps"]) for each in layers_of(env) if known.is_limit(each)]
    return min((each for each in limits if each > 0), default=None)


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
