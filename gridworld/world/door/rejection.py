"""Loops that draw again until something fits: what they reject goes to the other outcomes, in exact shares.

A draw that is made again at the same place of a `while` loop, with nothing changed since, is a rejection:
what follows it follows the earlier draw as well. "Nothing" is every attribute of all layers and every local
variable of the functions between. Draws in `for` loops and comprehensions, whose iterators nobody sees, and
draws that are not plain calls are never taken for one. What is held elsewhere (in classes, globals, half a
sum) is not seen: so each step in which a draw was rejected is also run with numpy's own generator, and the
shares are compared.
"""

from __future__ import annotations

import ast
import dis
import functools
import linecache
import sys
from collections import Counter
from collections.abc import Callable, Iterable
from fractions import Fraction
from types import CodeType, FrameType
from typing import Any

import numpy as np

from gridworld.base.errors import InputError
from gridworld.world.door.branching import MOST_BRANCHES, OURS, Branching, Result

OURS |= {__file__, functools.__file__}
SAMPLES = 20_000  # real draws that each kind of rejection is compared with
_AGAIN = 200  # of another state whose step rejects at the same places
FALSE_ALARM = 1e-9
_SEED = 20_260_101
_DRAWS = ("random", "uniform", "integers", "choice", "permutation", "shuffle", "binomial", "multinomial")
Leaf = tuple[
    list[tuple[tuple[int, ...], int]], Any
]  # the decisions of a run (weights, taken), and its result


class _Again(BaseException):  # which an environment's `except Exception` does not catch
    def __init__(self, place: int) -> None:
        self.place = place


class _Known(BaseException):
    def __init__(self, place: Any) -> None:
        self.place = place


