"""Numbers of settings: their bounds, outside of which they are refused in a sentence, and rates that fall."""

from __future__ import annotations

import math
import operator
from dataclasses import dataclass
from numbers import Real
from typing import Any

from gridworld.base.errors import InputError

MOST_ENVS = 2**17  # eight times the largest batch that any measurement here is faster with
STEP_LIMIT = 100  # steps of an episode, where neither the world nor a setting says another
MOST_STEPS = 100_000  # of an episode; an evaluation goes through all of them
LARGEST_INTEGER = 2**63  # beyond, neither arrays nor the files of a run have them
_LARGEST_EXACT = 2.0**53  # a float beyond may stand for several whole numbers
NEAREST_GAMMA = 1 - 1e-11  # to 1, but for 1 itself
LINEAR = "lin_"  # lin_0.003: from 0.003 at the start, linearly, to 0 at the end, as RL Zoo writes it
_POWERS = {LINEAR: 1.0, "sqrt_": 0.5, "quad_": 2.0}  # of what is left of training, by a schedule's prefix


@dataclass(frozen=True)
class Bounds:
    """A finite number from `low` to `high`; where `above`, not `low` itself."""

    low: float = -math.inf
    high: float = math.inf
    above: bool = False
    least: float = 0.0  # size of a number other than 0

    def check(self, key: str, number: float, written: object = None) -> None:
        """Refuse a number outside; `written` is how the setting has it."""
        if not isinstance(number, Real) or isinstance(number, bool):
            raise InputError(f"{key}={str(number)[:50]}: must be a number, {self}")
        is_high_enough = self.low < number if self.above else self.low <= number
        is_large_enough = number == 0 or abs(number) >= self.least
        if not (is_high_enough and is_large_enough and number <= self.high and abs(number) < math.inf):
            raise InputError(f"{key}={number if written is None else written}: must be {self}")
        if isinstance(number, int) and abs(number) >= LARGEST_INTEGER:
            raise InputError(f"{key}={number}: must be smaller than 2**63")

    def __str__(self) -> str:
        low = f"above {self.low}" if self.above else f"at least {self.low}"
        if self.least:
            return f"0, or from {self.least:g} to {self.high:g} in absolute value"
        if self.low == -math.inf:
            return "a finite number" if self.high == math.inf else f"at most {self.high}"
        if self.high == math.inf:
            return low
        return f"{low} and at most {self.high}" if self.above else f"from {self.low} to {self.high}"


@dataclass(frozen=True)
class Rate(Bounds):
    """The same of a rate, from 0: of a number that may fall over training (`parse_schedule`)."""

    low: float = 0
    linear_only: bool = False

    def check(self, key: str, number: Any, written: object = None) -> None:
        super().check(key, parse_schedule(key, number, self.linear_only).initial, number)


@dataclass(frozen=True)
class Decay:
    """A rate over training."""

    initial: float  # at the start, finite and not negative
    power: float  # of the share of training that is left, with which it falls to 0; with 0 it stays

    def at(self, progress: float) -> float:
        """The rate after this share of training, from 0 to 1."""
        return float(self.initial * (1 - progress) ** self.power)


def falls(value: object) -> bool:
    """Whether a setting's value is written as a rate that falls, as `lin_NUMBER` is."""
    return isinstance(value, str) and value.startswith(tuple(_POWERS))


def parse_schedule(key: str, value: int | float | str, linear_only: bool = False) -> Decay:
    """Read a rate: a number, or one of `lin_NUMBER`, `sqrt_NUMBER` and `quad_NUMBER`, which fall.

    `key` is for the message; with `linear_only` the last two are refused.
    """
    form, digits = "", value
    if isinstance(value, str):
        form = next((form for form in _POWERS if value.startswith(form)), "")
        digits = value.removeprefix(form) if form and "_" not in value.removeprefix(form) else "nan"
    try:
        number = math.nan if isinstance(value, bool) else float(digits)
    except (ValueError, OverflowError):
        number = math.nan
    if not 0 <= number < math.inf or (linear_only and form not in ("", LINEAR)):
        others = "" if linear_only else " (sqrt_, quad_: for one by a root or a square)"
        raise InputError(
            f"{key}={value}: must be a number of at least 0, or {LINEAR}NUMBER for a linear decay{others}"
        )
    return Decay(number, _POWERS.get(form, 0.0))


@dataclass(frozen=True)
class Discount(Bounds):
    """A number from 0 to 1, and not so near to 1 that double precision loses the cost of a step."""

    low: float = 0
    high: float = 1

    def check(self, key: str, number: Any, written: object = None) -> None:
        super().check(key, number, written)
        if NEAREST_GAMMA < number < 1:
            raise InputError(
                f"{key}={number}: is so close to 1 that rounding hides the cost of a step; must be 1 or at "
                f"most {NEAREST_GAMMA}"
            )


def digits(text: str) -> str:
    """A number as people write it, a whole one without point and exponent: 1e5 as 100000; or `ValueError`."""
    number = float(text)
    is_whole = number.is_integer() and abs(number) <= _LARGEST_EXACT
    return str(int(number)) if is_whole and not text.lstrip("+-").isdecimal() else text


def positive_int(what: str, value: Any) -> int:
    """A whole number of at least 1 as an int; refuses bools, floats and strings."""
    try:
        number = None if isinstance(value, bool) else operator.index(value)
    except TypeError:
        number = None
    if number is None or number < 1:
        raise InputError(f"{what}={value!r}: must be a whole number of at least 1")
    return number
