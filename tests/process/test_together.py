"""Tasks that run together, and those that a task begins."""

from collections.abc import Callable, Sequence
from functools import partial

import pytest

from gridworld.process.together import meet, run_together


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
