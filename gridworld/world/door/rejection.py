"""Loops that draw again until something fits: what they reject goes to the other outcomes, in exact shares.

A draw that is made again at the same place of a `while` loop, with nothing changed since, is a rejection:
what follows it follows the earlier draw as well. "Nothing" is every attribute of all layers and every local
variable of the functions between. Draws in comprehensions and in `for` loops over anything but a `range`,
whose iterators nobody sees, and draws that are not plain calls are never taken for one. What is held
elsewhere (in classes, globals, half a sum) is not seen: so each step in which a draw was rejected is also run
with numpy's own generator, and the shares are compared.
"""

from __future__ import annotations

import ast
import dis
import functools
import itertools
import linecache
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from types import CodeType, FrameType
from typing import Any

import numpy as np

from gridworld.base.errors import InputError
from gridworld.world.door.branching import OURS, Branching, Result, Share, shares

OURS |= {__file__, functools.__file__}
SAMPLES = 20_000  # real draws that each kind of rejection is compared with
_AGAIN = 200  # of another state whose step rejects at the same places
FALSE_ALARM = 1e-9
_SEED = 20_260_101
_DRAWS = (
    *("random", "uniform", "integers", "choice", "permutation", "shuffle"),
    *("binomial", "multinomial", "poisson", "geometric"),
)
Way = tuple[int, tuple[int, ...]]  # to a draw: how many decisions were taken before, and which


@dataclass(frozen=True)
class _Place:
    """Stands among results for a draw that comes again, with the way to where it was met."""

    place: Any
    way: Way


@dataclass(frozen=True)
class _Leaf:
    """A run: which outcomes it took, their share before each and in the end, and what comes of it."""

    taken: tuple[int, ...]
    shares: list[Share]
    results: dict[Any, Fraction]


class _Again(BaseException):  # which an environment's `except Exception` does not catch
    """A draw at which everything is as at one that was met before: what follows it is known."""

    def __init__(self, place: Any, way: Way) -> None:
        self.place = _Place(place, way)


