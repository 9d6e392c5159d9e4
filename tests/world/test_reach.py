"""What a method makes of its argument is known if all that it can come to is read, and stays as it is."""

import collections
import dataclasses
import datetime
import decimal
import enum
import functools
import itertools
import logging
import math
import os
import random
import secrets
import sys
import threading
import time
import warnings
from fractions import Fraction
from types import MappingProxyType, ModuleType, SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3.common.utils import ConstantSchedule, constant_fn

from gridworld.base.errors import InputError
from gridworld.world.reach import asked
from gridworld.world.reading import UnreadableError, digest

__all__ = ["os", "random", "secrets"]  # which texts below name
COUNT, CALLS, LOG = [0], SimpleNamespace(number=0), logging.getLogger("of a test")
TICKS, GENERATOR = itertools.count(), (number for number in range(10**6))
CART, DRAWS, TORCH_DRAWS = gym.make("CartPole-v1"), np.random.default_rng(0), torch.Generator()


class Meta(type):
    calls = 0


class Classed(metaclass=Meta):
    calls = 0

    @classmethod
    def paid(cls, reward: Any) -> float:
        cls.calls += 1
        return float(reward)


class Counter:
    """Hides its count from pickle."""

    count = 0

    def __getstate__(self) -> dict[str, Any]:
        return {}

    def __call__(self, reward: Any) -> float:
        self.count += 1
        return float(reward)


class Memo(dict[str, int]):
    def __reduce_ex__(self, protocol: Any) -> Any:
        return dict, ()


class Values(np.ndarray):
    pass


MEMO, VALUES = Memo(calls=0), np.zeros(1).view(Values)


def that(does: str, names: dict[str, Any] | None = None) -> Any:
    """A function of a reward that does something else too, with this module's names or others."""
    made: dict[str, Any] = {}
    exec(f"def paid(reward, seen=[]):\n    {does}\n    return float(reward)", names or globals(), made)
    if names is not None:
        names |= made
    return made["paid"]


def in_a_module() -> Any:
    """A function of a module without a file."""
    sys.modules["made_up"] = module = ModuleType("made_up")
    module.N = [0]  # type: ignore[attr-defined]
    return that("N[0] += 1", vars(module))


def by_closure(change: Any) -> Any:
    held = [0]

    def paid(reward: Any) -> float:
        held[0] = change(held[0])
        return float(reward)

    return paid


COUNTED = that("COUNT[0] += 1")


@functools.wraps(np.sum)
def pretending(reward: Any) -> Any:
    return COUNTED(reward)


@torch.no_grad()
def decorated(reward: Any) -> Any:
    return reward


def paying(function: Any) -> Any:
    return lambda env: gym.wrappers.TransformReward(env, function)


def own(reward: Any, **members: Any) -> Any:
    return type("Own", (gym.RewardWrapper,), {"reward": reward, **members})


def quietly(self: Any, reward: Any) -> float:
    try:
        return float(reward) - 0.1 * self.unwrapped.s
    except AttributeError:
        return float(reward)


def twice_in_a_row(self: Any, reward: Any) -> float:
    before, self.before = getattr(self, "before", None), reward
    return float(reward) + (before == reward == 0.5)


_MEMORY, _BELOW, _COUNTER = (
    "keeps memory",
    "reads from the environment below",
    "a Counter, whose __getstate",
)
REFUSED: dict[str, tuple[Any, str]] = {  # a wrapper, and what is said of it
    "a global": (paying(COUNTED), _MEMORY),
    "an object of a module": (paying(that("CALLS.number += 1")), _MEMORY),
    "a default": (paying(that("seen.append(reward)")), _MEMORY),
    "a class": (paying(Classed.paid), _MEMORY),
    "a metaclass": (paying(that("Meta.calls += 1")), _MEMORY),
    "an attribute of a function": (paying(that("COUNTED.n = getattr(COUNTED, 'n', 0) + 1")), _MEMORY),
    "an attribute of a library": (paying(that("math.n = getattr(math, 'n', 0) + 1")), _MEMORY),
    "a helper": (paying(lambda reward: COUNTED(reward)), _MEMORY),
    "a function that pretends": (paying(pretending), _MEMORY),
    "a cached function": (paying(functools.lru_cache(maxsize=0)(COUNTED)), _MEMORY),
    "a module without a file": (paying(in_a_module()), _MEMORY),
    "text without a module": (paying(that("N[0] += 1", {"N": [0]})), _MEMORY),
    "a closure": (paying(by_closure(lambda count: count + 1)), _MEMORY),
    "what comes back every other time": (paying(by_closure(lambda flag: 1 - flag)), _MEMORY),
    "what came before": (own(twice_in_a_row), "does not always give the same"),
    "the process's settings": (
        paying(that("os.environ['N'] = str(reward) + os.environ.get('N', '')")),
        "refers to posix",
    ),
    "an object that hides": (paying(Counter()), _COUNTER),
    "a method of one": (paying(Counter().__call__), _COUNTER),
    "a dictionary that hides": (paying(that("MEMO['calls'] += 1")), "a Memo, whose __reduce_ex__"),
    "an array of a custom class": (paying(that("VALUES[0] += 1")), "a Values, whose __reduce"),
    "a logger": (paying(that("LOG.n = getattr(LOG, 'n', 0) + 1")), "a Logger, whose __reduce"),
    "a count": (paying(that("next(TICKS)")), "a count, whose __reduce"),
    "a generator": (paying(that("next(GENERATOR)")), "a generator, which cannot be read"),
    "random numbers": (paying(that("DRAWS.random()")), "Generator.random"),
    "the process's random numbers": (paying(that("random.random()")), "random"),
    "numpy's random numbers": (paying(that("np.random.rand()")), "rand"),
    "secrets": (paying(that("secrets.randbelow(9)")), "refers to"),
    "torch": (paying(decorated), "refers to"),
    "torch's random numbers": (paying(that("torch.rand(1, generator=TORCH_DRAWS)")), "refers to"),
    "a clock": (paying(that("time.monotonic()")), "time.monotonic"),
    "a clock imported there": (paying(that("import time as clock; clock.time()")), "time.time"),
    "a date": (paying(that("datetime.datetime.now()")), "datetime.now"),
    "a file": (paying(that("open('/dev/null').read()")), "open"),
    "another environment": (paying(that("CART.render_mode")), "another environment"),
    "a drawn action": (own(lambda self, reward: reward + 0 * self.action_space.sample()), _MEMORY),
    "the state": (own(lambda self, reward: reward + self.unwrapped.s), _BELOW),
    "the state, or nothing": (own(quietly), _BELOW),
    "a count below": (own(lambda self, reward: reward + self.env.total_steps), _BELOW),
}


