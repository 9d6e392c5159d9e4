"""A random generator that takes every outcome of every draw in turn, each with its probability.

It is put in place of an environment's `np_random`. A step is run once for each sequence of decisions, from
the same state, depth first. `random()` and `uniform()` return a number that is not drawn: a comparison with a
threshold, or its whole part, splits the interval that it is in. Probabilities are fractions of the floats
that the environment gives. A draw that has too many outcomes, and a number that is used otherwise, is refused
with the file and line that drew it.
"""

from __future__ import annotations

import itertools
import math
import sys
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from numbers import Real
from typing import Any, NoReturn, TypeVar

import numpy as np
from numpy.typing import NDArray

from gridworld.base.errors import InputError
from gridworld.world.door import uniform
from gridworld.world.door.uniform import MOST_OUTCOMES, Uniform, Weights, weights_of
from gridworld.world.mdp import IntArray

OURS = {__file__, uniform.__file__}  # files whose lines are not the environment's
Result = TypeVar("Result", bound=Hashable)
Share = tuple[int, int]  # of all outcomes: numerator and denominator, not in lowest terms

_MOST_DRAWS = 500  # of one step; a loop that rejects what it draws may have any number
MOST_BRANCHES = 100_000  # of one step
RAREST = 1e-15  # the probability of all outcomes together that are left out of a draw without end
_REPEATED = 1_000  # first runs that are repeated, and later one in so many
_UNLIKE = (
    "; draw by choice, integers, permutation, binomial, multinomial, poisson, geometric, or compare random() "
    "with a threshold"
)


@dataclass(slots=True)
class _Decision:
    weights: Weights
    possible: tuple[int, ...]  # the outcomes that have a weight
    share: Share  # of what was decided before
    total: int  # of the weights
    pool: list[Any] | None = None  # that a choice was made from
    values: Sequence[Any] = ()  # what it gives, by outcomes


