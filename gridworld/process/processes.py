"""Tasks in processes on this machine. None outlives this process, and each stops as this one is told to."""

from __future__ import annotations

import contextlib
import gc
import multiprocessing
import os
import re
import resource
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection, wait
from pathlib import Path
from types import FrameType
from typing import Any

from gridworld.process.signals import exiting, handling, send_sigterm

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


def run_in_processes(
    tasks: Sequence[Callable[[], Any]],
    count: int,
    forks: bool,
    ended: Callable[[int, Any], None],
    tick: Callable[[], None] = lambda: None,
) -> None:
    """Run tasks until all have ended. A process takes the next task when it has ended one.

    The first signal to stop is passed on, so that tasks stop at a safe point; the second too, so that they
    stop soon; at a third they are killed.

    Args:
        tasks: they begin in this order. They and what they return are pickled; they raise `SystemExit` only.
        count: how many processes.
        forks: whether these are forks, with what this process has imported.
        ended: called with the number of each task and what it returned, or a `LostError`.
        tick: called every now and then.

    Raises:
        SystemExit: this process was told to stop by SIGINT or SIGTERM, and so was each; all have ended.
    """
    context: Any = multiprocessing.get_context("fork" if forks else "spawn")
    waiting = deque(enumerate(tasks))
    at_work: dict[Any, tuple[Any, int | None]] = {}  # by connection: a process, and its task's number
    received: list[int] = []  # signals

    def stop(number: int, frame: FrameType | None) -> None:
        received.append(number)
        for process, _ in at_work.values():
            with contextlib.suppress(ProcessLookupError):
                os.kill(process.pid, signal.SIGKILL if len(received) > 2 else number)

    def give(connection: Any, process: Any) -> None:
        """Let a process begin the next task, or end."""
        number, task = waiting.popleft() if waiting and not received else (None, None)
        at_work[connection] = process, number
        with contextlib.suppress(OSError):  # it has ended
            connection.send(task)

    for stream in (sys.stdout, sys.stderr):
        stream.flush()  # or a fork would write it once more
    gc.freeze()  # so that forks share what there is
    with handling(dict.fromkeys(_SIGNALS, stop)):
        try:
            while at_work or (waiting and not received):
                while waiting and not received and len(at_work) < count:
                    connection, theirs = context.Pipe()
                    process = context.Process(target=_work, args=(theirs, os.getpid()))
                    process.start()
                    theirs.close()
                    give(connection, process)
                for connection in list[Any](wait(list(at_work), _SECONDS_BETWEEN_TICKS)):
                    process, number = at_work[connection]
                    try:
                        result = connection.recv()
                    except (EOFError, OSError):
                        del at_work[connection]
                        process.join()
                        if number is not None and not received:
                            ended(number, LostError(f"exit code {process.exitcode}"))
                    else:
                        assert number is not None
                        ended(number, result)
                        give(connection, process)
                tick()
        finally:
            for process, _ in at_work.values():
                process.kill()
    if received:
        raise SystemExit(128 + received[0])


def _work(connection: Connection[Any, Any], parent: int) -> None:
    """What a process does."""
    os.setpgrp()  # a terminal's Ctrl-C reaches the parent, which passes it on once
    threading.Thread(target=_end_with, args=(parent,), daemon=True, name="watch on the parent").start()
    with exiting(*_SIGNALS), contextlib.suppress(EOFError):
        while (task := connection.recv()) is not None:
            connection.send(task())


def _end_with(parent: int) -> None:
    """End this process soon after its parent, even if that is killed: first by SIGTERM, then in any case."""
    while os.getppid() == parent:
        time.sleep(_SECONDS_BETWEEN_CHECKS)
    send_sigterm()
    time.sleep(_GRACE_SECONDS)
    os._exit(1)
