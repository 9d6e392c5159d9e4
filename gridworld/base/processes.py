"""Tasks in processes on this machine. None outlives this process, and each stops as this one is told to."""

from __future__ import annotations

import contextlib
import gc
import math
import multiprocessing
import os
import re
import resource
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from pathlib import Path
from types import FrameType
from typing import Any, TypeVar

from gridworld.base.console import tell
from gridworld.base.signals import blocking, exiting, handling, send_sigterm
from gridworld.base.together import LARGEST

Task = Callable[..., Any]
T = TypeVar("T")

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_SECONDS_BETWEEN_TICKS = 0.5
_SECONDS_BETWEEN_CHECKS = 0.2  # of the parent
_GRACE_SECONDS = 3.0  # to close the files


def core_count() -> int:
    """The cores, as far as the system says so."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def worker_count(asked: int) -> int:
    """How many workers `n_jobs` asks for: so many, or below 0 one for each core but `-1 - n_jobs`."""
    return asked if asked > 0 else max(1, core_count() + 1 + asked)


def file_limit() -> int:
    """How many files this process may have open at once."""
    limit = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    return sys.maxsize if limit == resource.RLIM_INFINITY else limit


def free_memory() -> int:
    """Bytes that programs can still have; half of all where the system does not say."""
    meminfo = Path("/proc/meminfo")
    known = re.search(r"MemAvailable:\s*(\d+) kB", meminfo.read_text() if meminfo.exists() else "")
    if known is not None:
        return 1024 * int(known[1])
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2


def can_fork() -> bool:
    """Whether tasks may run in forks: on Linux, unless a debugger or a profiler looks at this process."""
    monitoring = getattr(sys, "monitoring", None)  # from Python 3.12 on
    watched = sys.gettrace() or sys.getprofile() or (monitoring and any(map(monitoring.get_tool, range(6))))
    return sys.platform == "linux" and not watched


class LostError(Exception):
    """A task's process was lost."""


class Processes:
    """Processes on this machine, `count` at once, forks with what this process has imported or new ones.

    They run tasks. These are pickled, as is what they return, and raise `SystemExit` only. A task whose
    process is lost is run again, `attempts` times in all.
    """

    def __init__(self, count: int, forks: bool, attempts: int = 1) -> None:
        self.count, self.forks, self.attempts = count, forks, attempts
        self._received: list[int] = []
        self._context: Any = multiprocessing.get_context("fork" if forks else "spawn")
        # By connection: the process, its task, and how many processes that has lost.
        self._at_work: dict[Any, tuple[Any, Task | None, int]] = {}
        self._again: list[tuple[Task, int]] = []  # tasks whose process was lost

    def shares(self, runs: Sequence[T], can_join: bool) -> Iterator[Sequence[T]]:
        """Divide runs into tasks: of runs that train together as many to each process, of others one each."""
        size = max(1, min(LARGEST, math.ceil(len(runs) / self.count))) if can_join else 1
        return (runs[start : start + size] for start in range(0, len(runs), size))

    def run(
        self,
        tasks: Iterable[Task],
        ended: Callable[[Any, Any], None] = lambda task, result: None,
        tick: Callable[[], None] = lambda: None,
        answer: Callable[[Any], Any] | None = None,
    ) -> None:
        """Run tasks until all have ended; whatever stops that, no process is left.

        The next task is taken when there is a process for it. `ended` gets each task and what it returned, or
        a `LostError`; `tick` is called every now and then. With `answer`, tasks are called with a function
        that sends a message and returns its answer.

        The first SIGINT or SIGTERM is passed on, so that tasks stop at a safe point; the second too, so that
        they stop soon; at a third they are killed. Then this raises `SystemExit`.
        """
        self._tasks, self._ended, self._answer = iter(tasks), ended, answer
        for stream in (sys.stdout, sys.stderr):
            stream.flush()  # or a fork would write it once more
        if self.forks:
            gc.freeze()  # so that they share what there is
        else:
            resource_tracker.ensure_running()  # which else would unblock signals while a process starts
        with handling(dict.fromkeys(_SIGNALS, self._stop)):
            try:
                self._start_missing()
                while self._at_work:
                    for connection in wait(list(self._at_work), _SECONDS_BETWEEN_TICKS):
                        self._take(connection)
                    self._start_missing()
                    tick()
            finally:
                for process, *_ in self._at_work.values():
                    process.kill()
                    process.join()
        if self._received:
            raise SystemExit(128 + self._received[0])

    def _stop(self, number: int, frame: FrameType | None) -> None:
        """Handle a signal: pass it on."""
        self._received.append(number)
        for process, *_ in self._at_work.values():
            with contextlib.suppress(ProcessLookupError):
                os.kill(process.pid, signal.SIGKILL if len(self._received) > 2 else number)

    def _next(self) -> tuple[Task | None, int]:
        if self._received:
            return None, 0
        return self._again.pop() if self._again else (next(self._tasks, None), 0)

    def _start_missing(self) -> None:
        while len(self._at_work) < self.count and (following := self._next())[0] is not None:
            connection, theirs = self._context.Pipe()
            with blocking(*_SIGNALS):  # until the process has handlers of its own
                may_ask = self._answer is not None
                process = self._context.Process(target=_work, args=(theirs, os.getpid(), may_ask))
                process.start()
                self._give(connection, process, following)
            theirs.close()

    def _give(self, connection: Any, process: Any, following: tuple[Task | None, int]) -> None:
        """Let a process begin a task; None: let it end."""
        self._at_work[connection] = (process, *following)
        with contextlib.suppress(OSError):  # it has ended
            connection.send(following[0])

    def _take(self, connection: Any) -> None:
        """Take a result, answer a message, or note that the process has ended."""
        process, task, lost = self._at_work[connection]
        try:
            is_result, content = connection.recv()
        except (EOFError, OSError):
            del self._at_work[connection]
            connection.close()
            process.join()
            if task is not None and not self._received:
                self._lose(task, lost + 1, f"exit code {process.exitcode}")
            return
        if is_result:
            self._ended(task, content)
            self._give(connection, process, self._next())
        elif self._answer is not None:
            reply = self._answer(content)
            with contextlib.suppress(OSError):
                connection.send(reply)

    def _lose(self, task: Task, lost: int, why: str) -> None:
        if self.attempts > 1:
            tell(f"a worker died ({why}), attempt {lost} of {self.attempts} at its task")
        if lost < self.attempts:
            self._again.append((task, lost))
        else:
            self._ended(task, LostError(why))


def _work(connection: Connection[Any, Any], parent: int, may_ask: bool) -> None:
    """What a process does."""
    os.setpgrp()  # a terminal's Ctrl-C reaches the parent, which passes it on once
    end_with(parent)

    def ask(message: Any) -> Any:
        connection.send((False, message))
        return connection.recv()

    with exiting(*_SIGNALS), contextlib.suppress(EOFError, BrokenPipeError):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)
        while (task := connection.recv()) is not None:
            connection.send((True, task(ask) if may_ask else task()))


def end_with(parent: int) -> None:
    """End this process soon after its parent, even if that is killed: first by SIGTERM, then in any case."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_SECONDS_BETWEEN_CHECKS)
        send_sigterm()
        time.sleep(_GRACE_SECONDS)
        os._exit(1)

    threading.Thread(target=watch, daemon=True, name="watch on the parent").start()
