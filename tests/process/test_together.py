"""Tasks that run together meet, and none can tell that the others are there."""

import os
import random
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextvars import ContextVar
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch

from gridworld.process import signals
from gridworld.process.parallel import together
from gridworld.process.parallel.together import by_itself, chance, clock, meet, run_together
from gridworld.process.signals import Interrupted, StopRequest

NAME: ContextVar[str] = ContextVar("name", default="outside")
met: list[list[Any]] = []


@pytest.fixture(autouse=True)
def nobody_met() -> Iterator[None]:
    met.clear()
    yield
    assert signals._listeners == []


def note(members: Sequence[Any]) -> list[Exception | None]:
    met.append(list(members))
    return [None] * len(members)


def numbers() -> list[float]:
    return [
        random.random(),
        float(np.random.rand()),
        float(np.random.permutation(9)[0]),
        float(torch.rand(1)),
    ]


def seeded(seed: int, count: int = 4) -> list[list[float]]:
    random.seed(seed), np.random.seed(seed), torch.manual_seed(seed)  # type: ignore[func-returns-value]
    found = []
    for _ in range(count):
        found.append(numbers())
        meet(note, seed, None)
    return found


def test_alone_the_work_is_done_at_once() -> None:
    meet(note, 1, "a")
    assert met == [[1]]
    with pytest.raises(ValueError, match="no"):
        meet(lambda members: [ValueError("no")], 1, "a")


def test_those_that_wait_for_the_same_are_served_at_once() -> None:
    def task(name: str, times: int, key: str) -> Callable[[], str]:
        def run() -> str:
            for _ in range(times):
                meet(note, name, key)
            return name.upper()

        return run

    assert run_together([task("a", 3, "x"), task("b", 1, "x"), task("c", 2, "y")]) == ["A", "B", "C"]
    assert met == [["a", "b"], ["c"], ["a"], ["c"], ["a"]]
    assert run_together([]) == []
    assert run_together([lambda: 1, lambda: 2]) == [1, 2]


def test_who_waits_inside_what_was_met_for_goes_on() -> None:
    """The work of a meeting is done for all; who comes later to another one, meets there."""

    def task(first: int) -> Callable[[], int]:
        def run() -> int:
            for _ in range(first):
                meet(note, first, "early")
            meet(note, first, "late")
            return first

        return run

    assert run_together([task(0), task(1), task(2)]) == [0, 1, 2]
    assert met == [[0], [1, 2], [1], [2], [2]]


def test_random_numbers_are_those_of_each_alone() -> None:
    seeded(99, 1)
    outside = numbers()
    alone = [seeded(seed) for seed in range(5)]
    seeded(99, 1)
    assert run_together([lambda seed=seed: seeded(seed) for seed in range(5)]) == alone  # type: ignore[misc]
    assert numbers() == outside
    assert met[-4:] == [[0, 1, 2, 3, 4]] * 4


def test_numpys_generator_can_be_drawn_from_for_a_task_that_waits() -> None:
    def drawn(members: Sequence[np.random.RandomState]) -> list[Exception | None]:
        met.append([float(each.rand()) for each in members])
        return [None] * len(members)

    def task(seed: int) -> tuple[float, float]:
        np.random.seed(seed)
        before = float(np.random.rand())
        meet(drawn, chance(), None)
        return before, float(np.random.rand())

    alone = [task(seed) for seed in range(3)]
    by_itself, met[:] = [value for (value,) in met], []
    assert run_together([lambda seed=seed: task(seed) for seed in range(3)]) == alone  # type: ignore[misc]
    assert met == [by_itself]


def test_context_variables_are_a_tasks_own() -> None:
    def task(name: str) -> Callable[[], str]:
        def run() -> str:
            assert NAME.get() == "outside"
            NAME.set(name)
            meet(lambda members: note([NAME.get()])[:1] * len(members), name, "shared")
            return NAME.get()

        return run

    assert run_together([task("a"), task("b")]) == ["a", "b"]
    assert NAME.get() == "outside"
    assert met == [["outside"]] * 2  # two works, as a lambda each


