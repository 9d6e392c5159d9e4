"""Numbers that are counted or summed up, and step limits: what nothing reads, or only to cut, is no state.

A counter of all resets, say, or the sum of an episode's rewards that only `info` shows: as state it would
multiply the others without end. So each number that changes is replaced by a stand-in before every run, which
may be counted on and passed around. A number that grows by the same in every step, as a count of them, may be
compared with others too: if the comparison does nothing but truncate, as in a `TimeLimit`, its moment is a
step limit. Whatever else is done with a stand-in raises `Read`, and then the number is state.
"""

from __future__ import annotations

import functools
import operator
import sys
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np
from gymnasium.wrappers import TimeLimit

from gridworld.world.door.beliefs import Step, summed

if TYPE_CHECKING:
    from gridworld.world.door.search import Search, State

NUMBERS = frozenset(
    {int, float, *(k for k in np.sctypeDict.values() if issubclass(k, np.integer | np.floating))}
)
_EXACT = 2**50  # floats up to it are counted exactly
Key = tuple[int, str]  # of an attribute: its layer's number, and its name
_READING = (
    *("bool", "int", "float", "complex", "index", "len", "iter", "contains", "getitem", "call", "array"),
    *("hash", "str", "repr", "format", "bytes", "round", "trunc", "floor", "ceil", "abs", "neg", "pos"),
    *("invert", "getattr", "reversed", "divmod", "rdivmod"),
    *(f"{right}{name}" for name in ("truediv", "floordiv", "mod", "pow") for right in ("", "r")),
    *(f"{right}{name}" for name in ("and", "or", "xor", "lshift", "rshift", "matmul") for right in ("", "r")),
)
_COMPARISONS = ("lt", "le", "gt", "ge", "eq", "ne")
_MIRRORED = {"lt": "gt", "gt": "lt", "le": "ge", "ge": "le"}
_OF_NUMPY: dict[Any, str] = {
    getattr(np, name): short
    for name, short in (
        *(("add", "add"), ("subtract", "sub"), ("multiply", "mul"), ("less", "lt"), ("less_equal", "le")),
        *(("greater", "gt"), ("greater_equal", "ge"), ("equal", "eq"), ("not_equal", "ne")),
    )
}


class Read(BaseException):  # which an environment's `except Exception` does not catch
    """Something depends on attributes that seemed to be read by nothing: a layer's number, and a name."""

    def __init__(self, found: set[Key]) -> None:
        super().__init__(found)
        self.found = found


class Counter:
    """What is known of an attribute in whose place there is a stand-in.

    Args:
        key: the attribute.
        series: its values in some episodes, after the reset and each step.
    """

    def __init__(self, key: Key, series: Sequence[Sequence[Any]]) -> None:
        self.key = key
        self.blank = Unread(self, None)  # what a copy holds: it says nothing of what it was made from
        self.start = self.step = 0  # after a reset, and what each step adds
        self.cuts = False  # whether comparisons come out as they do at the limit
        self.is_limit = False  # whether it is that of a `TimeLimit`,
        self.only_cuts = False  # and nothing around this can see more of it than that it cuts
        self.num_checked = 0  # of the states, those from which steps were tried at the limit, too
        self.limits: set[int] = set()  # the steps in which a comparison comes out otherwise than before
        self._outcomes: dict[Any, tuple[bool, int | None]] = {}
        self.is_regular = self._fits(series)

    def _fits(self, series: Sequence[Sequence[Any]]) -> bool:
        """Whether all began with one whole number, and added another one in each step."""
        long = [each for each in series if len(each) > 1]
        if not long or not all(_is_whole(value) for each in series for value in each):
            return False
        self.start, self.step = int(long[0][0]), int(long[0][1]) - int(long[0][0])
        return self.step != 0 and all(
            value == self.start + self.step * took for each in series for took, value in enumerate(each)
        )

    def fresh(self) -> Unread:
        """What stands for it when a run begins."""
        return Unread(self, (1, 0) if self.is_regular else None)

    def check(self, value: Any, is_reset: bool) -> None:
        """Notes whether it is, after a reset or a step in which the episode goes on, what it was to be."""
        if type(value) is Unread:
            fits = value.counter is self and value.form == (1, self.step) and not is_reset
        else:
            fits = type(value) in NUMBERS and is_reset and value == self.start
        if not fits and self.is_regular:
            self.is_regular = False
            if self._outcomes:
                raise Read({self.key})

    def compared(self, name: str, form: tuple[int, int], threshold: Any) -> bool:
        """What a comparison gives before the step in which it changes, or in that one."""
        case = name, form, threshold
        if (found := self._outcomes.get(case)) is None:
            found = self._outcomes[case] = self._changes(getattr(operator, name), form, threshold)
            if found[1] is not None:
                self.limits.add(found[1])
            if len(self.limits) > 1:
                raise Read({self.key})
        usual, limit = found
        return usual is not (self.cuts and limit is not None)

    def _changes(
        self, compare: Callable[[Any, Any], bool], form: tuple[int, int], threshold: Any
    ) -> tuple[bool, int | None]:
        """What a comparison gives at first, and in which step it gives the other, if in any."""
        sign, offset = form

        def outcome(step: int) -> bool:
            return bool(compare(sign * (self.start + self.step * (step - 1)) + offset, threshold))

        slope, first = (
            sign * self.step,
            0 if self.is_limit else 1,
        )  # a `TimeLimit` may cut the first step, too
        usual, crossing = outcome(first), int((threshold - sign * self.start - offset) // slope) + 1
        steps = [step for step in range(crossing - 1, crossing + 3) if step > first]
        return usual, min((step for step in steps if outcome(step) is not usual), default=None)


class Unread:
    """A number of which nobody has asked anything.

    `form` says that it is the first times what the attribute was when the run began, plus the second.
    """

    is_stand_in = True

    def __init__(self, counter: Counter, form: tuple[int, int] | None) -> None:
        self.counter, self.form = counter, form

    __class__ = property(lambda self: self._read())

    def _counted(self, name: str, other: Any) -> Any:
        if type(other) not in NUMBERS and type(other) not in (bool, Unread):
            self._read()
        if self.form is None or type(other) is Unread or name[-3:] == "mul" or not _is_whole(other):
            return self.counter.blank
        sign, offset = self.form
        number = int(other)
        if name in ("add", "radd"):
            return Unread(self.counter, (sign, offset + number))
        return Unread(self.counter, (sign, offset - number) if name == "sub" else (-sign, number - offset))

    def _compared(self, name: str, other: Any) -> bool:
        is_number = type(other) in NUMBERS and abs(other) <= _EXACT  # which no NaN is
        is_others = self.counter.is_limit and sys._getframe(1).f_code is not TimeLimit.step.__code__
        if self.form is None or not is_number or not self.counter.is_regular or is_others:
            self._read()
        return self.counter.compared(name, self.form, other)

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **options: Any) -> Any:
        name = _OF_NUMPY.get(ufunc)
        if name is None or method != "__call__" or options:
            self._read()
        one, other = inputs
        if type(one) is Unread:
            return getattr(one, f"__{name}__")(other)
        mirrored = _MIRRORED.get(name, name) if name in _COMPARISONS else f"r{name}"
        return getattr(other, f"__{mirrored}__")(one)

    def _read(self, *_: Any) -> NoReturn:
        raise Read({self.counter.key})


