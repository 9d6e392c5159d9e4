"""Jobs on a Slurm cluster, as tasks of one job array, submitted by submitit.

hydra-submitit-launcher does the same with a task per job. Here a task can run several jobs in turn, since one
of a second is not worth a place in the queue; and the tasks are cancelled when the sweep is stopped.

A task's results are read from its files, and whether it has ended from `squeue`; submitit would ask `sacct`,
which only works where accounting is set up.
"""

from __future__ import annotations

import contextlib
import math
import re
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import submitit
from hydra.core.utils import JobReturn, JobStatus
from omegaconf import OmegaConf

from gridworld.config.sweep import SlurmConfig
from gridworld.errors import InputError
from gridworld.process.console.terminal import printable
from gridworld.storage.atomic_write import make_inside, remove_inside, replacing
from gridworld.sweep.folder import STOP
from gridworld.sweep.job import StopSweep
from gridworld.sweep.launchers.worker import JobRunner, run_in_turn
from gridworld.sweep.population import count_jobs

Task = submitit.Job[list[str]]

_FOLDER = ".slurm"  # in the sweep's: what submitit writes
_POLL_SECONDS = 1.0
_POLLS_PER_QUESTION = 5  # to Slurm, which answers others too
_FILES_ARRIVE_WITHIN = 15.0  # seconds, over a network
_OWN_SETTINGS = {"_target_", "jobs_per_task"}
_SLURMS_NAMES = {"array_parallelism", "partition", "account", "qos", "constraint", "setup", "signal_delay_s"}


def launch(
    runner: JobRunner, settings: Mapping[str, Any], jobs: Sequence[Sequence[str]], first: int
) -> list[JobReturn]:
    """Run jobs. See `on_joblib.launch`."""
    own = SlurmConfig(**settings)
    parts = _parts(jobs, own.jobs_per_task)
    _refuse_too_many(len(parts), sum(map(count_jobs, jobs)))
    folder = make_inside(runner.sweep, _FOLDER)
    state_file = folder / f"{time.time_ns()}.state"
    with replacing(state_file) as part:
        part.write_bytes(runner.packed())
    chunks = [[list(overrides) for overrides in jobs[start:end]] for start, end in parts]
    tasks = _submit(folder, own, state_file, runner.sweep, chunks, [first + start for start, _ in parts])
    try:
        _wait(tasks, runner.sweep / STOP)
    except BaseException:
        _cancel(tasks)
        raise
    return _results(tasks, chunks, folder)


def run_task(state_file: str, sweep: str, jobs: list[list[str]], first: int) -> list[str]:
    """Run a task's jobs, on its node. See `run_in_turn`."""
    return run_in_turn(Path(state_file).read_bytes(), Path(sweep), jobs, first)


def _parts(jobs: Sequence[Sequence[str]], most: int) -> list[tuple[int, int]]:
    """From where to where each task's jobs go, so that none has more than `most`; one may be a population."""
    parts, start, inside = [], 0, 0
    for number, overrides in enumerate(jobs):
        count = count_jobs(overrides)
        if inside and inside + count > most:
            parts.append((start, number))
            start, inside = number, 0
        inside += count
    return [*parts, (start, len(jobs))] if jobs else []


def _submit(
    folder: Path,
    settings: SlurmConfig,
    state_file: Path,
    sweep: Path,
    chunks: list[list[list[str]]],
    numbers: list[int],
) -> list[Task]:
    executor = submitit.AutoExecutor(folder=folder, cluster="slurm")
    chosen = OmegaConf.to_container(OmegaConf.structured(settings))
    assert isinstance(chosen, dict)
    parameters = {
        f"slurm_{key}" if key in _SLURMS_NAMES else str(key): value
        for key, value in chosen.items()
        if key not in _OWN_SETTINGS and value is not None
    }
    executor.update_parameters(
        name="gridworld", slurm_additional_parameters=parameters.pop("more"), **parameters
    )
    count = len(chunks)
    try:
        return executor.map_array(run_task, [str(state_file)] * count, [str(sweep)] * count, chunks, numbers)
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


def _wait(tasks: list[Task], stop: Path) -> None:
    """Wait until no task is left in Slurm's queue. Raises `StopSweep` once there is a file `stop`."""
    array = tasks[0].job_id.partition("_")[0]
    polls = 0
    while True:
        time.sleep(_POLL_SECONDS)
        if stop.exists():
            raise StopSweep("a job failed")
        polls += 1
        if polls % _POLLS_PER_QUESTION == 0 and not _is_queued(array):
            return


def _is_queued(array: str) -> bool:
    command = ["squeue", "--me", "--noheader", "--format=%A %F"]  # numbers of the task and the array
    answer = subprocess.run(command, capture_output=True, text=True, check=False)
    return answer.returncode != 0 or array in answer.stdout.split()  # a question that fails is asked again


def _cancel(tasks: list[Task]) -> None:
    array = tasks[0].job_id.partition("_")[0]
    answer = subprocess.run(["scancel", array], capture_output=True, text=True, check=False)
    how = f"failed ({answer.stderr.strip()})" if answer.returncode else "done"
    print(f"slurm: scancel {array}: {how}", file=sys.stderr, flush=True)


def _results(tasks: list[Task], chunks: list[list[list[str]]], folder: Path) -> list[JobReturn]:
    """The jobs' results; unknown where a task was told to stop, or lost: then the job's folder decides."""
    end = time.monotonic() + _FILES_ARRIVE_WITHIN
    while time.monotonic() < end and not all(task.paths.result_pickle.exists() for task in tasks):
        time.sleep(_POLL_SECONDS)
    results = []
    lost = False
    for task, chunk in zip(tasks, chunks, strict=True):
        reason, errors = _outcome(task)
        results += [JobReturn(_return_value=e, status=_status(e)) for e in errors]
        left = len(chunk) - len(errors)
        results += [JobReturn(_return_value=reason, status=JobStatus.UNKNOWN) for _ in range(left)]
        if reason:
            lost = True
            print(printable(f"slurm: task {task.job_id} was lost: {reason}"), file=sys.stderr, flush=True)
    if not lost:
        with contextlib.suppress(OSError):
            remove_inside(folder.parent, folder.name)  # of a lost task the logs are kept
    return results


def _status(error: str) -> JobStatus:
    return JobStatus.FAILED if error else JobStatus.COMPLETED


def _outcome(task: Task) -> tuple[str, list[str]]:
    """(why it was lost, or ""; the errors of the jobs that it began, "" for none)."""
    if not task.paths.result_pickle.exists():
        return _last_line(task), []
    error = task.exception()
    if error is not None:
        return str(error).strip().splitlines()[-3], []
    return "", task.result()


def _last_line(task: Task) -> str:
    """The last line that it wrote to standard error."""
    lines = [line for line in (task.stderr() or "").splitlines() if line.strip()]
    return lines[-1].strip() if lines else f"nothing was written to {task.paths.stderr}"