class Branching:
    """Stands for a `numpy.random.Generator`; `where` is what messages call the environment."""

    __class__ = property(lambda _: np.random.Generator)  # as one that asks sees it

    def __init__(self, where: str) -> None:
        self._where = where
        self._real = np.random.default_rng(0)  # refuses what numpy refuses
        self._decisions: list[_Decision] = []
        self._taken: list[int] = []  # the place of each decision's outcome among those possible
        self._place = 0  # of the next decision
        self._refused: InputError | None = None  # kept, since an environment may catch it
        # Refuses to go on, after so many outcomes of a step, where the time is over.
        self.check_time: Callable[[int], None] = lambda _: None
        self.endless = set[str]()  # draws that were made and have any number of outcomes
        self.run = 0  # counts the runs, so that what is left of another one is recognised
        self._is_running = False
        self._num_results = 0

    def outcomes(self, step: Callable[[], Result], repeats: bool = True) -> dict[Result, Fraction]:
        """Run a step once for each sequence of draws: its different results, each with its probability.

        Of results, the first 1,000 and one in 1,000 later are repeated, by turns not at all, once and twice.
        """
        found: list[tuple[Result, int, int]] = []
        for result in self._every_run(lambda: self._ran(step)):
            found.append((result, *self._share()))
            self._num_results += repeats
            if repeats and (self._num_results <= _REPEATED or self._num_results % _REPEATED == 0):
                for _ in range(self._num_results % 3):  # so that no memory has the same rhythm
                    if self._ran(step) != result:
                        raise self._not_repeatable()
        return shares(found)

    def _every_run(self, run: Callable[[], Any]) -> Iterator[Any]:
        """What a run gives with each sequence of decisions, depth first."""
        self._decisions, self._taken = [], []
        for number in range(MOST_BRANCHES):
            self.check_time(number)
            yield run()
            while self._taken and self._taken[-1] + 1 == len(self._decisions[-1].possible):
                self._taken.pop()
                self._decisions.pop()
            if not self._taken:
                return
            self._taken[-1] += 1
        raise InputError(f"{self._where}: one step has more than {MOST_BRANCHES:,} random outcomes")

    def _ran(self, step: Callable[[], Result]) -> Result:
        """The result of a step with the decisions that are taken, and first outcomes after them."""
        self._place, self.run, self._is_running = 0, self.run + 1, True
        result: Any = None
        try:
            result = step()
        except Exception:
            if self._refused is None:
                raise
        finally:
            self._is_running = False
        if self._refused is not None:
            raise self._refused
        if self._place < len(self._decisions):
            raise self._not_repeatable()
        return result  # type: ignore[no-any-return]

    def decide(self, weights: Weights) -> int:
        """The number of an outcome, drawn with probabilities in proportion to these weights."""
        place = self._place
        if place == len(self._decisions):
            if not self._is_running:
                self.refuse("is drawn from outside of step() and reset()")
            if place == _MOST_DRAWS:
                self.refuse(
                    f"one step may draw more than {_MOST_DRAWS:,} times",
                    "; draw from what fits, where a loop draws again until something does",
                )
            possible = tuple(number for number, weight in enumerate(weights) if weight)
            if len(possible) == 1:
                return possible[0]
            self._decisions.append(_Decision(weights, possible, self._share(), sum(weights)))
            self._taken.append(0)
        decision = self._decisions[place]
        if decision.weights is not weights and decision.weights != weights:
            if sum(map(bool, weights)) == 1:
                return next(number for number, weight in enumerate(weights) if weight)
            self._refused = self._not_repeatable()
            raise self._refused
        self._place += 1
        return decision.possible[self._taken[place]]

    def _share(self) -> Share:
        if not self._decisions:
            return 1, 1
        last = self._decisions[-1]
        numerator, denominator = last.share
        return numerator * last.weights[last.possible[self._taken[-1]]], denominator * last.total

    def _not_repeatable(self) -> InputError:
        return InputError(
            f"{self._where}: a step that is repeated from a copy of its state draws otherwise, so it "
            "depends on more than its state"
        )

    def refuse(self, what: str, remedy: str = _UNLIKE, drawn: str | None = None) -> NoReturn:
        """Refuse a draw, with the line that made it or the one given."""
        self._refused = self._refused or InputError(f"{self._where}: {what} ({drawn or self.line()}){remedy}")
        raise self._refused

    @staticmethod
    def line() -> str:
        """The file and line that called into this module, or compared one of its numbers."""
        frame = sys._getframe(1)
        while frame.f_back is not None and (
            frame.f_code.co_filename in OURS
            or frame.f_globals.get("__name__", "").startswith("gymnasium.spaces")
        ):
            frame = frame.f_back
        return f"{frame.f_code.co_filename}:{frame.f_lineno}"

    def _check(self, name: str, *arguments: Any) -> None:
        """Raise what numpy raises for these arguments."""
        if self._place == len(self._decisions):
            getattr(self._real, name)(*arguments)

    def _one_of(self, count: int) -> int:
        if count > MOST_OUTCOMES:
            self.refuse(f"a draw has {count:,} outcomes, more than {MOST_OUTCOMES:,}")
        return self.decide(_even(count))

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or not hasattr(np.random.Generator, name):
            raise AttributeError(name)
        if name in ("bit_generator", "spawn"):
            self.refuse(f"np_random.{name} is used, which depends on the seed", "")
        self.refuse(f"np_random.{name}() has too many outcomes to try them all")

    def __reduce_ex__(self, protocol: Any) -> NoReturn:
        self.refuse("np_random is copied", "")

    def random(self, size: Any = None, dtype: Any = np.float64, out: Any = None) -> Any:
        """A number from [0, 1), or an array of them, that can be compared."""
        if out is not None or np.dtype(dtype) != np.float64:
            self.refuse("random() with out or of 32 bits makes numbers that cannot be enumerated")
        return self.uniform(0.0, 1.0, size)

    def uniform(self, low: Any = 0.0, high: Any = 1.0, size: Any = None) -> Any:
        """A number from [low, high), or an array of them, that can be compared."""
        if not (isinstance(low, Real) and isinstance(high, Real)):
            self.refuse("uniform() with arrays makes numbers that cannot be enumerated")
        self._check("uniform", low, high, size)
        start, drawn = Fraction(float(low)), self.line()
        width = Fraction(float(high)) - start
        return _many(
            size,
            object,
            lambda: Uniform(self, drawn, [Fraction(0), Fraction(1)], width, start, size is not None),
        )

    def integers(
        self, low: Any, high: Any = None, size: Any = None, dtype: Any = np.int64, endpoint: bool = False
    ) -> Any:
        """Whole numbers as numpy's."""
        self._check("integers", low, high, size, dtype, endpoint)
        first, last = (0, low) if high is None else (low, high)
        pairs = np.broadcast(first, last)
        if any(each != int(each) for pair in pairs for each in pair):
            self.refuse("integers() has bounds that are not whole numbers", "")
        bounds = [
            (int(low), int(high) + bool(endpoint) - int(low)) for low, high in np.broadcast(first, last)
        ]
        drawn: Callable[[int, int], int] = lambda start, count: start + self._one_of(count)  # noqa: E731
        if size is None and pairs.ndim == 0:
            number = drawn(*bounds[0])
            return dtype(number) if dtype in (bool, int) else np.dtype(dtype).type(number)
        shape = pairs.shape if size is None else _shape(size)
        whole = np.broadcast_to(np.arange(len(bounds)).reshape(pairs.shape), shape)
        return np.array([drawn(*bounds[each]) for each in whole.flat], dtype).reshape(shape)

    def choice(
        self,
        a: Any,
        size: Any = None,
        replace: bool = True,
        p: Any = None,
        axis: int = 0,
        shuffle: bool = True,
    ) -> Any:
        """Elements as numpy's; equal ones are one outcome."""
        place = self._place
        if type(a) is list and place < len(self._decisions) and size is None and p is None:
            before = self._decisions[place]
            if before.pool == a:  # this step was here before, which is so in most calls
                self._place += 1
                return before.values[before.possible[self._taken[place]]]
        self._check("choice", a, size, replace, p, axis, shuffle)
        pool = np.asarray(a)
        if is_number := pool.ndim == 0:
            pool = np.arange(int(pool))
        elif p is None and size is None and pool.ndim == 1 and pool.dtype.kind in "biufUS":
            values, weights = _distinct(pool.dtype.str, pool.tobytes())
            number = self._among(weights)
            if type(a) is list and self._place > place:
                self._decisions[place].pool, self._decisions[place].values = list(a), values
            return values[number]
        chances = _even(pool.shape[axis]) if p is None else _as_numpy_draws(p)
        chosen: Any
        if size is None:
            chosen = self._among(chances)
        elif replace:
            chosen = _many(size, np.int64, lambda: self._among(chances))
        else:
            if not shuffle:
                self.refuse("choice(shuffle=False) has an order that numpy does not define", "")
            chosen = np.array(self._in_turn(chances, math.prod(_shape(size))), int).reshape(_shape(size))
        if is_number:
            return chosen
        return pool[chosen] if size is None and pool.ndim == 1 else pool.take(chosen, axis=axis)

    def _among(self, weights: Weights) -> int:
        if len(weights) > MOST_OUTCOMES:
            self.refuse(f"a choice has {len(weights):,} outcomes, more than {MOST_OUTCOMES:,}")
        return self.decide(weights)

    def _in_turn(self, weights: Weights, count: int) -> list[int]:
        """Different numbers, each drawn from those that are left."""
        left, found = list(weights), list[int]()
        for _ in range(count):
            found.append(self._among(tuple(left)))
            left[found[-1]] = 0
        return found

    def permutation(self, x: Any, axis: int = 0) -> Any:
        """As numpy's."""
        pool = np.arange(x) if isinstance(x, int | np.integer) else np.array(x)
        return pool.take(self._order(pool.shape[axis]), axis=axis)

    def shuffle(self, x: Any, axis: int = 0) -> None:
        """As numpy's: a list or an array is put into another order."""
        if isinstance(x, np.ndarray):
            x[...] = x.take(self._order(x.shape[axis]), axis=axis)
        else:
            for place, each in enumerate([x[number] for number in self._order(len(x))]):
                x[place] = each

    def _order(self, size: int) -> IntArray:
        return np.array(self._in_turn(_even(size), size), dtype=np.int64)

    def binomial(self, n: Any, p: Any, size: Any = None) -> Any:
        """Numbers of successes as numpy's."""
        if np.ndim(n) or np.ndim(p):
            self.refuse("binomial() with arrays cannot be enumerated")
        self._check("binomial", n, p, size)
        if n >= MOST_OUTCOMES:
            self.refuse(f"a draw has {int(n):,} outcomes, more than {MOST_OUTCOMES:,}")
        weights = _binomial(int(n), Fraction(float(p)))
        number = _many(size, np.int64, lambda: self.decide(weights))
        return int(number) if size is None else number

    def poisson(self, lam: Any = 1.0, size: Any = None) -> Any:
        """Numbers of events as numpy's, but for the rarest."""
        return self._counted("poisson", lam, size)

    def geometric(self, p: Any, size: Any = None) -> Any:
        """Numbers of trials up to the first success as numpy's, but for the rarest."""
        return self._counted("geometric", p, size)

    def _counted(self, name: str, parameter: Any, size: Any) -> Any:
        """Whole numbers that have no bound."""
        if np.ndim(parameter):
            self.refuse(f"{name}() with arrays cannot be enumerated")
        self._check(name, parameter, size)
        self.endless.add(name)
        first, weights = _without_end(name, float(parameter))
        if not weights:
            self.refuse(f"{name}({parameter}) has more than {MOST_OUTCOMES:,} outcomes")
        number = _many(size, np.int64, lambda: first + self.decide(weights))
        return int(number) if size is None else number

    def multinomial(self, n: Any, pvals: Any, size: Any = None) -> Any:
        """Counts as numpy's."""
        chances = np.asarray(pvals)
        if np.ndim(n) or chances.ndim != 1:
            self.refuse("multinomial() with arrays of arrays cannot be enumerated")
        self._check("multinomial", n, pvals, size)
        *others, _ = [Fraction(float(each)) for each in chances]

        def counts() -> IntArray:
            left, rest, found = int(n), Fraction(1), list[int]()
            for each in others:
                share = min(each / rest, Fraction(1)) if rest > 0 else Fraction(0)
                found.append(self.decide(_binomial(left, share)))
                left, rest = left - found[-1], rest - each
            return np.array([*found, left], dtype=np.int64)

        if size is None:
            return counts()
        return np.array([counts() for _ in range(math.prod(_shape(size)))]).reshape(*_shape(size), -1)


