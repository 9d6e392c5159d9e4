"""Populations on this machine: in forks of this process, in new processes, or in this process itself.

Forks share what this process has imported. Jobs with code of the user's, or on a GPU, run in this process
when the others have ended. So do all jobs where there is one core or one population, or no `fork`.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial

from gridworld.process.processes import run_in_processes
from gridworld.sweep.launchers import Group, Launch
from gridworld.training.setup import import_for

_SECONDS_BETWEEN_TICKS = 1.0


def run(launch: Launch, count: int, forks: bool, elsewhere: Callable[[Group], bool], least: int) -> None:
    """Run populations."""
    others = [jobs for jobs in launch.groups if elsewhere(jobs)]
    here: Sequence[Group] = [jobs for jobs in launch.groups if not elsewhere(jobs)]
    if min(count, len(others)) < least:
        others, here = [], launch.groups
    if others:
        if forks:
            import_for(others[0][0].config)  # once for all
        tasks = [partial(launch.worker, jobs) for jobs in others]
        run_in_processes(
            tasks, count, forks, lambda number, found: launch.ended(others[number], found), launch.tick
        )
    with _ticking(launch.tick):
        for jobs in here:
            launch.ended(jobs, launch.worker(jobs))


@contextmanager
def _ticking(tick: Callable[[], None]) -> Iterator[None]:
    over = threading.Event()

    def watch() -> None:
        while not over.wait(_SECONDS_BETWEEN_TICKS):
            tick()

    thread = threading.Thread(target=watch, daemon=True, name="sweep progress")
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join(timeout=2)