class Rejecting(Branching):
    """A generator that takes every outcome, and knows a rejection when it comes again.

    Args:
        where: what messages call the environment.
        everything: a copy of all attributes and of what it is given, and whether it is the same in each run.
        runs: the code of the functions that run a reset or a step.
        remembers: whether what follows a draw in a loop is found once, wherever the same comes again.
        compares: whether shares are compared with real draws.
    """

    def __init__(
        self,
        where: str,
        everything: Callable[..., tuple[bytes, bool]],
        runs: Iterable[CodeType],
        remembers: bool = False,
        compares: bool = True,
    ) -> None:
        super().__init__(where)
        self._compares = compares
        self._everything, self._runs = everything, frozenset(runs)
        self._depth = 0
        self._met: dict[Any, Way] = {}  # of each draw in a loop, the way to it
        # Whether a draw that was met on another way counts as having come again, where a loop begins anew.
        self._across = False
        self.sampling: np.random.Generator | None = None  # draws, in place of taking every outcome
        self._takes_all = False  # no draw counts as a rejection
        self._compared: Counter[Any] = Counter()
        self._remembers = remembers
        self._known: dict[Any, dict[Any, Fraction]] = {}  # what follows a draw, if it remembers
        # Of the draws of this run, with the ways to them, and whether they are the same in each run.
        self._places: list[tuple[Any, Way, bool]] = []
        self._is_lasting = True

    @contextmanager
    def drawing(self, numbers: np.random.Generator) -> Iterator[None]:
        """In this block, draws are those of a generator of numpy's."""
        self.sampling = numbers
        try:
            yield
        finally:
            self.sampling = None

    def outcomes(self, step: Callable[[], Result], repeats: bool = True) -> dict[Result, Fraction]:
        """The different results of a step, each with its probability."""
        self._met, self._across = {}, self._remembers
        if self._remembers:
            return self._merged(step)[0]
        try:
            return super().outcomes(step, repeats)
        except _Again:
            pass
        for self._across in (True, False):  # the first is faster, and misled by what is on the stack
            found, places = self._merged(step)
            if not (self._compares and self._differs(step, found, (self._across, places))):
                return found
        self._takes_all = True
        try:
            return super().outcomes(step, repeats)
        finally:
            self._takes_all = False

    def first(self, step: Callable[[], Result]) -> Result:
        """The result of a step in which every draw has its first outcome that is not rejected."""
        self._met, self._across = {}, False
        known, self._known = self._known, {}  # since it is to run to its end
        try:
            for result in self._every_run(lambda: self._run_or_place(step)):
                if not isinstance(result, _Place):
                    return result  # type: ignore[no-any-return]
            raise self._endless()
        finally:
            self._known = known

    def _endless(self) -> InputError:
        return InputError(f"{self._where}: a loop draws again without end, since nothing ever fits")

    def _run_or_place(self, step: Callable[[], Any]) -> Any:
        """The result of a step, or the place of a draw at which it is known what follows."""
        try:
            return self._ran(step)
        except _Again as error:
            del self._decisions[self._place :], self._taken[self._place :]
            return error.place

    def _ran(self, step: Callable[[], Result]) -> Result:
        self._depth = self._num_drawn = 0
        return super()._ran(step)

    def drawn(self, name: str, *arguments: Any, **options: Any) -> Any:
        """A draw that the environment makes."""
        if self.sampling is not None:
            return getattr(self.sampling, name)(*arguments, **options)
        if not self._depth and not self._takes_all:
            number, self._num_drawn = self._num_drawn, self._num_drawn + 1
            is_as_before = self._place < len(self._decisions) and number < len(self._places)
            if not (is_as_before and self._places[number][2]):
                place, way = self._place_of(name), (self._place, tuple(self._taken[: self._place]))
                self._places[number:] = [(place, way, self._is_lasting)]
                self._check_again(place, way)
            place, way, _ = self._places[number]
            if place is not None:
                self._met[place] = way
        self._depth += 1
        try:
            return getattr(Branching, name)(self, *arguments, **options)
        finally:
            self._depth -= 1

    def _check_again(self, place: Any, way: Way) -> None:
        """Raise `_Again` if it is known what follows a draw that is made now."""
        if place is None:
            return
        if place in self._known:
            raise _Again(place, way)
        lines = [each[0] for each, *_ in self._places if each is not None]
        head = next((line for number, line in enumerate(lines) if line in lines[:number]), None)
        met, may_be = self._met.get(place, way), self._across and place[0] == head
        if met != way and (may_be or way[1][: met[0]] == met[1]):
            raise _Again(place, met)

    def _place_of(self, name: str) -> Any:
        """All that what follows a draw depends on; None where that cannot be seen."""
        self._is_lasting = True
        frame: FrameType | None = sys._getframe(1)
        while frame is not None and frame.f_code.co_filename in OURS:
            frame = frame.f_back
        frames: list[FrameType] = []
        while frame is not None and frame.f_code not in self._runs:
            frames.append(frame)
            frame = frame.f_back
        places = [(each.f_code, each.f_lasti) for each in frames]
        if not any(itertools.starmap(_in_while, places)):
            return None
        held = []
        for each, (code, at) in zip(frames, places, strict=True):
            variables = dict(each.f_locals)
            around = _ranges_around(code, at) if _calls(code, at, name) else None
            if around is None or any(named not in variables for named in around):
                return None
            held.append(variables)
            name = code.co_name
        try:
            content, self._is_lasting = self._everything(*held)
            return tuple(places), content
        except Exception:  # whatever cannot be copied
            return None

    def _merged(self, step: Callable[[], Any]) -> tuple[dict[Any, Fraction], Any]:
        """Outcomes where what comes again counts as what it was; and the places where draws came again.

        From each draw that comes again on, the shares are a linear system: of results, and of such draws.
        """
        self._met = {}
        leaves, again = list[_Leaf](), set[_Place]()
        for result in self._every_run(lambda: self._run_or_place(step)):
            known = self._known.get(result.place) if isinstance(result, _Place) else None
            if known is None and isinstance(result, _Place):
                again.add(result)
            shares = [*(each.share for each in self._decisions), self._share()]
            leaves.append(_Leaf(tuple(self._taken), shares, known or {result: Fraction(1)}))
        if self._remembers:
            again |= {_Place(place, way) for place, way in self._met.items()}
        follows = {place: self._following(leaves, place.way) for place in again}
        whole = self._following(leaves, (0, ()))
        for place in follows:
            self.check_time(len(leaves))
            self._substitute(place, follows, whole)
        if self._remembers:
            self._known |= {place.place: found for place, found in follows.items()}
        return whole, frozenset(each.place[0] for each in again)

    def _following(self, leaves: list[_Leaf], way: Way) -> dict[Any, Fraction]:
        """What follows a draw, by the way to it."""
        self.check_time(len(leaves))
        depth, taken = way
        return shares(
            (result, numerator * of * part.numerator, denominator * before * part.denominator)
            for leaf in leaves
            if leaf.taken[:depth] == taken
            for (before, of), (numerator, denominator) in ((leaf.shares[depth], leaf.shares[-1]),)
            for result, part in leaf.results.items()
        )

    def _substitute(
        self, place: _Place, follows: dict[_Place, dict[Any, Fraction]], whole: dict[Any, Fraction]
    ) -> None:
        """Put what follows a draw in its place, everywhere."""
        found = follows[place]
        back = found.pop(place, Fraction(0))
        if back == 1:
            raise self._endless()
        found = follows[place] = {result: share / (1 - back) for result, share in found.items()}
        for other in (whole, *follows.values()):
            if other is not found and (share := other.pop(place, None)) is not None:
                for result, part in found.items():
                    other[result] = other.get(result, Fraction(0)) + share * part

    def _differs(self, step: Callable[[], Any], expected: dict[Any, Fraction], places: Any) -> bool:
        """Whether real draws are not as frequent as their shares; a false alarm once in 1e9."""
        from scipy.special import bdtr, bdtrc  # here, since it takes half a second

        self._compared[places] += 1
        size = SAMPLES if self._compared[places] == 1 else _AGAIN
        with self.drawing(np.random.default_rng(_SEED + sum(self._compared.values()))):
            counts = Counter(step() for _ in range(size))
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
def _ranges_around(code: CodeType, at: int) -> tuple[str, ...] | None:
    """The variables of the `for` loops around an instruction, each over a `range`, which gives none twice.

    None if there is a loop of another kind, whose iterator nobody sees, or one that sets its variable.
    """
    found = list(dis.get_instructions(code))
    names: list[str] = []
    for place, loop in enumerate(found):
        if loop.opname == "FOR_ITER" and loop.offset <= at < loop.argval:
            sets = [_set_by(each) for each in found if loop.offset < each.offset < loop.argval]
            is_range = found[place - 1].opname == "GET_ITER" and _is_range(code, found[place - 2].offset)
            is_local = found[place + 1].opname.startswith("STORE_FAST")
            if not is_range or not is_local or sum(sets[0] <= each for each in sets) != 1:
                return None
            names += sets[0]
    return tuple(names)