def shares(parts: Iterable[tuple[Result, int, int]]) -> dict[Result, Fraction]:
    """The sum of what belongs to each result, of numerators and denominators."""
    sums: dict[Result, dict[int, int]] = {}  # numerators by denominators, which is fast
    for result, numerator, denominator in parts:
        of_result = sums.setdefault(result, {})
        of_result[denominator] = of_result.get(denominator, 0) + numerator
    return {
        result: sum((Fraction(part, of) for of, part in each.items()), Fraction(0))
        for result, each in sums.items()
    }


def _shape(size: Any) -> tuple[int, ...]:
    return (int(size),) if np.ndim(size) == 0 else tuple(int(each) for each in size)


def _many(size: Any, dtype: Any, draw: Callable[[], Any]) -> Any:
    """One draw, or an array of them."""
    if size is None:
        return draw()
    found: NDArray[Any] = np.empty(_shape(size), dtype)
    for place in np.ndindex(found.shape):
        found[place] = draw()
    return found


@lru_cache
def _even(count: int) -> Weights:
    return (1,) * count


@lru_cache
def _distinct(dtype: str, content: bytes) -> tuple[list[Any], Weights]:
    """The different elements of an array, and how often each is in it."""
    elements = list(np.frombuffer(content, dtype))
    counts: dict[bytes, list[Any]] = {}
    for each in elements:
        counts.setdefault(each.tobytes(), []).append(each)
    return [found[0] for found in counts.values()], tuple(map(len, counts.values()))


