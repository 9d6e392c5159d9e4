"""Where the populations of a sweep run; `hydra/launcher` chooses one of these modules."""

from __future__ import annotations

import importlib.util
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from omegaconf import DictConfig, OmegaConf

from gridworld.errors import InputError, install_command
from gridworld.process.processes import LostError, can_fork
from gridworld.sweep.job import StopSweep, SweepJob, Worker

# By the launcher: the package that it needs, the extra that installs it, and commands.
_NEEDS: dict[str, tuple[str, str, tuple[str, ...]]] = {
    "slurm": ("submitit", "slurm", ("sbatch", "srun", "squeue", "scancel")),
    "ray": ("ray", "ray", ()),
}
_AT_LEAST_ONE = ("jobs_per_task", "array_parallelism", "timeout_min", "cpus_per_task", "signal_delay_s")

Group = Sequence[SweepJob]


@dataclass(frozen=True)
class Launch:
    """Populations to run, and what is called meanwhile.

    Args:
        worker: runs a population.
        groups: the populations.
        stop: a file that is there once no more jobs are to begin.
        ended: called with jobs that have ended, and their errors or a `LostError`; there may be fewer errors.
        tick: called every now and then.
    """

    worker: Worker
    groups: Sequence[Group]
    stop: Path
    ended: Callable[[Group, list[str] | LostError], None]
    tick: Callable[[], None]


class Task(Protocol):
    """Populations that run on a cluster, in the manner of `concurrent.futures.Future`."""

    def done(self) -> bool:
        """Whether it has ended."""

    def result(self) -> list[str]:
        """The errors of its jobs. Raises `LostError`."""


def collect(launch: Launch, tasks: Mapping[Task, Group], seconds: float) -> None:
    """Wait until tasks on a cluster have ended. Raises `StopSweep`."""
    left = dict(tasks)
    while left:
        launch.tick()
        time.sleep(seconds)
        if launch.stop.exists():
            raise StopSweep("a job failed")
        for task in [task for task in left if task.done()]:
            jobs = left.pop(task)
            try:
                launch.ended(jobs, task.result())
            except LostError as error:
                launch.ended(jobs, error)


def launcher_settings(config: DictConfig) -> tuple[str, dict[str, Any]]:
    """The launcher that is chosen, and its settings. Raises `InputError` where it cannot work."""
    settings = OmegaConf.to_container(config.hydra.launcher)
    assert isinstance(settings, dict)
    kind = str(settings.pop("_target_")).rpartition(".")[2]
    choice = f"hydra/launcher={config.hydra.runtime.choices['hydra/launcher']}"
    if settings.get("n_jobs") == 0:
        raise InputError("hydra.launcher.n_jobs=0: must be the number of workers, or -1 for one on each core")
    for key in _AT_LEAST_ONE:
        if settings.get(key, 1) < 1:
            raise InputError(f"hydra.launcher.{key}={settings[key]}: must be at least 1")
    package, extra, commands = _NEEDS.get(kind, ("", "", ()))
    if package and not _is_installed(package):
        raise InputError(f"{choice}: {package} is not installed; {install_command(extra)}")
    missing = [name for name in commands if shutil.which(name) is None]
    if missing:
        raise InputError(
            f"{choice}: there is no {missing[0]} on this machine; start the sweep on one of the cluster's"
        )
    return "basic" if kind == "forks" and not can_fork() else kind, {str(k): v for k, v in settings.items()}


def _is_installed(package: str) -> bool:
    try:
        return importlib.util.find_spec(package) is not None
    except ValueError:  # where sys.modules has None
        return False
