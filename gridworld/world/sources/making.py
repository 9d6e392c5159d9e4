"""Making a Gymnasium environment from its id, with one sentence for what goes wrong."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np

from gridworld.errors import InputError, in_short, install_command

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
