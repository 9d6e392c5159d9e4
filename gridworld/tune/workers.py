"""The processes that run a study's tasks. A task whose process is killed is run again."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

from gridworld.process.console import tell
from gridworld.process.processes import LostError, run_in_processes
from gridworld.process.together import LARGEST

Ask = Callable[[Any], Any]  # by which a task sends a message to the command, and gets the answer
Task = Callable[[Ask], Any]  # pickled, as is what it returns

T = TypeVar("T")

_MOST_LOST = 4  # processes in one task: what kills them may be the task


class SearchError(Exception):
    """A search that had begun came to nothing, or cannot be continued; in one sentence."""


@dataclass
class Workers:
    """So many processes, forks or new ones."""

    count: int
    forks: bool

    def shares(self, runs: Sequence[T], can_join: bool) -> Iterator[Sequence[T]]:
        """Divide runs into tasks: of runs that train together as many to each worker, of others one each."""
        size = max(1, min(LARGEST, math.ceil(len(runs) / self.count))) if can_join else 1
        return (runs[start : start + size] for start in range(0, len(runs), size))

    def run_all(
        self, tasks: Iterable[Task], on_end: Callable[[Any, Any], None] = lambda task, result: None
    ) -> None:
        """Run tasks; see `run`."""
        waiting = iter(tasks)
        self.run(lambda: next(waiting, None), on_end)

    def run(
        self,
        next_task: Callable[[], Task | None],
        on_end: Callable[[Any, Any], None],
        answer: Ask = lambda message: None,
        on_tick: Callable[[], None] = lambda: None,
    ) -> None:
        """Run tasks until there are none; the result of one that has killed too many processes is None."""
        again: list[Task] = []
        lost = Counter[int]()  # processes, by the task

        def ended(task: Task, result: Any) -> None:
            if isinstance(result, LostError):
                lost[id(task)] += 1
                tell(f"a worker died ({result}), attempt {lost[id(task)]} of {_MOST_LOST} at its task")
                if lost[id(task)] < _MOST_LOST:
                    again.append(task)
                    return
                result = None
            del lost[id(task)]
            on_end(task, result)

        def following() -> Task | None:
            return again.pop() if again else next_task()

        run_in_processes(following, self.count, self.forks, ended, on_tick, answer)
