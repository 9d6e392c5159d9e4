"""Making a Gymnasium environment from its id, with one sentence for what goes wrong."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np

from gridworld.errors import InputError

_PACKAGES = {"MiniGrid-": "minigrid", "BabyAI-": "minigrid"}  # which register ids that begin so


def make_env(
    env_id: str, kwargs: Mapping[str, Any] | None = None, render_mode: str | None = None
) -> gym.Env[Any, Any]:
    """Make an environment of Gymnasium.

    Args:
        env_id: its registered id; "module:id" imports the module first.
        kwargs: the arguments of `gymnasium.make`.
        render_mode: how it renders.

    Raises:
        InputError: an unknown id, a package that is not installed, or arguments that it refuses.
    """
    arguments = dict(kwargs or {})
    if arguments.get("render_mode") is not None:
        raise InputError(
            f"env.kwargs: render_mode={arguments['render_mode']} is no part of the world; leave it out"
        )
    for beginning, package in _PACKAGES.items():
        if str(env_id).startswith(beginning):
            _import(env_id, package)
    try:
        spec = gym.spec(env_id)
    except Exception as error:  # an id may name a module, which may raise anything
        raise InputError(
            f"env.id={str(env_id)[:80]}: is no environment that Gymnasium knows ({told(error)}); give a "
            "registered id, e.g. FrozenLake-v1"
        ) from None
    try:
        with np.errstate(all="ignore"):
            return gym.make(env_id, **{"disable_env_checker": True, **arguments, "render_mode": render_mode})
    except Exception as error:  # as above
        given = f"env.kwargs={_shown(arguments)}: {env_id}" if arguments else f"env.id={env_id}:"
        takes = _arguments(spec) if arguments else ""
        raise InputError(f"{given} cannot be made ({told(error)}){takes}") from None


def told(error: Exception) -> str:
    """What an exception says, in short."""
    text = str(error).split(" was raised from the environment creator")[0].strip().splitlines()
    kind = type(error).__name__
    return f"{kind}: {text[0][:200].rstrip(' .')}" if text else kind


def _shown(arguments: Mapping[str, Any]) -> str:
    return "{" + ", ".join(f"{key}: {value}" for key, value in arguments.items())[:100] + "}"


def _arguments(spec: Any) -> str:
    """What an environment can be made with, as the end of a sentence."""
    from gymnasium.envs.registration import load_env_creator

    try:
        point = spec.entry_point
        parameters = inspect.signature(
            load_env_creator(point) if isinstance(point, str) else point
        ).parameters
    except Exception:
        return "; see its documentation"
    names = [name for name in parameters if name not in ("self", "render_mode")]
    return f"; it takes {', '.join(names)}" if names else "; it takes no arguments"


def _import(env_id: str, package: str) -> None:
    try:
        importlib.import_module(package)
    except ImportError:
        raise InputError(
            f"env.id={env_id}: needs the package {package}; install it with "
            f"pip install 'gridworld-sb3[{package}]'"
        ) from None
