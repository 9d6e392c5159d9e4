"""Jobs side by side on this machine, in joblib's worker processes.

hydra-joblib-launcher does the same, but sends all of Hydra's state with each job and searches for plugins
before each: with runs this short it took 40 % more processor time.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Mapping, Sequence
from typing import Any

from hydra.core.utils import JobReturn
from joblib import Parallel, delayed

from gridworld.process.parallel.parent_watch import end_with, parent_died
from gridworld.sweep.launchers.worker import JobRunner, unpack

_end_with = functools.cache(end_with)  # once for each worker process


def launch(
    runner: JobRunner, settings: Mapping[str, Any], jobs: Sequence[Sequence[str]], first: int
) -> list[JobReturn]:
    """Run jobs.

    Args:
        runner: runs a job.
        settings: of the launcher, as `gridworld.config.sweep` has them.
        jobs: the overrides of each.
        first: the first job's number.

    Returns:
        What each came to, in order. The status is unknown where a job's process was told to stop, or lost.

    Raises:
        StopSweep: a job failed, and that is to stop the sweep.
        InputError: the cluster of another launcher is not there, or refuses the jobs.
    """
    state, parent = runner.packed(), os.getpid()
    return list(
        Parallel(n_jobs=settings["n_jobs"], backend="loky", batch_size=1)(
            delayed(_run)(state, parent, list(overrides), number)
            for number, overrides in enumerate(jobs, first)
        )
    )


def _run(state: bytes, parent: int, overrides: list[str], number: int) -> JobReturn:
    if parent != os.getpid():  # the same where there is one worker only
        _end_with(parent)
    try:
        return unpack(state).run(overrides, number)
    except SystemExit:
        if parent_died.is_set():
            os._exit(1)  # no process takes the result; waiting for that would take seconds
        raise