class Rejecting(Branching):
    """A generator that takes every outcome, and knows a rejection when it comes again.

    Args:
        where: what messages call the environment.
        everything: a copy of all attributes and of what it is given.
        runs: the code of the functions that run a reset or a step.
        remembers: whether what follows a draw in a loop is found once, wherever the same comes again.
    """

    def __init__(
        self, where: str, everything: Callable[..., bytes], runs: Iterable[CodeType], remembers: bool = False
    ) -> None:
        super().__init__(where)
        self._everything, self._runs = everything, frozenset(runs)
        self._depth, self._begun = 0, dict[Any, int]()
        self.sampling: np.random.Generator | None = None  # draws, in place of taking every outcome
        self._takes_all = False  # no draw counts as a rejection
        self._compared: Counter[Any] = Counter()
        self._remembers = remembers
        self._known: dict[Any, dict[Any, Fraction]] = {}  # what follows a draw, if it remembers

    def outcomes(self, step: Callable[[], Result]) -> dict[Result, Fraction]:
        """The different results of a step, each with its probability."""
        if self._remembers:
            return self._folded(step)[0]
        try:
            return super().outcomes(step)
        except _Again:
            pass
        found, places = self._folded(step)
        if self._differs(step, found, places):
            self._takes_all = True
            try:
                return super().outcomes(step)
            finally:
                self._takes_all = False
        return found

    def first(self, step: Callable[[], Result]) -> Result:
        """The result of a step in which every draw has its first outcome that is not rejected."""
        self._decisions, self._taken = [], []
        while True:
            try:
                return self._ran(step)
            except _Again as again:
                del self._decisions[self._place :], self._taken[self._place :]
                self._next(again.place)

    def _next(self, first: int) -> None:
        """Go on to the next outcome of the last draw from `first` on that has one."""
        while len(self._taken) > first and self._taken[-1] + 1 == len(self._decisions[-1].possible):
            self._taken.pop()
            self._decisions.pop()
        if len(self._taken) <= first:
            raise InputError(f"{self._where}: a loop draws again without end, since nothing ever fits")
        self._taken[-1] += 1

    def _ran(self, step: Callable[[], Result]) -> Result:
        self._begun, self._depth = {}, 0
        return super()._ran(step)

    def drawn(self, name: str, *arguments: Any, **options: Any) -> Any:
        """A draw that the environment makes."""
        if self.sampling is not None:
            return getattr(self.sampling, name)(*arguments, **options)
        if not self._depth and not self._takes_all and (place := self._place_of(name)) is not None:
            if place in self._known:
                raise _Known(place)
            first = self._begun.setdefault(place, self._place)
            if first < self._place:
                raise _Again(first)
        self._depth += 1
        try:
            return getattr(Branching, name)(self, *arguments, **options)
        finally:
            self._depth -= 1

    def _place_of(self, name: str) -> Any:
        """All that what follows a draw depends on; None where that cannot be seen."""
        frame: FrameType | None = sys._getframe(1)
        while frame is not None and frame.f_code.co_filename in OURS:
            frame = frame.f_back
        places, held = [], []
        while frame is not None and frame.f_code not in self._runs:
            code, at = frame.f_code, frame.f_lasti
            if not self._is_plain(code, at, name):
                return None
            places.append((code, at))
            held.append(frame.f_locals)
            name, frame = code.co_name, frame.f_back
        if not any(_in_while(code, at) for code, at in places):
            return None
        try:
            return tuple(places), self._everything(*held)
        except Exception:  # whatever cannot be copied
            return None

    @staticmethod
    def _is_plain(code: CodeType, at: int, name: str) -> bool:
        return not _in_for(code, at) and _calls(code, at, name)

    def _folded(self, step: Callable[[], Any]) -> tuple[dict[Any, Fraction], Any]:
        """Outcomes where what a loop rejects is shared out among what it takes; and where it rejects."""
        self._decisions, self._taken = [], []
        leaves: list[Leaf] = []
        places, begun = set(), dict[Any, tuple[int, int]]()  # of each draw its decision, and its first leaf
        for _ in range(MOST_BRANCHES):
            result: dict[Any, Fraction]
            try:
                result = {(self._ran(step),): Fraction(1)}
            except _Again as again:
                result = {again.place: Fraction(1)}
                places |= {key[0] for key, first in self._begun.items() if first == again.place}
                del self._decisions[self._place :], self._taken[self._place :]
            except _Known as known:
                result = self._known[known.place]
                del self._decisions[self._place :], self._taken[self._place :]
            for place, first in self._begun.items():
                begun.setdefault(place, (first, len(leaves)))
            decisions = zip(self._decisions, self._taken, strict=True)
            steps = [(tuple(each.weights[n] for n in each.possible), taken) for each, taken in decisions]
            leaves.append((steps, result))
            while self._taken and self._taken[-1] + 1 == len(self._decisions[-1].possible):
                self._taken.pop()
                self._decisions.pop()
            if self._remembers:
                self._remember(begun, leaves)
            if not self._taken:
                found = self._fold(leaves, 0)
                return {result[0]: share for result, share in found.items()}, frozenset(places)
            self._taken[-1] += 1
        raise InputError(f"{self._where}: one step has more than {MOST_BRANCHES:,} random outcomes")

    def _remember(self, begun: dict[Any, tuple[int, int]], leaves: list[Leaf]) -> None:
        """Keep what follows the draws all of whose outcomes have been taken."""
        for place, (first, leaf) in [*begun.items()]:
            if first >= len(self._taken) and len(leaves[leaf][0]) > first:
                found = self._fold(leaves[leaf:], first)
                if all(isinstance(result, tuple) for result in found):
                    self._known[place] = found
                del begun[place]

    def _fold(self, leaves: list[Leaf], depth: int) -> dict[Any, Fraction]:
        if len(leaves[0][0]) == depth:
            found: dict[Any, Fraction] = leaves[0][1]
            return found
        groups: dict[int, list[Leaf]] = {}
        for leaf in leaves:
            groups.setdefault(leaf[0][depth][1], []).append(leaf)
        whole: dict[Any, Fraction] = {}
        for taken, group in groups.items():
            weights = group[0][0][depth][0]
            for result, part in self._fold(group, depth + 1).items():
                whole[result] = whole.get(result, Fraction(0)) + Fraction(weights[taken], sum(weights)) * part
        rejected = whole.pop(depth, Fraction(0))
        if rejected == 1:
            raise InputError(f"{self._where}: a loop draws again without end, since nothing ever fits")
        return {result: part / (1 - rejected) for result, part in whole.items()}

    def _differs(self, step: Callable[[], Any], expected: dict[Any, Fraction], places: Any) -> bool:
        """Whether real draws are not as frequent as their shares; a false alarm once in 1e9."""
        from scipy.special import bdtr, bdtrc  # here, since it takes half a second

        self._compared[places] += 1
        size = SAMPLES if self._compared[places] == 1 else _AGAIN
        self.sampling = np.random.default_rng(_SEED + sum(self._compared.values()))
        try:
            counts = Counter(step() for _ in range(size))
        finally:
            self.sampling = None
        if counts.keys() - expected.keys():
            return True
        level = FALSE_ALARM / (2 * len(expected))
        for result, share in expected.items():
            count, chance = counts[result], float(share)
            above = 1.0 if not count else float(bdtrc(count - 1, size, chance))
            if min(above, float(bdtr(count, size, chance))) < level and chance < 1:
                return True
        return False


for _name in _DRAWS:
    setattr(Rejecting, _name, functools.partialmethod(Rejecting.drawn, _name))


@functools.lru_cache(4096)
def _in_for(code: CodeType, at: int) -> bool:
    """Whether an instruction is in a `for` loop or a comprehension."""
    loops = (each for each in dis.get_instructions(code) if each.opname == "FOR_ITER")
    return any(each.offset <= at < each.argval for each in loops)


@functools.lru_cache(4096)
def _in_while(code: CodeType, at: int) -> bool:
    """Whether an instruction is in a loop: one behind it leads back to before it."""
    jumps = (each for each in dis.get_instructions(code) if "JUMP" in each.opname and each.offset > at)
    return any(isinstance(each.argval, int) and each.argval <= at for each in jumps)


@functools.lru_cache(4096)
def _calls(code: CodeType, at: int, name: str) -> bool:
    """Whether an instruction is a plain call `f(...)` or `x.f(...)` of that name, with no C code between."""
    line, end, left, right = list(code.co_positions())[at // 2]
    if line is None or end is None or left is None or right is None:
        return False
    lines = [linecache.getline(code.co_filename, number) for number in range(line, end + 1)]
    text = "".join(lines).encode()
    after = len(lines[-1].encode()) - right if lines else 0
    try:
        tree = ast.parse(b"(" + text[left : len(text) - after] + b")", mode="eval").body
    except (SyntaxError, ValueError):
        return False
    return isinstance(tree, ast.Call) and getattr(tree.func, "attr", getattr(tree.func, "id", None)) == name
