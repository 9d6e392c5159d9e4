"""What stands for a time limit or a recording that is left out, below a wrapper with a step of its own."""

from __future__ import annotations

from typing import Any

import gymnasium as gym

from gridworld.base.errors import InputError


class Timed(BaseException):  # which an environment's `except Exception` does not catch
    """A wrapper reads or changes what a time limit below it does, so that its count is state."""


class Limited(gym.Wrapper[Any, Any, Any, Any]):
    """Stands for a time limit: it counts the steps of one step, and cuts the episode when it is told to."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self.steps, self.cuts = 0, False

    def step(self, action: Any) -> Any:
        observation, reward, terminated, truncated, info = self.env.step(action)
        self.steps += 1
        return observation, reward, terminated, truncated or self.cuts, info

    @property
    def _elapsed_steps(self) -> int:
        raise Timed


class _Told(dict[str, Any]):
    """The `info` of a step, below a wrapper that may look for what a recording adds to it."""

    def __contains__(self, key: object) -> bool:
        if key == "episode":
            raise InputError(
                "env: a wrapper reads info['episode'] of a recording below it, which is left out; let it "
                "sum up "
                "what it needs itself"
            )
        return super().__contains__(key)

    def __getitem__(self, key: str) -> Any:
        if key in self:
            return super().__getitem__(key)
        raise KeyError(key)

    def get(self, key: str, default: Any = None) -> Any:
        return super().__getitem__(key) if key in self else default


class Recorded(gym.Wrapper[Any, Any, Any, Any]):
    """Stands for a recording (Monitor, RecordEpisodeStatistics) below a wrapper with a step of its own."""

    def step(self, action: Any) -> Any:
        *shown, info = self.env.step(action)
        return *shown, _Told(info)
