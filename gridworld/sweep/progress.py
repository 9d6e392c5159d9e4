"""The sweep's progress line: how many jobs are done, running and failed, and how long the rest may take.

It is read from jobs.csv, so it is the same wherever the jobs run.
"""

from __future__ import annotations

import os
import threading
import time
from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import contextmanager

from gridworld.process.console.progress import ProgressLine, time_left
from gridworld.sweep.job_table import DONE, FAILED, RUNNING, JobTable

_SECONDS_BETWEEN_READS = 0.5
_SHARE_OF_TIME = 30  # reading a long table takes at most one thirtieth of the time

_showing = threading.Lock()  # held by none while this process forks: what the thread has locked would stay so
if hasattr(os, "register_at_fork"):
    os.register_at_fork(
        before=_showing.acquire, after_in_parent=_showing.release, after_in_child=_showing.release
    )


@contextmanager
def sweep_progress(
    table: JobTable, jobs: Collection[str], ended_before: int, enabled: bool
) -> Iterator[None]:
    """Show the sweep's line while the block runs.

    Args:
        table: the sweep's jobs.csv.
        jobs: names of the jobs to count.
        ended_before: how many of them this sweep need not run.
        enabled: if not, nothing is shown.
    """
    if not enabled:
        yield
        return
    line, started, over = ProgressLine(enabled), time.monotonic(), threading.Event()

    def show(counts: Counter[str]) -> None:
        line.show(lambda: sweep_line(counts, len(jobs), ended_before, time.monotonic() - started))

    def watch() -> None:
        seen: object = None
        counts: Counter[str] = Counter()
        wait = _SECONDS_BETWEEN_READS
        while not over.wait(wait):
            began = time.monotonic()
            with _showing:
                try:
                    changed = table.file.stat().st_mtime_ns
                except OSError:  # somebody took the table away; the next change of a row brings it back
                    continue
                if changed != seen:
                    seen = changed
                    rows = table.read()
                    counts = Counter(rows[job].status for job in jobs if job in rows)
                    wait = max(_SECONDS_BETWEEN_READS, _SHARE_OF_TIME * (time.monotonic() - began))
                show(counts)

    thread = threading.Thread(target=watch, daemon=True, name="sweep progress")
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join(timeout=2)
        line.clear()


def sweep_line(counts: Counter[str], jobs: int, ended_before: int, seconds: float) -> str:
    """The line after so many seconds of this sweep, with `counts` of jobs by status."""
    ended = counts[DONE] + counts[FAILED]
    failed = f", {counts[FAILED]} failed" if counts[FAILED] else ""
    return (
        f"sweep: {counts[DONE]} of {jobs} jobs done, {counts[RUNNING]} running{failed}"
        f"{time_left(ended - ended_before, jobs - ended, seconds)}"
    )
