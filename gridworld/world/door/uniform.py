"""A number from an interval that is not drawn: what it is compared with splits the interval."""

from __future__ import annotations

import itertools
import math
from bisect import bisect_left
from collections.abc import Callable, Iterable
from fractions import Fraction
from functools import lru_cache
from numbers import Real
from typing import TYPE_CHECKING, Any

import numpy as np

from gridworld.world.mdp import IntArray

if TYPE_CHECKING:
    from gridworld.world.door.branching import Branching

Weights = tuple[int, ...]  # of outcomes, in proportion to their probabilities

MOST_OUTCOMES = 10_000  # of one draw
_MOST_SHIFTED = 2**16  # times its width that an interval may be away from 0, where floats are rounded
_WIDEST = 2**500  # an interval, near which floats overflow


def weights_of(probabilities: Iterable[Fraction]) -> Weights:
    """Probabilities as whole numbers, by their common denominator."""
    found = list(probabilities)
    common = math.lcm(*(each.denominator for each in found))
    return tuple(each.numerator * (common // each.denominator) for each in found)


@lru_cache(256)
def _split(
    low: Fraction, high: Fraction, scale: Fraction, offset: Fraction, thresholds: tuple[float, ...]
) -> tuple[list[Fraction], Weights, IntArray]:
    """Edges of the parts of [low, high) in which `scale` * u + `offset` is on one side of each threshold.

    With the weights of the parts, and the number of edges that are below each threshold.
    """
    cuts = [(Fraction(each) - offset) / scale for each in thresholds]
    edges = [low, *sorted({cut for cut in cuts if low < cut < high}), high]
    weights = weights_of(end - start for start, end in itertools.pairwise(edges))
    return edges, weights, np.array([bisect_left(edges, cut) for cut in cuts], dtype=np.int64)


class Uniform:
    """`scale` * u + `offset`, where all that is known of u is the interval of [0, 1) that it is in."""

    __slots__ = ("_branching", "_drawn", "_interval", "_is_numpys", "_offset", "_run", "_scale")

    def __init__(
        self,
        branching: Branching,
        drawn: str,
        interval: list[Fraction],
        scale: Fraction,
        offset: Fraction,
        is_numpys: bool,
    ) -> None:
        self._is_numpys = is_numpys  # a scalar of numpy's, whose comparisons are numpy's too
        self._branching, self._run, self._drawn = branching, branching.run, drawn
        self._interval, self._scale, self._offset = interval, scale, offset
        width = abs(scale)
        if width and not (abs(offset) <= _MOST_SHIFTED * width and 1 <= width * _WIDEST <= _WIDEST**2):
            self._refuse()

    def parts(self) -> tuple[Any, ...]:
        """What is known of it, for a copy."""
        return tuple(self._interval), self._scale, self._offset, self._is_numpys

    @classmethod
    def of_earlier(cls, branching: Branching, interval: Any, *rest: Any) -> Uniform:
        """One of an earlier step."""
        found = cls(branching, "in an earlier step", list(interval), *rest)
        found._run = -1
        return found

    def _refuse(self, *_: Any, **__: Any) -> Any:
        self._branching.refuse(
            "a random number is used for more than comparisons with thresholds", drawn=self._drawn
        )

    __float__ = __bool__ = __complex__ = __index__ = __round__ = __hash__ = __str__ = __repr__ = _refuse
    __eq__ = __ne__ = __abs__ = __pow__ = __rpow__ = __mod__ = __rmod__ = __floordiv__ = _refuse
    __rfloordiv__ = __divmod__ = __rdivmod__ = __rtruediv__ = __ceil__ = __format__ = _refuse
    __reduce_ex__ = _refuse
    __class__ = property(lambda _: float)  # as one that asks sees it

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return self._refuse()

    def _refuse_narrow(self, other: Any) -> None:
        """Numpy rounds a random number to fewer bits for one of fewer bits, which shifts the threshold."""
        if getattr(other, "dtype", None) in _OTHER_FLOATS:
            self._branching.refuse(
                f"a random number meets a {other.dtype}, to which it is rounded", "; use float64", self._drawn
            )

    def _among(self, thresholds: Iterable[float]) -> tuple[int, IntArray]:
        """Split the interval at thresholds; the number of the part that u is in, and see `_split`."""
        if self._run != self._branching.run:
            self._branching.refuse("a random number is kept beyond its step", drawn=self._drawn)
        edges, weights, below = _split(*self._interval, self._scale, self._offset, tuple(thresholds))
        part = 0
        if len(weights) > 1:
            if len(weights) >= MOST_OUTCOMES:
                self._refuse()
            part = self._branching.decide(weights)
            self._interval[:] = edges[part : part + 2]
        return part, below

    def _is_below(self, threshold: Any) -> Any:
        """Whether it is less than a threshold, or than each of an array."""
        if threshold is self:  # numpy's search compares what it looks for with itself
            return False
        given = np.asarray(threshold)
        self._refuse_narrow(given)
        is_number = not isinstance(threshold, list | tuple) and given.dtype.kind in "biuf"
        if not is_number or self._scale == 0 or np.isnan(given).any():
            self._refuse()
        found, is_finite = np.array(given > 0), np.isfinite(given)  # of what is infinite, the sign says it
        part, below = self._among(given[is_finite].tolist())
        found[is_finite] = (below > part) == (self._scale > 0)
        if given.ndim:
            return found
        return np.bool_(found) if self._is_numpys or isinstance(threshold, _NUMPYS) else bool(found)

    __lt__ = __le__ = _is_below  # to be just at a threshold has no probability

    def _is_above(self, threshold: Any) -> Any:
        below = self._is_below(threshold)
        return np.logical_not(below) if isinstance(below, _NUMPYS) else not below

    __gt__ = __ge__ = _is_above

    def __floor__(self) -> int:
        edges = [self._scale * each + self._offset for each in self._interval]
        whole = range(math.floor(min(edges)), math.ceil(max(edges)))
        if self._scale == 0 or len(whole) > MOST_OUTCOMES:
            self._refuse()
        self._among(whole)
        middle = sum(self._interval) / 2
        return math.floor(self._scale * middle + self._offset)

    def __int__(self) -> int:
        if min(self._scale * each + self._offset for each in self._interval) < 0:  # not rounded down
            self._refuse()
        return self.__floor__()

    __trunc__ = __int__

    def _changed(self, other: Any, change: Callable[[Fraction], tuple[Fraction, Fraction]]) -> Any:
        if isinstance(other, np.ndarray) and other.ndim:
            return self._refuse()
        if not isinstance(other, Real | np.ndarray) or not math.isfinite(other):
            return self._refuse()
        self._refuse_narrow(other)
        scale, offset = change(Fraction(float(other)))
        is_numpys = self._is_numpys or isinstance(other, _NUMPYS)
        return Uniform(self._branching, self._drawn, self._interval, scale, offset, is_numpys)

    def __add__(self, other: Any) -> Any:
        return self._changed(other, lambda number: (self._scale, self._offset + number))

    def __mul__(self, other: Any) -> Any:
        return self._changed(other, lambda number: (self._scale * number, self._offset * number))

    def __truediv__(self, other: Any) -> Any:
        return self._changed(other, lambda number: (self._scale / number, self._offset / number))

    def __sub__(self, other: Any) -> Any:
        return self._changed(other, lambda number: (self._scale, self._offset - number))

    def __rsub__(self, other: Any) -> Any:
        return self._changed(other, lambda number: (-self._scale, number - self._offset))

    def __neg__(self) -> Any:
        return 0 - self

    __radd__, __rmul__ = __add__, __mul__

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **options: Any) -> Any:
        """What numpy makes of it, with an array or a number on either side."""
        name = ufunc.__name__
        if options:  # such as `out`
            return self._refuse()
        if method == "__call__" and name in ("floor", "trunc"):
            return np.float64(self.__floor__() if name == "floor" else self.__int__())
        if method != "__call__" or len(inputs) != 2 or name not in OPERATIONS:
            return self._refuse()
        ours, theirs = OPERATIONS[name]
        one, other = inputs
        if isinstance(one, Uniform):
            return self._refuse() if isinstance(other, Uniform) else getattr(one, ours)(other)
        return getattr(other, theirs)(one)


_NUMPYS = (np.generic, np.ndarray)
_OTHER_FLOATS = [np.dtype(each) for each in (np.float16, np.float32, np.longdouble)]
OPERATIONS = {  # by the name of numpy's function: for it on the left, and on the right
    "less": ("__lt__", "__gt__"),
    "less_equal": ("__le__", "__ge__"),
    "greater": ("__gt__", "__lt__"),
    "greater_equal": ("__ge__", "__le__"),
    "equal": ("__eq__", "__eq__"),
    "not_equal": ("__ne__", "__ne__"),
    "add": ("__add__", "__radd__"),
    "multiply": ("__mul__", "__rmul__"),
    "subtract": ("__sub__", "__rsub__"),
    "true_divide": ("__truediv__", "__rtruediv__"),
    "divide": ("__truediv__", "__rtruediv__"),
}
