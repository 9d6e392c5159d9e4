"""Frames of a world that was made from a Gymnasium environment, rendered by that environment itself."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import gymnasium as gym
import numpy as np
from PIL import Image

from gridworld.envs.rendering import Frame, import_pygame
from gridworld.errors import InputError, in_short
from gridworld.world.mdp import Mdp
from gridworld.world.sources.gymnasium_table import make_env

_MOST_PIXELS = 512 * 512
_OFF_SCREEN = {"SDL_VIDEODRIVER": "dummy", "SDL_AUDIODRIVER": "dummy"}


class RealEnvFrames:
    """Renders episodes, in frames of at most `max_pixels`.

    An environment with a transition table is put into each state. Others are enumerated: from a reset on, the
    actions that lead through the states are taken.
    """

    def __init__(
        self, env_id: str, kwargs: Mapping[str, Any] | None = None, max_pixels: int = _MOST_PIXELS
    ) -> None:
        self._env_id, self._kwargs, self._max_pixels = env_id, dict(kwargs or {}), max_pixels

    def episode(self, mdp: Mdp, states: Sequence[int]) -> list[Frame]:
        """Frames (height, width, 3), uint8, RGB, of an episode's states, of which the first is a start."""
        with _off_screen():
            env = make_env(self._env_id, self._kwargs, render_mode="rgb_array")
            try:
                env.reset(seed=0)
                return [self._frame(env) for _ in _walk(env, mdp, states)]
            except InputError:
                raise
            except Exception as error:  # whatever it raises
                raise InputError(f"env.id={self._env_id}: cannot be rendered: {in_short(error)}") from error
            finally:
                env.close()

    def _frame(self, env: gym.Env[Any, Any]) -> Frame:
        frame = np.asarray(env.render(), dtype=np.uint8)
        height, width = frame.shape[:2]
        if height * width <= self._max_pixels:
            return frame.copy()
        scale = (self._max_pixels / (height * width)) ** 0.5
        size = max(1, int(width * scale)), max(1, int(height * scale))
        return np.asarray(Image.fromarray(frame).resize(size, Image.Resampling.BOX))


def _walk(env: gym.Env[Any, Any], mdp: Mdp, states: Sequence[int]) -> Iterator[None]:
    """Put the environment into one state after the other."""
    real: Any = env.unwrapped
    for before, state in zip([None, *states], states, strict=False):
        if hasattr(real, "P"):
            real.s, real.lastaction = int(mdp.number[state]), None
        elif before is not None:
            leading = np.flatnonzero(mdp.next_state[before, :, 0] == state)
            if not leading.size:
                raise InputError(
                    f"{mdp.name}: no action leads from {mdp.state_name(before)} to {mdp.state_name(state)}"
                )
            env.step(int(leading[0]))
        yield


@contextmanager
def _off_screen() -> Iterator[None]:
    """Without a display and a sound card, which environments look for, unless pygame has a display."""
    pygame = import_pygame()
    if pygame.display.get_init():
        yield
        return
    before = {name: os.environ.get(name) for name in _OFF_SCREEN}
    os.environ.update(_OFF_SCREEN)
    try:
        yield
    finally:
        pygame.quit()
        for name, value in before.items():
            os.environ.pop(name)
            os.environ.update({} if value is None else {name: value})
