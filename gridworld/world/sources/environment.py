"""An environment of Gymnasium by its id, or in hand, as a world: by its table where it has one, else by
search.

A world here and a transition table are shortcuts: what they say is what trying every action would find.
"""

from __future__ import annotations

import importlib
import re
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import closing
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import seeding

from gridworld.base.errors import OLD_GYM, InputError, in_short, install_command
from gridworld.base.user_input import named_object
from gridworld.world.door import known
from gridworld.world.door.attributes import differing, layers_of, random_states, state_of
from gridworld.world.door.layers import Env
from gridworld.world.door.world import Found, enumerated, traits
from gridworld.world.mdp import Mdp
from gridworld.world.sources.gymnasium_table import compile_table, has_table

_IF_DRAWN, _OTHERS = 40, 8  # instances that are compared, if making one is seen to draw, and otherwise
_EACH = 2  # of those that differ in the same attributes, and not in a walk, so many are enumerated


def compile_id(
    env_id: str, kwargs: Mapping[str, Any] | None = None, *, by_table: bool = True, **bounds: Any
) -> Mdp:
    """Compile an environment by its transition table if it has one that its steps follow, else by search.

    Args:
        env_id: what `make_env` takes.
        kwargs: the arguments of what makes it.
        by_table: False: by search, even if it has a table.
        bounds: of the search, see `enumerated`.

    Returns:
        The world; of a search, its `truth` is "enumerated, N states", of what, and without which attributes.
        Its states are what a history of observations and rewards leaves open of the environment's own, see
        `beliefs`.
    """
    make, where = partial(make_env, env_id, kwargs), f"env.id={env_id}"
    mdp = None
    if by_table:
        with closing(make()) as env:
            mdp = shortcut(env, env_id)
    if mdp is None:
        return found_by(make, where, env_id, **bounds).mdp
    with closing(make()) as again:
        other = shortcut(again, env_id)
    if other is None or other.digest() != mdp.digest():
        raise InputError(
            f"{where}: has a different table each time it is made, so it cannot be solved exactly; fix it by "
            "env.kwargs, e.g. desc of a FrozenLake"
        )
    return mdp


def shortcut(env: gym.Env[Any, Any], name: str | None = None) -> Mdp | None:
    """The world of an environment's transition table, if no wrapper changes it and it has one; else None."""
    *outer, real = layers_of(env)
    is_plain = all(known.is_neutral(each) or known.is_limit(each) for each in outer)
    if not is_plain or not has_table(real) or hasattr(real, "action_masks"):
        return None
    return compile_table(real, step_limit(env), name)


def found_by(make: Callable[[], Env], where: str = "env", name: str = "", **bounds: Any) -> Found:
    """What trying every action finds of what a function makes, which must be the same world each time."""
    before = random_states()
    with closing(make()) as env:
        is_drawn = random_states() != before or _has_drawn(env)
        found, own = enumerated(where, env, name=name, **bounds), traits(env)
    met = Counter[tuple[Any, ...]]()  # how often others differed in what
    for _ in range(_IF_DRAWN if is_drawn else _OTHERS):
        with closing(make()) as again:
            classes, constant, walked = traits(again)
            names = tuple(differing(own[1], constant))
            is_alike = (classes, walked) == (own[0], own[2])
            if is_alike and (not names or met[names] == _EACH):
                continue
            met[names] += 1
            other = enumerated(where, again, name=name, **bounds)
            if other.mdp.shown_digest() != found.mdp.shown_digest():
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


def make_env(env_id: str, kwargs: Mapping[str, Any] | None = None, render_mode: str | None = None) -> Env:
    """Make an environment by its registered id, or by the name of a class or a function that makes one.

    "module:id" imports the module first; "module:NAME" and "folder/module.py:NAME" name what makes one.
    """
    env_id, arguments = str(env_id), dict(kwargs or {})
    where = f"env.id={env_id[:80]}"
    if arguments.get("render_mode") is not None:
        raise InputError(
            f"env.kwargs: render_mode={arguments['render_mode']} is not part of the world; leave it out"
        )
    name = env_id.rpartition(":")[2]
    found = named_object(where, env_id) if re.search(r":|\.py$", env_id) else None
    if found is not None:
        if not callable(found):
            raise InputError(
                f"{where}: is a {type(found).__name__}, must be a class or a function that makes one"
            )
        make: Callable[..., Any] = found
    else:
        make, defaults = _registered(where, env_id, name)
        if render_mode is None and "render_mode" in defaults:
            arguments["render_mode"] = None
    if render_mode is not None:  # which not every class takes
        arguments["render_mode"] = render_mode
    try:
        with np.errstate(all="ignore"):
            return as_environment(where, make(**arguments))
    except InputError:
        raise
    except Exception as error:  # as above
        shown = ", ".join(f"{key}: {value}" for key, value in arguments.items())[:100]
        given = f"env.kwargs={{{shown}}}: {env_id}" if arguments else f"{where}:"
        raise InputError(f"{given} cannot be made ({short_reason(error)})") from None


def _registered(where: str, env_id: str, name: str) -> tuple[Callable[..., Any], Mapping[str, Any]]:
    """What makes an environment by its id, whose module is imported, and its arguments."""
    if name.startswith(("MiniGrid-", "BabyAI-")):
        try:
            importlib.import_module("minigrid")  # registers them
        except ImportError:
            needed = f"needs the package minigrid; install it with {install_command('minigrid')}"
            raise InputError(f"{where}: {needed}") from None
    try:
        spec = gym.spec(name)
    except Exception as error:
        module = env_id.rpartition(":")[0]
        lacks = f"the module {module} has no {name}, nor is it registered" if module else "is not registered"
        reason = f" ({short_reason(error)})" if re.search(r"-v\d+$", name) else ""
        raise InputError(
            f"{where}: {lacks} with Gymnasium{reason}; give a registered id, e.g. FrozenLake-v1, or "
            "module:NAME of a class or a function that makes an environment"
        ) from None
    return partial(gym.make, name, disable_env_checker=True), spec.kwargs


def as_environment(where: str, made: Any, wanted: str = "a gymnasium.Env") -> Env:
    """What somebody's code made, which must be an environment of Gymnasium, with its spaces."""
    if isinstance(made, gym.Env):
        for name in ("observation_space", "action_space"):
            try:
                is_space = isinstance(getattr(made, name), gym.Space)
            except Exception:  # whatever its own code raises
                is_space = False
            if not is_space:
                raise InputError(f"{where}: its {name} is not a gymnasium space")
        return made
    is_old = any(kind.__module__.partition(".")[0] == "gym" for kind in type(made).__mro__)
    kind = type(made).__name__
    wrong = OLD_GYM if is_old else f"is not an environment; must be {wanted}"
    raise InputError(f"{where}: {kind} {wrong}")


def short_reason(error: BaseException) -> str:
    """What an exception says, in short."""
    return in_short(error).split(" was raised from the environment creator")[0].rstrip(" .")
