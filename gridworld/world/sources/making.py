"""Making a Gymnasium environment from its id, with one sentence for what goes wrong."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import Any

import gymnasium as gym

from gridworld.errors import InputError

_PACKAGES = {"MiniGrid-": "minigrid", "BabyAI-": "minigrid"}  # which register ids that begin so


def make_env(
    env_id: str, kwargs: Mapping[str, Any] | None = None, render_mode: str | None = None
) -> gym.Env[Any, Any]:
    """Make an environment.

    Args:
        env_id: its registered id; "module:id" imports the module first.
        kwargs: the arguments of `gymnasium.make`.
        render_mode: how it renders.

    Raises:
        InputError: an unknown id, a package that is not installed, or arguments that it refuses.
    """
    for beginning, package in _PACKAGES.items():
        if env_id.startswith(beginning):
            _import(env_id, package)
    try:
        return gym.make(env_id, **{**(kwargs or {}), "render_mode": render_mode})
    except Exception as error:  # whatever a constructor raises
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise InputError(f"env.id={env_id}: cannot be made: {reason}") from error


def _import(env_id: str, package: str) -> None:
    try:
        importlib.import_module(package)
    except ImportError:
        raise InputError(
            f"env.id={env_id}: needs the package {package}; install it with "
            f"pip install 'gridworld-sb3[{package}]'"
        ) from None
