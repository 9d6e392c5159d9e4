"""What is known of the classes of others, by the class objects themselves, never by names alone."""

from __future__ import annotations

import inspect
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import wrappers
from gymnasium.utils import seeding

from gridworld.base.errors import InputError

Named = tuple[str, tuple[str, int, int] | None]  # what a reader calls a state, and its place
# Wrappers that change neither what is seen nor what happens; the second row is of others, if imported.
_NEUTRAL = (
    wrappers.AddWhiteNoise,
    wrappers.Autoreset,
    wrappers.HumanRendering,
    wrappers.ObstructView,
    wrappers.OrderEnforcing,
    wrappers.PassiveEnvChecker,
    wrappers.RecordEpisodeStatistics,
    wrappers.RecordVideo,
    wrappers.RenderCollection,
)
_NEUTRAL_ELSEWHERE = (("stable_baselines3.common.monitor", "Monitor"),)
_ONE_STEP = (gym.Wrapper, gym.ObservationWrapper, gym.RewardWrapper, gym.ActionWrapper)
_BLACKJACK = ("gymnasium.envs.toy_text.blackjack", "BlackjackEnv")
_FACING = ("right", "down", "left", "up")  # minigrid's directions
# What only draws, sounds or waits: it is no state.
_KEPT = (
    ("pygame.time", "Clock"),
    ("pygame", "Surface"),
    ("pygame.font", "Font"),
    ("pygame.freetype", "Font"),
    ("pygame.mixer", "Sound"),
    ("pygame.mixer", "Channel"),
    ("pygame.event", "Event"),
    ("pygame._sdl2.video", "Window"),
    ("logging", "Logger"),
)


def _loaded(names: tuple[tuple[str, str], ...]) -> tuple[Any, ...]:
    found = (getattr(sys.modules.get(module), name, None) for module, name in names)
    return tuple(each for each in found if each is not None)


def is_neutral(layer: Any) -> bool:
    """Whether a wrapper runs the step and the reset of a neutral class."""
    held = getattr(layer, "__dict__", {})
    return (
        "step" not in held
        and "reset" not in held
        and any(
            isinstance(layer, each) and type(layer).step is each.step and type(layer).reset is each.reset
            for each in (*_NEUTRAL, *_loaded(_NEUTRAL_ELSEWHERE))
        )
    )


def records(layer: Any) -> bool:
    """Whether a neutral wrapper adds to the `info` of a step."""
    return isinstance(layer, (wrappers.RecordEpisodeStatistics, *_loaded(_NEUTRAL_ELSEWHERE)))


def is_limit(layer: Any) -> bool:
    """Whether a wrapper is Gymnasium's time limit."""
    return type(layer) is wrappers.TimeLimit and "step" not in vars(layer) and "reset" not in vars(layer)


def reset_options(env: Any, has_layers: bool) -> dict[str, None]:
    """What a reset is given: what layers around it give, and what SB3 does in place of a seed of its own."""
    taken = inspect.signature(env.reset).parameters
    has_own = "seed" in taken and taken["seed"].default not in (None, inspect.Parameter.empty)
    return dict.fromkeys([*["options"] * has_layers, *["seed"] * has_own])


def steps_once(layer: Any) -> bool:
    """Whether a step of a wrapper is one step of what it wraps."""
    return "step" not in vars(layer) and any(type(layer).step is each.step for each in _ONE_STEP)


def is_kept(kind: type) -> bool:
    """Whether objects of a class are no state."""
    return issubclass(kind, _loaded(_KEPT))


def place_of(env: Any) -> Named:
    """The name of a state of MiniGrid's environments, and its place: which way, row and column."""
    place, direction = (getattr(env, name, None) for name in ("agent_pos", "agent_dir"))
    try:
        column, row = (int(each) for each in place)  # type: ignore[union-attr]
        facing = f"facing {_FACING[direction]}"  # type: ignore[index]
    except (TypeError, ValueError, IndexError):
        return "", None
    if carried := getattr(getattr(env, "carrying", None), "type", None):
        facing += f", carrying a {carried}"
    return f"row {row + 1}, column {column + 1}, {facing}", (facing, row, column)


def _hands(env: Any) -> Any:
    """Blackjack's hands: its rules read the sum of one, whether an ace may count 11, and a natural."""
    sums = [(sum(hand), 1 in hand, sorted(hand) == [1, 10]) for hand in (env.dealer, env.player)]
    return env.dealer[:1], *((total, ace and total <= 11, natural) for total, ace, natural in sums)


def state_reader(env: Any) -> Callable[[Any], Any] | None:
    """What the state of a known environment is, where its attributes hold more than matters."""
    return _hands if type(env) in _loaded((_BLACKJACK,)) else None


