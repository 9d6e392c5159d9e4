"""Jobs side by side in forks of this process, which share its imports: the default.

Jobs with code of the user's, or on a GPU, run in this process when the others have ended. So do all jobs
where there is one core or one population, no `fork`, or a debugger.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from hydra.core.utils import JobReturn, JobStatus

from gridworld.config.composition.compose import without_hydra
from gridworld.process.parallel.forks import can_fork, run_in_forks
from gridworld.process.parallel.machine import worker_count
from gridworld.sweep.launchers import in_process
from gridworld.sweep.launchers.worker import JobRunner
from gridworld.sweep.population import goes_in_fork
from gridworld.training.setup import import_for


def launch(
    runner: JobRunner, settings: Mapping[str, Any], jobs: Sequence[Sequence[str]], first: int
) -> list[JobReturn]:
    """Run jobs. See `on_joblib.launch`."""
    forked = [number for number, overrides in enumerate(jobs) if goes_in_fork(overrides)]
    count = min(worker_count(settings["n_jobs"]), len(forked))
    if count < 2 or not can_fork():
        return in_process.launch(runner, settings, jobs, first)
    _import_for(runner, jobs[forked[0]])
    tasks = [partial(_run, runner, jobs[number], first + number) for number in forked]
    found: dict[int, JobReturn] = dict(zip(forked, run_in_forks(tasks, count), strict=True))
    return [
        found[number] or JobReturn(_return_value="", status=JobStatus.UNKNOWN)
        if number in found
        else runner.run(overrides, first + number)
        for number, overrides in enumerate(jobs)
    ]


def _import_for(runner: JobRunner, overrides: Sequence[str]) -> None:
    """Import what a job takes, once for all forks."""
    whole = runner.context.config_loader.load_sweep_config(runner.config, list(overrides))
    import_for(without_hydra(whole))


def _run(runner: JobRunner, overrides: Sequence[str], number: int) -> JobReturn:
    done = runner.run(overrides, number)
    value = done._return_value
    told = value if isinstance(value, OSError) else str(value)  # the sweeper looks at no other
    return JobReturn(_return_value=told, status=done.status)