def _is_whole(number: Any) -> bool:
    return bool(abs(number) <= _EXACT and number == int(number))


for _name in ("add", "radd", "sub", "rsub", "mul", "rmul"):
    setattr(Unread, f"__{_name}__", functools.partialmethod(Unread._counted, _name))
for _name in _COMPARISONS:
    setattr(Unread, f"__{_name}__", functools.partialmethod(Unread._compared, _name))
for _name in _READING:
    setattr(Unread, f"__{_name}__", Unread._read)


# ---- step limits ----


def counted(search: Search) -> int | None:
    """The step in which a counter cuts every episode, as far as one was met."""
    return min((limit for each in search.layers.counters for limit in each.limits), default=None)


def check_cuts(search: Search, state: State, steps: list[list[Step]]) -> None:
    """At each limit, the steps from a state must be cut, and otherwise do what they do before.

    Raises:
        Read: what compares a counter does something else, or only in some states.
    """
    for counter in search.layers.counters:
        if counter.limits and not counter.only_cuts:
            if counter.num_checked < search.num_tried or not _only_cuts(search, state, steps, counter):
                raise Read({counter.key})
            counter.num_checked += 1


def _only_cuts(search: Search, state: State, steps: list[list[Step]], limit: Counter) -> bool:
    limit.cuts = search.is_cutting = True
    try:
        for action, usual in enumerate(steps):
            run = functools.partial(search.stepped_from, state.copy, state.depth, np.int64(action))
            cut = summed(
                ((*shown[:3], shown[2] or shown[3]), probability)
                for (_, *shown), probability in search.branching.outcomes(run, repeats=False).items()
            )
            whole = summed(
                ((each.seen, each.reward, each.terminated, True), each.probability) for each in usual
            )
            if cut != whole:
                return False
    finally:
        limit.cuts = search.is_cutting = False
    return True


def limit_of(search: Search) -> tuple[int | None, bool]:
    """The step limit of what a search found, and whether something else truncates too, by the state."""
    known = [each for each in (counted(search), search.limit_met) if each is not None]
    steps = [
        (state.depth + 1, step)
        for state in search.states
        for row in state.steps
        for step in row
        if not step.terminated
    ]
    if cut := {at for at, step in steps if step.truncated}:
        on = {at for at, step in steps if not step.truncated}
        is_timed = all(search.states[s.following].depth == at for at, s in steps if s.following >= 0)
        if not is_timed or max(on, default=0) >= min(cut):  # a state must have one time
            return min(known, default=None), True
        known.append(min(cut))
    return min(known, default=None), False