def _reset_blackjack(self: Any, *, seed: int | None = None, options: Any = None) -> Any:
    """Deals one hand for all that its rules take alike, without the suit and the face that are painted."""
    deck = sys.modules[_BLACKJACK[0]].deck
    pairs = [(one, other) for one in deck for other in deck]
    alike = [(1, sum(pair) - 1) if 1 in pair else (2, sum(pair) - 2) for pair in pairs]
    for name, hands in (("dealer", pairs), ("player", alike)):
        code = int(self.np_random.choice([100 * one + other for one, other in hands]))
        setattr(self, name, list(divmod(code, 100)))
    return self._get_obs(), {}


def _place_obj(
    self: Any, obj: Any, top: Any = None, size: Any = None, reject_fn: Any = None, **more: Any
) -> Any:
    """MiniGrid draws cells until one fits, and counts its tries: draw among those that fit instead."""
    left, upper = (max(each, 0) for each in top or (0, 0))
    wide, high = size or (self.grid.width, self.grid.height)
    cells = [
        (column, row)
        for column in range(left, min(left + wide, self.grid.width))
        for row in range(upper, min(upper + high, self.grid.height))
        if self.grid.get(column, row) is None
        and tuple(self.agent_pos) != (column, row)
        and not (reject_fn and reject_fn(self, (column, row)))
    ]
    cell = cells[int(self.np_random.integers(len(cells)))]
    self.grid.set(*cell, obj)
    if obj is not None:
        obj.init_pos = obj.cur_pos = cell
    return cell


# Methods of known classes that draw more than matters, and what is in their place while states are found.
_PATCHES: tuple[tuple[tuple[str, str], str, Callable[..., Any]], ...] = (
    (_BLACKJACK, "reset", _reset_blackjack),
    (("minigrid.minigrid_env", "MiniGridEnv"), "place_obj", _place_obj),
)


@contextmanager
def patched(env: Any, branching: Any) -> Iterator[None]:
    """Put these in place; and `branching` in place of each generator that is made without a seed."""
    generator, pair = np.random.default_rng, seeding.np_random
    with replaced(
        *(
            (kind, *patch)
            for known, *patch in _PATCHES
            for kind in _loaded((known,))
            if isinstance(env, kind)
        ),
        (np.random, "default_rng", lambda seed=None: branching if seed is None else generator(seed)),
        (seeding, "np_random", lambda seed=None: (branching, 0) if seed is None else pair(seed)),
    ):
        yield


@contextmanager
def replaced(*methods: Any) -> Iterator[None]:
    """In this block, what holds a name holds another thing by it: (holder, name, thing)."""
    originals = [(holder, name, getattr(holder, name)) for holder, name, _ in methods]
    for holder, name, method in methods:
        setattr(holder, name, method)
    try:
        yield
    finally:
        for holder, name, method in originals:
            setattr(holder, name, method)


_CLOCKS = ("time", "time_ns", "monotonic", "monotonic_ns", "perf_counter", "perf_counter_ns")
_OURS = str(Path(__file__).parents[2])


@contextmanager
def clock_watched() -> Iterator[set[str]]:
    """The places, as file and line, of others' code that call `time.time` and its like in this block.

    A function that somebody imported by its own name, and `datetime`, are not seen.
    """
    found, thread = set[str](), threading.get_ident()

    def called(read: Callable[[], Any]) -> Any:
        frame: FrameType | None = sys._getframe(1)
        assert frame is not None
        file, line = frame.f_code.co_filename, frame.f_lineno
        if file.startswith(_OURS) or threading.get_ident() != thread:
            return read()
        while frame is not None and not frame.f_code.co_filename.startswith("<frozen importlib"):
            frame = frame.f_back
        if frame is None:  # nothing is being imported
            found.add(f"{Path(file).name}:{line}")
        return read()

    with replaced(*((time, name, partial(called, getattr(time, name))) for name in _CLOCKS)):
        yield found


class _Sums(dict[str, Any]):
    """Stands for what a recording says of an episode: that it is over may be seen, and nothing else."""

    def _refuse(self, *_: Any) -> None:
        raise InputError(
            "env: a wrapper reads info['episode'] of a recording below it, which is left out; let it sum up "
            "what it needs itself"
        )


for _name in ("__missing__", "__len__", "__iter__", "__contains__", "get", "items", "keys", "values"):
    setattr(_Sums, _name, _Sums._refuse)


class Recorded(gym.Wrapper[Any, Any, Any, Any]):
    """Stands for a recording (Monitor, RecordEpisodeStatistics) below a wrapper with a step of its own."""

    def step(self, action: Any) -> Any:
        observation, reward, terminated, truncated, info = self.env.step(action)
        if terminated or truncated:
            info["episode"] = _Sums()
        return observation, reward, terminated, truncated, info