def test_a_task_by_itself_waits_for_none() -> None:
    order: list[str] = []

    def task(name: str) -> Callable[[], None]:
        def run() -> None:
            with by_itself():
                order.append(f"{name} begins")
                meet(note, name, None)
                order.append(f"{name} ends")
            meet(note, name, None)

        return run

    run_together([task("a"), task("b")])
    assert order == ["a begins", "a ends", "b begins", "b ends"]
    assert met == [["a"], ["b"], ["a", "b"]]


def test_a_task_that_fails_leaves_the_others() -> None:
    def fails() -> None:
        meet(note, "failing", None)
        raise ValueError("mine")

    def refused(members: Sequence[str]) -> list[Exception | None]:
        note(members)
        return [KeyError(name) if name == "b" else None for name in members]

    def task(name: str) -> Callable[[], str]:
        def run() -> str:
            meet(note, name, None)
            meet(refused, name, None)
            meet(note, name, None)
            return name

        return run

    first, a, b, c = run_together([fails, task("a"), task("b"), task("c")])
    assert isinstance(first, ValueError)
    assert isinstance(b, KeyError)
    assert (a, c) == ("a", "c")
    assert met == [["failing", "a", "b", "c"], ["a", "b", "c"], ["a", "c"]]


def test_a_system_exit_lets_the_others_go_on() -> None:
    done = []

    def leaves() -> None:
        meet(note, "leaving", None)
        sys.exit(7)

    def stays() -> None:
        for _ in range(3):
            meet(note, "staying", None)
        done.append("stayed")

    with pytest.raises(SystemExit) as end:
        run_together([leaves, stays])
    assert end.value.code == 7
    assert done == ["stayed"]


def test_after_a_system_exit_no_other_begins() -> None:
    """A signal that came while one was made ready, say."""
    done = []

    def first() -> None:
        meet(note, "first", None)
        done.append("first")

    with pytest.raises(SystemExit):
        run_together([first, lambda: sys.exit(1), lambda: done.append("last")])
    assert done == ["first"]


class Stop(BaseException):
    pass


@pytest.mark.parametrize("where", ["at once", "later", "in the work"])
def test_other_exceptions_are_raised_in_all(where: str) -> None:
    told: list[str] = []

    def work(members: Sequence[str]) -> list[Exception | None]:
        if where == "in the work" and len(met) == 2:
            raise Stop
        return note(members)

    def waits(name: str) -> Callable[[], None]:
        def run() -> None:
            try:
                for _ in range(9):
                    meet(work, name, None)
            except Stop:
                told.append(name)
                meet(work, name, None)  # on its way out
                raise

        return run

    def stops() -> None:
        for _ in range({"at once": 0, "later": 2, "in the work": 9}[where]):
            meet(work, "stopping", None)
        raise Stop

    with pytest.raises(Stop):
        run_together([waits("before"), stops, waits("after")])
    assert told == (["before"] if where == "at once" else ["before", "after"])


