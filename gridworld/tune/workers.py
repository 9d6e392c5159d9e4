"""Processes that run tasks and end with the command. One that is killed is replaced, its task run again."""

from __future__ import annotations

import math
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import Any, TypeVar

from gridworld.process.signals import blocking, signal_name

Ask = Callable[[Any], Any]  # by which a task sends a message to the command, and gets the answer
Task = Callable[[Ask], Any]  # pickled, as is what it returns

T = TypeVar("T")

_LARGEST = 32  # runs that train together; more train no faster
_POLL_SECONDS = 0.1
_STOP_WITHIN = 3.0  # seconds
_MOST_KILLED = 4  # workers in one task: what kills them may be the task
_MOST_LOST = 20  # a machine on which more are killed has no room for them


class SearchError(Exception):
    """A search that had begun came to nothing, or cannot be continued; in one sentence."""


@dataclass(eq=False)
class _Worker:
    process: SpawnProcess
    connection: Connection[Any, Any]
    task: Task | None = None


class Workers:
    """So many processes, which start when there is a task for them and stop at the end of the block."""

    def __init__(self, count: int) -> None:
        self.count = count
        self._workers: list[_Worker] = []
        self._lost = 0

    def __enter__(self) -> Workers:
        return self

    def __exit__(self, *error: object) -> None:
        for worker in self._workers:
            worker.process.terminate()
        end = time.monotonic() + _STOP_WITHIN
        for worker in self._workers:
            worker.process.join(max(0.0, end - time.monotonic()))
            worker.process.kill()
            worker.process.join()

    def shares(self, runs: Sequence[T], can_join: bool) -> Iterator[Sequence[T]]:
        """Divide runs into tasks: of runs that train together as many to each worker, of others one each."""
        size = max(1, min(_LARGEST, math.ceil(len(runs) / self.count))) if can_join else 1
        return (runs[start : start + size] for start in range(0, len(runs), size))

    def run(
        self,
        next_task: Callable[[], Task | None],
        on_end: Callable[[Any, Any], None],
        answer: Callable[[Any], Any] = lambda message: None,
        on_tick: Callable[[], None] = lambda: None,
    ) -> None:
        """Run tasks until there are none."""
        again: list[Task] = []
        killed = Counter[int]()

        def lose(worker: _Worker, task: Task) -> None:
            self._replace(worker)
            killed[id(task)] += 1
            if killed[id(task)] < _MOST_KILLED:
                again.append(task)
            else:
                end(task, None)

        def end(task: Task, result: Any) -> None:
            killed.pop(id(task), None)
            on_end(task, result)

        while True:
            while self._has_room() and (task := again.pop() if again else next_task()) is not None:
                worker = self._idle()
                worker.task = task
                try:
                    worker.connection.send(task)
                except OSError:
                    lose(worker, task)
            busy = {worker.connection: worker for worker in self._workers if worker.task is not None}
            if not busy:
                return
            for connection in wait(list(busy), _POLL_SECONDS):
                worker = busy[connection]  # type: ignore[index]
                task = worker.task
                assert task is not None
                try:
                    is_result, content = worker.connection.recv()
                    if not is_result:
                        worker.connection.send(answer(content))
                except (EOFError, OSError):
                    lose(worker, task)
                    continue
                if is_result:
                    worker.task = None
                    end(task, content)
            on_tick()

    def _has_room(self) -> bool:
        return len(self._workers) < self.count or any(worker.task is None for worker in self._workers)

    def _idle(self) -> _Worker:
        """A worker without a task, which is started where there is none."""
        if (found := next((worker for worker in self._workers if worker.task is None), None)) is not None:
            return found
        context = multiprocessing.get_context("spawn")
        ours, others = context.Pipe()
        with blocking(signal.SIGINT):  # Ctrl-C is for this process, which then ends the workers
            process = context.Process(target=_work, args=(others,), daemon=True)
            process.start()
        others.close()
        self._workers.append(_Worker(process, ours))
        return self._workers[-1]

    def _replace(self, worker: _Worker) -> None:
        """Make room for another worker in place of one that has ended."""
        self._workers.remove(worker)
        worker.process.join()
        code = worker.process.exitcode or 0
        if code >= 0:
            raise SearchError("a worker failed, with the reason above; no more is run")
        print(
            f"a worker was lost to {signal_name(-code)}; its task is run again", file=sys.stderr, flush=True
        )
        self._lost += 1
        if self._lost > _MOST_LOST:
            raise SearchError(f"{self._lost} workers were killed; is there memory for so many?")


def _work(connection: Connection[Any, Any]) -> None:
    """What a worker does."""
    threading.Thread(target=_end_with_parent, daemon=True).start()

    def ask(message: Any) -> Any:
        connection.send((False, message))
        return connection.recv()

    while True:
        try:
            task = connection.recv()
        except EOFError:
            return
        connection.send((True, task(ask)))


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