def _set_by(instruction: dis.Instruction) -> set[Any]:
    """The names that an instruction sets. Since Python 3.13 there is `STORE_FAST_LOAD_FAST`, of two names."""
    names, verbs = instruction.argval, instruction.opname.split("_FAST")
    pairs = zip(names if isinstance(names, tuple) else (names,), verbs, strict=False)
    return {name for name, verb in pairs if "STORE" in verb}


def _is_range(code: CodeType, at: int) -> bool:
    """Whether an instruction is a `range` of what is seen: of numbers, variables and attributes."""
    tree = _expression(code, at)
    is_range = isinstance(tree, ast.Call) and isinstance(tree.func, ast.Name) and tree.func.id == "range"
    return is_range and sum(isinstance(each, ast.Call) for each in ast.walk(tree)) == 1  # type: ignore[arg-type]


@functools.lru_cache(4096)
def _in_while(code: CodeType, at: int) -> bool:
    """Whether an instruction is in a `while` loop: one behind it leads back to before it."""
    heads = {each.offset for each in dis.get_instructions(code) if each.opname == "FOR_ITER"}
    jumps = (each for each in dis.get_instructions(code) if "JUMP" in each.opname and each.offset > at)
    return any(
        isinstance(each.argval, int) and each.argval <= at and each.argval not in heads for each in jumps
    )


@functools.lru_cache(4096)
def _calls(code: CodeType, at: int, name: str) -> bool:
    """Whether an instruction is a plain call `f(...)` or `x.f(...)` of that name, with no C code between."""
    tree = _expression(code, at)
    return isinstance(tree, ast.Call) and getattr(tree.func, "attr", getattr(tree.func, "id", None)) == name


def _expression(code: CodeType, at: int) -> ast.expr | None:
    """What an instruction is of, by its file."""
    line, end, left, right = list(code.co_positions())[at // 2]
    if line is None or end is None or left is None or right is None:
        return None
    lines = [linecache.getline(code.co_filename, number) for number in range(line, end + 1)]
    text = "".join(lines).encode()
    after = len(lines[-1].encode()) - right if lines else 0
    try:
        return ast.parse(b"(" + text[left : len(text) - after] + b")", mode="eval").body
    except (SyntaxError, ValueError):
        return None
