"""Populations on a Slurm cluster, as tasks of one job array, submitted by submitit.

A task can run several populations in turn, since a job of a second is not worth a place in the queue. Its
results are read from its files, and whether it has ended from `squeue`; submitit would ask `sacct`, which
only works where accounting is set up.
"""

from __future__ import annotations

import contextlib
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import submitit

from gridworld.base.atomic_write import inside, remove_path
from gridworld.base.console import printable
from gridworld.base.errors import InputError
from gridworld.base.processes import LostError
from gridworld.sweeps.launchers import Group, Launch, collect

_FOLDER = ".slurm"  # in the sweep's: what submitit writes
_SECONDS_BETWEEN_QUESTIONS = 5.0  # to Slurm, which answers others too
_FILES_ARRIVE_WITHIN = 15.0  # seconds, over a network

SlurmTask = submitit.Job[list[str]]


def run(launch: Launch, settings: Mapping[str, Any]) -> None:
    """Run populations; see `run_groups`."""
    chunks = _chunks(launch.groups, settings["jobs_per_task"])
    folder = inside(launch.worker.sweep, _FOLDER)
    folder.mkdir(exist_ok=True)
    tasks = _submit(folder, settings, launch, chunks)
    of_task = [[job for group in chunk for job in group] for chunk in chunks]
    try:
        collect(launch, dict(zip(tasks, of_task, strict=True)), _IsDone(), _result)
    except BaseException:
        _cancel(tasks[0].job_id.partition("_")[0])
        raise
    if all(task.paths.result_pickle.exists() for task in tasks):
        with contextlib.suppress(OSError):
            remove_path(folder)  # of a lost task the logs are kept


class _IsDone:
    """Whether a task has ended: by its files, or as it is not in the queue any more."""

    def __init__(self) -> None:
        self._queue: tuple[str, ...] = ()  # the user's tasks
        self._due = 0.0  # when Slurm is asked again
        self._left: dict[str, float] = {}  # when a task was first not in the queue

    def __call__(self, task: SlurmTask) -> bool:
        if task.paths.result_pickle.exists():
            return True
        now = time.monotonic()
        if now >= self._due:
            command = ["squeue", "--me", "--noheader", "--array", "--format=%i"]
            answer = subprocess.run(command, capture_output=True, text=True, check=False)
            if answer.returncode != 0:
                return False
            self._queue, self._due = tuple(answer.stdout.split()), now + _SECONDS_BETWEEN_QUESTIONS
        if task.job_id in self._queue:
            return False
        return now > self._left.setdefault(task.job_id, now) + _FILES_ARRIVE_WITHIN


def _result(task: SlurmTask) -> list[str]:
    if not task.paths.result_pickle.exists():
        lines = [line for line in (task.stderr() or "").splitlines() if line.strip()]
        why = lines[-1].strip() if lines else f"nothing was written to {task.paths.stderr}"
    elif (error := task.exception()) is not None:
        why = str(error).strip().splitlines()[-3]
    else:
        return task.result()
    print(printable(f"slurm: task {task.job_id} was lost: {why}"), file=sys.stderr, flush=True)
    raise LostError(why)


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
) -> list[SlurmTask]:
    executor = submitit.AutoExecutor(folder=folder, cluster="slurm")
    parameters = {
        f"slurm_{key}": value
        for key, value in settings.items()
        if key not in ("jobs_per_task", "more") and value is not None
    }
    executor.update_parameters(name="gridworld", slurm_additional_parameters=settings["more"], **parameters)
    try:
        return executor.map_array(launch.worker.on_node, chunks)
    except (submitit.core.utils.FailedJobError, subprocess.SubprocessError, OSError) as error:
        last = (str(error).strip().splitlines() or [type(error).__name__])[-1]
        raise InputError(
            f"hydra/launcher=slurm: Slurm took no array of {len(chunks):,} tasks ({last}); for fewer tasks, "
            "raise hydra.launcher.jobs_per_task"
        ) from None


def _cancel(array: str) -> None:
    answer = subprocess.run(["scancel", array], capture_output=True, text=True, check=False)
    how = f"failed ({answer.stderr.strip()})" if answer.returncode else "done"
    print(printable(f"slurm: scancel {array} {how}"), file=sys.stderr, flush=True)
