"""A method that could remember something, wherever it keeps that, is not a function of its argument alone."""

import dataclasses
import functools
import itertools
import sys
from types import ModuleType
from typing import Any

import gymnasium as gym
import matplotlib
import numpy as np
import pytest
import torch

from gridworld.errors import InputError
from gridworld.world.snapshots import alike, asked

TOTAL = [0]
MODULE = sys.modules[__name__]
TICKS, GENERATOR = itertools.count(), (number for number in range(10**6))
CART = gym.make("CartPole-v1")


class Counter:
    """Hides its count from pickle."""

    count = 0

    def __getstate__(self) -> dict[str, Any]:
        return {}

    def __call__(self, reward: Any) -> float:
        self.count += 1
        return float(reward) + (self.count > 10**9)


class Shared:
    calls = 0

    @classmethod
    def paid(cls, reward: Any) -> float:
        cls.calls += 1
        return float(reward)


def counted(reward: Any) -> float:
    TOTAL[0] += 1
    return float(reward)


def by_default(reward: Any, seen: list[Any] = []) -> float:  # noqa: B006
    seen.append(reward)
    return float(reward)


def by_closure() -> Any:
    count = 0

    def paid(reward: Any) -> float:
        nonlocal count
        count += 1
        return float(reward)

    return paid


@functools.wraps(np.sum)
def pretending(reward: Any) -> Any:
    TOTAL[0] += 1
    return reward


@functools.lru_cache(maxsize=0)
def cached(reward: Any) -> Any:
    TOTAL[0] += 1
    return reward


SOURCE = "N = [0]\ndef reward(reward):\n    N[0] += 1\n    return reward"


def executed() -> Any:
    """A function of no module."""
    names: dict[str, Any] = {}
    exec(SOURCE, names)
    return names["reward"]


def made_up() -> Any:
    """A function of a module without a file."""
    sys.modules["made_up"] = module = ModuleType("made_up")
    exec(SOURCE, vars(module))
    return vars(module)["reward"]


@torch.no_grad()
def decorated(reward: Any) -> Any:
    TOTAL[0] += 1
    return reward


@dataclasses.dataclass(frozen=True)
class Scaled:
    factor: float

    @functools.cached_property
    def doubled(self) -> float:
        return 2 * self.factor

    def __call__(self, reward: Any) -> float:
        return float(reward) * self.doubled / 2


class Sampling(gym.RewardWrapper[Any, Any]):
    def reward(self, reward: Any) -> float:
        self.action_space.sample()
        return float(reward)


def asked_of(function: Any) -> list[Any]:
    env = gym.make("FrozenLake-v1")
    wrapper = Sampling(env) if function is Sampling else gym.wrappers.TransformReward(env, function)
    return asked("env", wrapper, "reward", [0.0, 1.0], [wrapper, env, env.unwrapped])


@pytest.mark.parametrize(
    ("function", "told"),
    [
        (Counter(), "keeps memory"),
        (Counter().__call__, "keeps memory"),
        (Shared.paid, "keeps memory"),
        (counted, "keeps memory"),
        (Sampling, "draws random numbers"),
        (lambda reward: counted(reward), "keeps memory"),
        (by_default, "keeps memory"),
        (pretending, "keeps memory"),
        (decorated, "keeps memory"),
        (cached, "keeps memory"),
        (executed(), "keeps memory"),
        (made_up(), "keeps memory"),
        (by_closure(), "keeps memory"),
        (lambda reward: MODULE.counted(reward), "keeps memory"),
        (lambda reward: float(reward) + 0 * next(TICKS), "keeps memory"),
        (lambda reward: float(reward) + 0 * next(GENERATOR), "cannot be read"),
        (lambda reward: float(reward) + (CART.render_mode is None), "reads from an environment"),
    ],
)
def test_a_memory_is_found_wherever_it_is_kept(function: Any, told: str) -> None:
    with pytest.raises(InputError, match=f"^env: .*reward.. of .* .*{told}"):
        asked_of(function)


def test_a_function_of_its_argument_is_asked() -> None:
    assert asked_of(lambda reward: 2 * reward - len(TOTAL)) == [-1.0, 1.0]
    assert asked_of(Scaled(3.0)) == [0.0, 3.0]
    # code of installed packages is not read, whatever it holds
    assert asked_of(lambda reward: pytest.approx(reward).expected + len(matplotlib.colormaps) * 0) == [0, 1]


def test_what_is_made_alike() -> None:
    def made(factor: float) -> Any:
        return gym.wrappers.TransformReward(gym.make("FrozenLake-v1"), lambda reward: factor * reward)

    assert alike(made(2.0), made(2.0), ("env",))
    assert not alike(made(2.0), made(3.0), ("env",))
    assert not alike(made(2.0), made(2.0).env)
