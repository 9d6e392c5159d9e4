"""Worker processes, watched: one that is killed is replaced, and none outlives the command."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Callable, Sequence
from multiprocessing.context import SpawnProcess
from typing import Any, TypeVar

from gridworld.errors import FolderLostError
from gridworld.process.console.terminal import tell_error
from gridworld.process.signals import StopRequest, blocking, signal_name

# What a worker's process runs: (what it needs to know, the worker's number, its parent's process id). It ends
# with the parent, however that ends.
WorkerMain = Callable[[Any, int, int], None]

T = TypeVar("T")

UNREACHABLE = 3  # exit code of a worker that lost the study, and printed nothing

_POLL_SECONDS = 0.1
_STOP_WITHIN = 3.0  # seconds
_MOST_LOST = 20  # a machine on which more are killed has no room for them


class SearchError(Exception):
    """A search that had begun came to nothing, or cannot go on; in one sentence."""


class StorageLostError(SearchError):
    """The study cannot be reached any more."""


def run_workers(
    main: WorkerMain,
    context: Any,
    workers: int,
    on_tick: Callable[[], None] = lambda: None,
) -> None:
    """Run `main` in worker processes until all have ended.

    Args:
        main: what each process runs.
        context: what `main` needs to know, to be pickled.
        workers: how many processes.
        on_tick: called ten times a second meanwhile.

    Raises:
        Interrupted: at Ctrl-C and SIGTERM.
        SearchError: the last worker failed, or too many were killed.
        StorageLostError: the last worker lost the study.
    """
    processes: dict[int, SpawnProcess] = {}
    lost = 0
    with StopRequest().listening():
        try:
            for number in range(workers):
                processes[number] = _start(main, context, number)
            while processes:
                for number, process in list(processes.items()):
                    if process.exitcode is None:
                        continue
                    del processes[number]
                    if process.exitcode == UNREACHABLE and not processes:
                        raise StorageLostError("the last worker could not write to it")
                    if process.exitcode > 0 and not processes:
                        raise SearchError("the last worker failed, with the reason above; no more is run")
                    if process.exitcode < 0:
                        lost += 1
                        _tell(-process.exitcode)
                        if lost > _MOST_LOST:
                            raise SearchError(f"{lost} workers were killed; is there memory for so many?")
                        processes[workers + lost] = _start(main, context, workers + lost)
                on_tick()
                time.sleep(_POLL_SECONDS)
        finally:
            _stop(processes.values())


def share(work: Sequence[T], worker: int, workers: int) -> Sequence[T]:
    """A worker's part of the work that `workers` have at first; all of it for one that replaces another."""
    if worker >= workers:
        return work
    return work[len(work) * worker // workers : len(work) * (worker + 1) // workers]


def _start(main: WorkerMain, context: Any, number: int) -> SpawnProcess:
    process = multiprocessing.get_context("spawn").Process(
        target=_run, args=(main, context, number, os.getpid()), daemon=True
    )
    with blocking(signal.SIGINT):  # Ctrl-C is for this process
        process.start()
    return process


def _run(main: WorkerMain, context: Any, number: int, parent: int) -> None:
    try:
        main(context, number, parent)
    except FolderLostError as error:
        tell_error(str(error))
        sys.exit(1)


def _stop(processes: Any) -> None:
    for process in processes:
        process.terminate()
    end = time.monotonic() + _STOP_WITHIN
    for process in processes:
        process.join(max(0.0, end - time.monotonic()))
        if process.exitcode is None:
            process.kill()
            process.join()


def _tell(number: int) -> None:
    print(f"a worker was lost to {signal_name(number)}; its trial is run again", file=sys.stderr, flush=True)
