"""Trainings that run together: none can tell that the others are there."""

import signal
import time
from collections.abc import Callable, Sequence
from contextvars import ContextVar, copy_context
from functools import partial
from typing import Any

import pytest

from gridworld.agents import Learning
from gridworld.base.signals import Interrupted
from gridworld.base.together import clock
from gridworld.training.together import Training, run_alone, run_together

NAME: ContextVar[str] = ContextVar("name", default="outside")


class Walker:
    """An agent that makes steps in turn with all others of its class, as a population does."""

    together: list[int]

    def __init__(self, name: str, at_step: dict[int, Callable[[], Any]] | None = None) -> None:
        self.name, self.at_step = name, at_step or {}

    def learn_together(self, learnings: Sequence[Learning]) -> list[BaseException | None]:
        Walker.together.append(len(learnings))
        errors: dict[int, BaseException | None] = {}
        for step in range(1, 1 + max(each.total_timesteps for each in learnings)):
            for place, each in enumerate(learnings):
                if place in errors:
                    continue
                try:
                    agent: Any = each.agent
                    if each.on_safe_point is not None:
                        each.on_safe_point(step)
                    agent.at_step.get(step, int)()  # of nobody's own: what it raises ends all
                    if not each.on_step(step) or step >= each.total_timesteps:
                        errors[place] = None
                except Interrupted:
                    raise
                except BaseException as error:
                    errors[place] = error
        return [errors[place] for place in range(len(learnings))]


@pytest.fixture(autouse=True)
def nobody_yet() -> None:
    Walker.together = []


def walk(
    log: list[str],
    name: str,
    steps: int = 3,
    at_step: dict[int, Callable[[], Any]] | None = None,
    then: Callable[[], Any] = int,
) -> Training[str]:
    assert NAME.get() == "outside"
    NAME.set(name)
    seen: list[int] = []

    def on_step(step: int) -> int:
        assert NAME.get() == name
        seen.append(step)
        return step + 1

    try:
        yield Learning(Walker(name, at_step), steps, on_step)  # type: ignore[arg-type]
        assert NAME.get() == name
        then()
    except BaseException as error:
        log.append(f"{name} ended by {type(error).__name__}")
        raise
    log.append(f"{name} walked {seen}")
    return name.upper()


def raises(error: BaseException) -> Callable[[], Any]:
    def call() -> None:
        raise error

    return call


def test_each_is_what_it_is_alone() -> None:
    alone: list[str] = []
    for name, steps in (("a", 3), ("b", 1)):
        assert copy_context().run(run_alone, walk(alone, name, steps)) == name.upper()
    assert Walker.together == [1, 1]
    log: list[str] = []
    assert run_together([walk(log, "a", 3), walk(log, "b", 1)]) == ["A", "B"]
    assert log == alone == ["a walked [1, 2, 3]", "b walked [1]"]
    assert Walker.together[2:] == [2]
    assert NAME.get() == "outside"
    assert run_together([]) == []


def ends_by(error: BaseException, where: str, log: list[str]) -> Training[str]:
    """A training that raises this before, while or after it learns."""
    raising = raises(error)
    if where == "before":
        raising()
    at_step = {2: raising} if where == "learning" else {}
    return (yield from walk(log, "b", at_step=at_step, then=raising if where == "after" else int))


@pytest.mark.parametrize("where", ["before", "learning", "after"])
def test_one_that_fails_leaves_the_others_and_all_end_where_it_is_no_exception(where: str) -> None:
    def together(error: BaseException) -> list[Any]:
        log.clear()
        return run_together([walk(log, "a"), ends_by(error, where, log), walk(log, "c")])

    log: list[str] = []
    failure = ZeroDivisionError("by zero")
    assert together(failure) == ["A", failure, "C"]
    assert [line for line in log if line[0] != "b"] == ["a walked [1, 2, 3]", "c walked [1, 2, 3]"]
    with pytest.raises(SystemExit, match="3"):  # those that had not begun are left for another time
        together(SystemExit(3))
    walked = ["a walked [1, 2, 3]"] + ["c walked [1, 2, 3]"] * (where != "before")
    assert [line for line in log if line[0] != "b"] == walked
    with pytest.raises(Interrupted):
        together(Interrupted(signal.SIGTERM))
    ended = {"before": "a", "learning": "abc", "after": "bc"}[where]
    assert {line for line in log if "ended" in line} == {f"{name} ended by Interrupted" for name in ended}


def test_the_clock_counts_a_runs_share() -> None:
    seconds: list[float] = []

    def timed() -> Training[None]:
        started = clock()
        yield Learning(Walker("a", {1: partial(time.sleep, 0.2)}), 1, lambda step: 1)  # type: ignore[arg-type]
        seconds.append(clock() - started)

    started = time.perf_counter()
    run_together([timed(), timed()])
    assert min(seconds) >= 0.2
    assert sum(seconds) <= time.perf_counter() - started