def asked_of(wrapper: Any) -> list[Any]:
    return asked("env", wrapper(gym.make("FrozenLake-v1")), "reward", [0.0, 0.5, 1.0])


@pytest.mark.parametrize("what", REFUSED)
def test_what_is_no_function_of_its_argument_is_refused(what: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("N", "")
    wrapper, told = REFUSED[what]
    with pytest.raises(InputError, match=f"^env: reward.. of .* .*{told}") as refused:
        asked_of(wrapper)
    assert "\n" not in str(refused.value)


@dataclasses.dataclass(frozen=True)
class Scaled:
    factor: float

    @functools.cached_property
    def doubled(self) -> float:
        return 2 * self.factor

    def __call__(self, reward: Any) -> float:
        return float(reward) * self.doubled / 2


class Kind(enum.Enum):
    EARLY = 3.0


Weights = collections.namedtuple("Weights", "goal trap")
WEIGHTS, TABLE = Weights(3.0, -1.0), MappingProxyType({0.0: 0.0, 0.5: 1.5, 1.0: 3.0})


def tripled(reward: Any, by: float = 3.0) -> float:
    import math as m

    return m.fsum([reward] * int(by))


PURE: dict[str, Any] = {  # three times the reward
    "a lambda": lambda reward: 3 * reward,
    "an object": Scaled(3.0),
    "numpy": lambda reward: np.multiply(np.float64(3), reward) * np.sign(np.ones(1))[0],
    "math": lambda reward: math.exp(math.log(3)) * reward if math.isfinite(reward) else 0.0,
    "a helper": lambda reward: tripled(reward),
    "a default": tripled,
    "a partial": functools.partial(tripled, by=3.0),
    "tables": lambda reward: TABLE[reward] + 0 * len(COUNT),
    "an enumeration": lambda reward: Kind.EARLY.value * reward,
    "a named tuple": lambda reward: WEIGHTS.goal * reward,
    "fractions": lambda reward: float(Fraction(3) * Fraction(reward)),
    "a cached helper": functools.lru_cache(tripled),
    "a class made on the way": lambda reward: Scaled(3.0)(reward),
    "a library's": lambda reward: ConstantSchedule(3.0)(0.0) * reward,
}


@pytest.mark.parametrize("what", PURE)
def test_a_function_of_its_argument_is_asked(what: str) -> None:
    assert asked_of(paying(PURE[what])) == pytest.approx([0.0, 1.5, 3.0])
    unused = {
        "logger": LOG,
        "close": lambda self: print(time.time(), LOG),
        "render": lambda self: CART.render(),
    }
    member = own(
        lambda self, reward: self.by(reward) * 3 / self.time, by=staticmethod(PURE[what]), time=3, **unused
    )
    assert asked_of(member) == pytest.approx([0.0, 1.5, 3.0])


def constant(value: float) -> Any:
    """A closure of an installed library."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return constant_fn(value)


class Slotted:
    __slots__ = ("held",)

    def __init__(self, held: int) -> None:
        self.held = held


class Bag(dict[str, int]):
    def __init__(self, held: int) -> None:
        self.held = held


UNREADABLE = [
    *(torch.zeros(1), torch.nn.Parameter(torch.zeros(1)), TORCH_DRAWS, np.ma.array([1], mask=[0]), VALUES),
    *(
        iter([1]),
        itertools.count(),
        threading.Lock(),
        LOG,
        random.SystemRandom(),
        type("D", (decimal.Decimal,), {})(),
    ),
]
DIFFERENT: dict[str, Any] = {
    "spaces": gym.spaces.Discrete,
    "closures": lambda k: lambda: k,
    "functions of a library": constant,
    "slots": Slotted,
    "a dictionary's attributes": Bag,
    "a table in order": lambda k: {1: 0, 2: 0} if k == 1 else {2: 0, 1: 0},
    "arrays": lambda k: np.full((2, 2), k),
    "types of numbers": lambda k: np.zeros((2, 2), np.int8 if k == 1 else np.uint8),
    "decimals": decimal.Decimal,
    "dates": lambda k: datetime.date(2020, 1, k),
    "numpy's dates": lambda k: np.datetime64(f"2020-01-0{k}"),
    "whether it is the same list": lambda k: [a := [0], a] if k == 1 else [[0], [0]],
}


def test_what_differs_is_told_apart_or_refused() -> None:
    for value in UNREADABLE:
        with pytest.raises(UnreadableError):
            digest([value])
    for name, make in DIFFERENT.items():
        assert digest(make(1)) != digest(make(2)), name
    assert digest((1, 2)) == digest([1, 2]) == digest(np.array([1, 2]))