def _as_numpy_draws(p: Any) -> Weights:
    """Probabilities as the differences of numpy's running sum."""
    sums = np.cumsum(np.asarray(p, dtype=np.float64))
    edges = [Fraction(0), *(Fraction(each) for each in (sums / sums[-1]).tolist())]
    return weights_of(end - start for start, end in itertools.pairwise(edges))


@lru_cache
def _binomial(n: int, p: Fraction) -> Weights:
    return weights_of(math.comb(n, count) * p**count * (1 - p) ** (n - count) for count in range(n + 1))


@lru_cache
def _without_end(name: str, parameter: float) -> tuple[int, Weights]:
    """The first number that is not too rare, and the chances of it and those after it; none of too many."""
    from scipy.special import gammaln, xlogy  # here, since it takes half a second

    numbers = np.arange(MOST_OUTCOMES + 1)
    if name == "poisson":
        chances = np.exp(xlogy(numbers, parameter) - parameter - gammaln(numbers + 1))
    else:  # failures before the success
        chances = parameter * (1 - parameter) ** numbers
    below, above = chances.cumsum(), chances[::-1].cumsum()[::-1]
    kept = np.flatnonzero(np.minimum(below, above) > RAREST / 2)
    if not kept.size or kept[-1] == MOST_OUTCOMES:
        return 0, ()
    return int(kept[0]) + (name == "geometric"), weights_of(Fraction(each) for each in chances[kept].tolist())
