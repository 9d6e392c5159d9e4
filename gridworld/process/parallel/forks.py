"""Tasks side by side in forks of this process, which have what it has imported and composed.

A fork takes the next task when it has ended one. Ctrl-C and SIGTERM, which come to this process, to all, or
to both, are passed on: each fork stops as this process would, and is waited for. None outlives this process.
"""

from __future__ import annotations

import contextlib
import gc
import os
import pickle
import signal
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, Pipe, wait
from types import FrameType
from typing import Any, NoReturn

from gridworld.process.parallel.parent_watch import end_with
from gridworld.process.signals import blocking, exiting, handling

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class LostError(Exception):
    """A fork was killed."""


def can_fork() -> bool:
    """Whether tasks may run in forks: on Linux, unless a debugger or a profiler looks at this process."""
    monitoring = getattr(sys, "monitoring", None)  # from Python 3.12 on
    watched = sys.gettrace() or sys.getprofile() or (monitoring and any(map(monitoring.get_tool, range(6))))
    return sys.platform == "linux" and not watched


def run_in_forks(tasks: Sequence[Callable[[], Any]], count: int) -> list[Any]:
    """Run tasks in forks until all have ended.

    Args:
        tasks: they begin in this order. What one returns or raises is pickled.
        count: how many run at a time.

    Returns:
        What each returned; None where its fork was told to stop.

    Raises:
        SystemExit: this process was told to stop, by SIGINT or SIGTERM; all forks have ended.
        LostError: a fork was killed. The tasks that were at work have ended, the others did not begin.
        Exception: a task raised it, and the same holds.
    """
    crew = _Crew(tasks)
    with handling(dict.fromkeys(_SIGNALS, crew.stop)):
        try:
            crew.start(min(count, len(tasks)))
            crew.run()
        finally:
            crew.kill()
    if crew.received:
        raise SystemExit(128 + crew.received[0])
    if crew.error is not None:
        raise crew.error
    return crew.results


@dataclass
class _Fork:
    process: int
    connection: Connection[Any, Any]
    task: int | None = None  # its number, while it is at work


class _Crew:
    """The forks, and what is left to do."""

    def __init__(self, tasks: Sequence[Callable[[], Any]]) -> None:
        self._tasks = tasks
        self._begun = 0
        self._forks: list[_Fork] = []
        self.results: list[Any] = [None] * len(tasks)
        self.received: list[int] = []  # signals
        self.error: BaseException | None = None

    def start(self, count: int) -> None:
        for stream in (sys.stdout, sys.stderr):
            stream.flush()  # or a fork would write it once more
        gc.freeze()  # so that the forks share it
        for _ in range(count):
            self._forks.append(self._fork())
            self._give(self._forks[-1])

    def run(self) -> None:
        """Hand out the tasks until all have ended."""
        while self._forks:
            ready = wait([fork.connection for fork in self._forks])
            for fork in [fork for fork in self._forks if fork.connection in ready]:
                try:
                    is_well, outcome = pickle.loads(fork.connection.recv_bytes())
                except (EOFError, OSError):
                    self._note_end(fork)
                    continue
                if is_well:
                    assert fork.task is not None
                    self.results[fork.task] = outcome
                else:
                    self.error = self.error or outcome
                self._give(fork)

    def stop(self, number: int, frame: FrameType | None) -> None:
        """Handle a signal: the first stops the forks in their time, the second soon, a third at once."""
        self.received.append(number)
        for fork in self._forks:
            os.kill(fork.process, signal.SIGKILL if len(self.received) > 2 else number)

    def kill(self) -> None:
        """End what is left, where waiting for it has failed."""
        for fork in self._forks:
            os.kill(fork.process, signal.SIGKILL)
            os.waitpid(fork.process, 0)

    def _give(self, fork: _Fork) -> None:
        """Let it begin the next task, or end."""
        fork.task = None
        if self._begun < len(self._tasks) and not self.received and self.error is None:
            fork.task = self._begun
            self._begun += 1
        with contextlib.suppress(OSError):  # it has ended
            fork.connection.send(fork.task)

    def _note_end(self, fork: _Fork) -> None:
        self._forks.remove(fork)
        fork.connection.close()
        code = os.waitstatus_to_exitcode(os.waitpid(fork.process, 0)[1])
        if code < 0 and fork.task is not None:
            self.error = self.error or LostError(f"by signal {-code}")

    def _fork(self) -> _Fork:
        parent = os.getpid()
        ours, others = Pipe()
        with blocking(*_SIGNALS):
            process = os.fork()
            if process == 0:
                for fork in self._forks:
                    fork.connection.close()
                ours.close()
                end_with(parent)
                os.setpgrp()  # a terminal's Ctrl-C reaches the parent, which passes it on once
        if process == 0:
            with exiting(*_SIGNALS):
                self._work(others)
        others.close()
        return _Fork(process, ours)

    def _work(self, connection: Connection[Any, Any]) -> NoReturn:
        """What a fork does."""
        code = 1
        try:
            while (number := connection.recv()) is not None:
                connection.send_bytes(_packed(self._tasks[number]))
            code = 0
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else 1
        except BaseException:
            sys.excepthook(*sys.exc_info())
        finally:
            for stream in (sys.stdout, sys.stderr):
                with contextlib.suppress(Exception):
                    stream.flush()
            os._exit(code)


def _packed(task: Callable[[], Any]) -> bytes:
    """Run a task: whether it returned, and what it returned or raised, pickled."""
    try:
        outcome = True, task()
    except SystemExit:
        raise
    except BaseException as error:
        outcome = False, error
    try:
        content = pickle.dumps(outcome)
        pickle.loads(content)  # as some exceptions cannot be
    except Exception:
        return pickle.dumps((False, RuntimeError(repr(outcome[1]))))
    return content