def test_the_clock_counts_a_tasks_own_time(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 0.0

    def spend(seconds: float) -> None:
        nonlocal now
        now += seconds

    monkeypatch.setattr(together.time, "perf_counter", lambda: now)

    def work(members: Sequence[Any]) -> list[Exception | None]:
        spend(2.0 * len(members))
        return [None] * len(members)

    def task(seconds: float) -> Callable[[], float]:
        def run() -> float:
            started = clock()
            for _ in range(3):
                spend(seconds)
                meet(work, None, None)
            return clock() - started

        return run

    assert run_together([task(1.0), task(10.0)]) == [3 * (1 + 2), 3 * (10 + 2)]
    assert task(1.0)() == 9


# Signals


def training(
    log: list[str], name: str, steps: int = 5, patient: bool = True, before: Callable[[], None] = lambda: None
) -> Callable[[], str]:
    """A training that is asked at each step, is saved where it is asked, and ends as a job does."""

    def run() -> str:
        request = StopRequest()
        before()
        try:
            with request.listening():
                request.patient = patient
                for step in range(steps):
                    if request.number is not None:
                        request.take_time()
                        log.append(f"{name} saved at {step}")
                    request.obey()
                    meet(send, (name, step), None)
                request.patient = False
        except Interrupted as error:
            log.append(f"{name} {error}")
            sys.exit(error.exit_code)
        return name

    return run


asked_at: dict[tuple[str, int], int] = {}  # where (name, step) work, so many signals arrive


def send(members: Sequence[tuple[str, int]]) -> list[Exception | None]:
    for member in members:
        for _ in range(asked_at.get(member, 0)):
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(0)
    return note(members)


@pytest.fixture
def at() -> Iterator[dict[tuple[str, int], int]]:
    before = signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGALRM)
    asked_at.clear()
    yield asked_at
    assert (signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGALRM)) == before
    assert signal.getitimer(signal.ITIMER_REAL)[0] == 0


def test_one_signal_asks_all_and_each_stops_at_its_safe_point(at: dict[tuple[str, int], int]) -> None:
    at["b", 2] = 1
    log: list[str] = []
    with pytest.raises(SystemExit) as end:
        run_together([training(log, name) for name in "abc"])
    assert end.value.code == 128 + signal.SIGTERM
    assert log == [line for name in "abc" for line in (f"{name} saved at 3", f"{name} stopped by SIGTERM")]


def test_those_that_have_ended_are_not_asked(at: dict[tuple[str, int], int]) -> None:
    at["b", 2] = 1
    log: list[str] = []
    done: list[str] = []
    short = training(log, "a", steps=1)
    with pytest.raises(SystemExit):
        run_together([lambda: done.append(short()), training(log, "b")])
    assert done == ["a"]
    assert log == ["b saved at 3", "b stopped by SIGTERM"]


def test_a_second_signal_stops_all_at_once(at: dict[tuple[str, int], int]) -> None:
    at["b", 2] = 2
    log: list[str] = []
    with pytest.raises(SystemExit) as end:
        run_together([training(log, name) for name in "abc"])
    assert end.value.code == 128 + signal.SIGTERM
    assert log == [f"{name} stopped by SIGTERM" for name in "abc"]


def test_a_training_that_begins_when_others_were_asked_is_asked_too(at: dict[tuple[str, int], int]) -> None:
    """One that had not begun is left for another time."""
    log: list[str] = []

    def kill() -> None:
        os.kill(os.getpid(), signal.SIGTERM)

    with pytest.raises(SystemExit):
        run_together([training(log, "a"), training(log, "b", before=kill), training(log, "c")])
    assert log == [
        line
        for name, step in [("b", 0), ("a", 1)]
        for line in (f"{name} saved at {step}", f"{name} stopped by SIGTERM")
    ]


def test_the_one_at_work_stops_at_once_where_it_cannot_be_saved(at: dict[tuple[str, int], int]) -> None:
    log: list[str] = []

    def last() -> str:
        request = StopRequest()
        with request.listening():
            meet(send, ("last", 0), None)
            os.kill(os.getpid(), signal.SIGTERM)  # not patient
            raise AssertionError("it goes on")

    def ends() -> None:
        try:
            last()
        except Interrupted as error:
            log.append("last stopped")
            sys.exit(error.exit_code)

    with pytest.raises(SystemExit):
        run_together([training(log, "a"), ends, training(log, "b")])
    assert log == [
        "last stopped",
        "b saved at 1",
        "b stopped by SIGTERM",
        "a saved at 2",
        "a stopped by SIGTERM",
    ]


