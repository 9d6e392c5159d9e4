"""Populations on a Slurm cluster, as tasks of one job array, submitted by submitit.

A task can run several populations in turn, since a job of a second is not worth a place in the queue. Its
results are read from its files, and whether it has ended from `squeue`; submitit would ask `sacct`, which
only works where accounting is set up.
"""

from __future__ import annotations

import contextlib
import functools
import math
import re
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import submitit

from gridworld.errors import InputError
from gridworld.process.console import printable
from gridworld.process.processes import LostError
from gridworld.storage.atomic_write import inside, remove_path
from gridworld.sweep.launchers import Group, Launch, Task, collect

_FOLDER = ".slurm"  # in the sweep's: what submitit writes
_POLL_SECONDS = 1.0
_SECONDS_BETWEEN_QUESTIONS = 5.0  # to Slurm, which answers others too
_FILES_ARRIVE_WITHIN = 15.0  # seconds, over a network
_SLURMS_NAMES = {"array_parallelism", "partition", "account", "qos", "constraint", "setup", "signal_delay_s"}


class SlurmTask:
    """A task of the array."""

    def __init__(self, job: submitit.Job[list[str]]) -> None:
        self.job = job
        self._left: float | None = None  # when it was first not in the queue

    def done(self) -> bool:
        """See `Task`."""
        if self.job.paths.result_pickle.exists():
            return True
        queue = _queue(time.monotonic() // _SECONDS_BETWEEN_QUESTIONS)
        if queue is None or self.job.job_id in queue:
            return False
        self._left = self._left or time.monotonic()
        return time.monotonic() > self._left + _FILES_ARRIVE_WITHIN

    def result(self) -> list[str]:
        """See `Task`."""
        if not self.job.paths.result_pickle.exists():
            lines = [line for line in (self.job.stderr() or "").splitlines() if line.strip()]
            why = lines[-1].strip() if lines else f"nothing was written to {self.job.paths.stderr}"
        elif (error := self.job.exception()) is not None:
            why = str(error).strip().splitlines()[-3]
        else:
            return self.job.result()
        print(printable(f"slurm: task {self.job.job_id} was lost: {why}"), file=sys.stderr, flush=True)
        raise LostError(why)


@functools.lru_cache(maxsize=1)  # asked once in a while
def _queue(moment: float) -> tuple[str, ...] | None:
    """The user's tasks in Slurm's queue; None where the question failed."""
    command = ["squeue", "--me", "--noheader", "--array", "--format=%i"]
    answer = subprocess.run(command, capture_output=True, text=True, check=False)
    return tuple(answer.stdout.split()) if answer.returncode == 0 else None


def run(launch: Launch, settings: Mapping[str, Any]) -> None:
    """Run populations. Raises as `launchers.local.run`, and `InputError` where Slurm takes no jobs."""
    chunks = _chunks(launch.groups, settings["jobs_per_task"])
    _refuse_too_many(len(chunks), sum(map(len, launch.groups)))
    folder = inside(launch.worker.sweep, _FOLDER)
    folder.mkdir(exist_ok=True)
    jobs = _submit(folder, settings, launch, chunks)
    of_task = [[job for group in chunk for job in group] for chunk in chunks]
    tasks: dict[Task, Group] = dict(zip(map(SlurmTask, jobs), of_task, strict=True))
    try:
        collect(launch, tasks, _POLL_SECONDS)
    except BaseException:
        _cancel(jobs[0].job_id.partition("_")[0])
        raise
    if all(job.paths.result_pickle.exists() for job in jobs):
        with contextlib.suppress(OSError):
            remove_path(folder)  # of a lost task the logs are kept


def _chunks(groups: Sequence[Group], most: int) -> list[list[Group]]:
    """The populations of each task, of at most so many jobs."""
    chunks: list[list[Group]] = []
    for group in groups:
        if chunks and sum(map(len, chunks[-1])) + len(group) <= most:
            chunks[-1].append(group)
        else:
            chunks.append([group])
    return chunks


def _submit(
    folder: Path, settings: Mapping[str, Any], launch: Launch, chunks: list[list[Group]]
) -> list[submitit.Job[list[str]]]:
    executor = submitit.AutoExecutor(folder=folder, cluster="slurm")
    parameters = {
        f"slurm_{key}" if key in _SLURMS_NAMES else key: value
        for key, value in settings.items()
        if key not in ("jobs_per_task", "more") and value is not None
    }
    executor.update_parameters(name="gridworld", slurm_additional_parameters=settings["more"], **parameters)
    try:
        return executor.map_array(launch.worker.on_node, chunks)
    except (submitit.core.utils.FailedJobError, subprocess.SubprocessError, OSError) as error:
        last = (str(error).strip().splitlines() or [type(error).__name__])[-1]
        raise InputError(f"hydra/launcher=slurm: Slurm took no jobs ({last})") from None


def _refuse_too_many(tasks: int, jobs: int) -> None:
    answer = subprocess.run(["scontrol", "show", "config"], capture_output=True, text=True, check=False)
    known = re.search(r"MaxArraySize\s*=\s*(\d+)", answer.stdout)
    if known and tasks >= (most := int(known.group(1))):
        fitting = math.ceil(jobs / max(1, most - 1))
        raise InputError(
            f"hydra/launcher=slurm: {tasks:,} tasks, but this cluster takes {most - 1:,} in an array; "
            f"let each run several jobs: hydra.launcher.jobs_per_task={fitting}"
        )


def _cancel(array: str) -> None:
    answer = subprocess.run(["scancel", array], capture_output=True, text=True, check=False)
    how = f"failed ({answer.stderr.strip()})" if answer.returncode else "done"
    print(printable(f"slurm: scancel {array} {how}"), file=sys.stderr, flush=True)
