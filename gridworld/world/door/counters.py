"""Numbers that are counted or summed up, and step limits: what nothing reads, or only to cut, is no state.

A counter of all resets, say, or the sum of an episode's rewards that only `info` shows: as state it would
multiply the others without end. So each number that changes is replaced by a stand-in before every run, which
may be counted on and passed around. A number that grows by the same in every step, as a count of them, may be
compared with others too: if the comparison does nothing but truncate, as in a `TimeLimit`, its moment is a
step limit. Whatever else is done with a stand-in raises `Read`, and then the number is state.

A count of steps that is state is a clock: it has one value at each time. In most steps nothing reads it, or
it is only compared, so what is found in such a step holds at all times at which the comparisons come out
alike.
"""

from __future__ import annotations

import functools
import operator
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np
from gymnasium.wrappers import TimeLimit

from gridworld.world.door.beliefs import State, Step, summed
from gridworld.world.door.uniform import OPERATIONS

if TYPE_CHECKING:
    from gridworld.world.door.search import Search

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
        is_clock: whether it is state, since something reads it.
    """

    def __init__(self, key: Key, series: Sequence[Sequence[Any]], is_clock: bool = False) -> None:
        self.key, self.is_clock = key, is_clock
        self.time = 0  # at which a run begins: how many steps were made before
        self.asked: dict[Any, bool] | None = None  # a clock's comparisons; None: the number is in its place
        self.blank = Unread(self, None)  # what a copy holds: it says nothing of what it was made from
        self.start = self.step = 0  # after a reset, and what each step adds
        self.cuts = False  # whether comparisons come out as they do at the limit
        self.is_limit = False  # whether it is that of a `TimeLimit`,
        self.only_cuts = False  # and nothing around this can see more of it than that it cuts
        self.num_checked = 0  # of the states, those from which steps were tried at the limit, too
        self.limits: set[int] = set()  # the steps in which a comparison comes out otherwise than before
        self._outcomes: dict[Any, tuple[bool, int | None]] = {}
        self.kinds = list({type(value) for each in series for value in each})
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

    def fresh(self, time: int) -> Any:
        """What stands for it when a run begins after so many steps."""
        self.time = time
        if self.is_clock and self.asked is None:
            return self.kinds[0](self.start + self.step * time)
        return Unread(self, (1, 0) if self.is_regular else None)

    def check(self, value: Any, time: int) -> None:
        """Notes whether it is, after so many steps in which the episode goes on, what it was to be."""
        if type(value) is Unread:
            fits = value.counter is self and value.form == (1, self.step) and time > 0
        else:
            is_now = type(value) is self.kinds[0] if self.is_clock else type(value) in NUMBERS and not time
            fits = is_now and value == self.start + self.step * time
        if not fits and self.is_regular:
            self.is_regular = False
            if self._outcomes or self.is_clock:
                raise Read({self.key})

    def _outcome(self, case: Any, time: int) -> bool:
        """What a comparison gives in a run that begins after so many steps."""
        name, (sign, offset), threshold = case
        return bool(getattr(operator, name)(sign * (self.start + self.step * time) + offset, threshold))

    def holds(self, asked: dict[Any, bool], time: int) -> bool:
        """Whether these comparisons come out as they did, after so many steps."""
        return all(self._outcome(case, time) is found for case, found in asked.items())

    def compared(self, name: str, form: tuple[int, int], threshold: Any) -> bool:
        """What a comparison gives before the step in which it changes, or in that one; with a clock, now."""
        case = name, form, threshold
        if self.asked is not None:
            return self.asked.setdefault(case, self._outcome(case, self.time))
        if (found := self._outcomes.get(case)) is None:
            found = self._outcomes[case] = self._changes(case)
            if found[1] is not None:
                self.limits.add(found[1])
            if len(self.limits) > 1:
                raise Read({self.key})
        usual, limit = found
        return usual is not (self.cuts and limit is not None)

    def _changes(self, case: Any) -> tuple[bool, int | None]:
        """What a comparison gives at first, and in which step it gives the other, if in any."""
        _, (sign, offset), threshold = case
        first = 0 if self.is_limit else 1  # a `TimeLimit` may cut the first step, too
        usual = self._outcome(case, first - 1)
        crossing = int((threshold - sign * self.start - offset) // (sign * self.step)) + 1
        steps = [step for step in range(crossing - 1, crossing + 3) if step > first]
        return usual, min((n for n in steps if self._outcome(case, n - 1) is not usual), default=None)


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
        is_others = is_others and not self.counter.is_clock
        if self.form is None or not is_number or not self.counter.is_regular or is_others:
            self._read()
        return self.counter.compared(name, self.form, other)

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **options: Any) -> Any:
        names = OPERATIONS.get(ufunc.__name__)
        if names is None or method != "__call__" or options:
            self._read()
        one, other = inputs
        return getattr(one, names[0])(other) if type(one) is Unread else getattr(other, names[1])(one)

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