def test_who_comes_to_no_safe_point_is_stopped_after_a_while(
    at: dict[tuple[str, int], int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(signals, "_SECONDS_TO_SAFE_POINT", 0.01)
    at["long", 0] = 1
    log: list[str] = []

    def sleeps(members: Sequence[Any]) -> list[Exception | None]:
        time.sleep(5)
        raise AssertionError("it slept")

    def long() -> None:
        request = StopRequest()
        try:
            with request.listening():
                request.patient = True
                meet(send, ("long", 0), None)
                meet(sleeps, "long", None)
        except Interrupted as error:
            log.append("long stopped")
            sys.exit(error.exit_code)

    started = time.monotonic()
    with pytest.raises(SystemExit):
        run_together([long, long])
    assert time.monotonic() - started < 4
    assert log == ["long stopped"] * 2


def test_in_another_thread_signals_are_left_alone() -> None:
    log: list[str] = []
    found: list[Any] = []
    thread = threading.Thread(
        target=lambda: found.extend(run_together([training(log, "a"), training(log, "b")]))
    )
    thread.start()
    thread.join()
    assert found == ["a", "b"]
    assert log == []


class Meetings:
    """Work that notes who met."""

    def __init__(self) -> None:
        self.met: list[list[str]] = []

    def work(self, members: Sequence[str]) -> list[Exception | None]:
        self.met.append(list(members))
        return [None] * len(members)

    def task(self, name: str, times: int) -> str:
        for _ in range(times):
            meet(self.work, name, "key")
        return name


def test_what_most_wait_for_is_done_first() -> None:
    """So tasks at different points of one loop come to do the same at once."""

    def first(members: Sequence[str]) -> list[Exception | None]:
        return note(members)

    def loop(name: str, begins_with: int) -> None:
        for turn in range(begins_with, 4):
            meet((first, note)[turn % 2], name, None)

    run_together([partial(loop, "a", 0), partial(loop, "b", 1), partial(loop, "c", 0)])
    assert met == [["a", "c"], ["a", "b", "c"], ["a", "b", "c"], ["a", "b", "c"]]


def test_tasks_that_a_task_begins_meet_all_others() -> None:
    meetings = Meetings()

    def parent(name: str, times: int) -> list[object]:
        return run_together([partial(meetings.task, f"{name}{number}", times) for number in range(2)])

    found = run_together([partial(parent, "a", 1), partial(parent, "b", 2), partial(meetings.task, "c", 1)])
    assert found == [["a0", "a1"], ["b0", "b1"], "c"]
    assert [sorted(names) for names in meetings.met] == [["a0", "a1", "b0", "b1", "c"], ["b0", "b1"]]


def test_a_task_goes_on_when_those_that_it_began_have_ended() -> None:
    meetings = Meetings()

    def fails() -> None:
        raise ZeroDivisionError

    def twice() -> int:
        (error,) = run_together([fails])
        assert isinstance(error, ZeroDivisionError)
        assert run_together([]) == []
        meetings.task("twice", 1)
        return len(run_together([partial(meetings.task, "inner", 1)]))

    assert run_together([twice, partial(meetings.task, "long", 3)]) == [1, "long"]
    assert sum(map(len, meetings.met)) == 5


@pytest.mark.parametrize("place", [0, 1])
def test_what_ends_all_tasks_ends_those_that_wait_for_others(place: int) -> None:
    meetings, ended = Meetings(), []

    def stops() -> None:
        meetings.task("stops", 1)
        raise KeyboardInterrupt

    def parent(tasks: Sequence[Callable[[], object]]) -> None:
        try:
            run_together(tasks)
        except KeyboardInterrupt:
            ended.append(len(tasks))
            raise

    others = [partial(parent, [partial(meetings.task, "x", 5)] * 2), partial(meetings.task, "y", 5)]
    with pytest.raises(KeyboardInterrupt):
        run_together([*others[:place], partial(parent, [stops]), *others[place:]])
    assert sorted(ended) == [1, 2]
