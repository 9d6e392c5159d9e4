"""Where the populations of a sweep run: on this machine, or by one of the modules next to this one."""

from __future__ import annotations

import dataclasses
import importlib.util
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from typing import Any, TypeVar

from omegaconf import DictConfig, OmegaConf

from gridworld.base.console import repeating
from gridworld.base.errors import InputError, install_command
from gridworld.base.processes import LostError, Processes, can_fork, worker_count
from gridworld.config.compose import refuse_unused
from gridworld.config.sweep import LAUNCHER_SCHEMAS
from gridworld.config.train import check_bounds
from gridworld.sweeps.job import Worker
from gridworld.sweeps.plan import Job, runs_apart
from gridworld.training.setup import import_for

# By the launcher: the package that it needs, and commands.
_NEEDS = {"slurm": ("submitit", ("sbatch", "srun", "squeue", "scancel")), "ray": ("ray", ())}
_SECONDS_BETWEEN_TICKS = 1.0

Group = Sequence[Job]
Task = TypeVar("Task")  # populations that run on a cluster


@dataclass(frozen=True)
class Launch:
    """Populations to run, and what is called meanwhile."""

    worker: Worker  # runs a population
    groups: Sequence[Group]
    ended: Callable[[Group, list[str] | LostError], None]  # with the errors of its first jobs
    tick: Callable[[], None]  # called every now and then


def launcher_settings(config: DictConfig) -> tuple[str, dict[str, Any]]:
    """The launcher that is chosen, and its settings. Raises `InputError` where it cannot work."""
    refuse_unused(config.hydra)
    own: Any = OmegaConf.to_container(config.hydra.launcher, resolve=True)
    kind = own["_target_"].rpartition(".")[2]
    if kind in LAUNCHER_SCHEMAS:  # which a yaml of one's own need not name
        settings: Any = OmegaConf.to_object(OmegaConf.merge(LAUNCHER_SCHEMAS[kind], own))
        check_bounds(settings, "hydra.launcher.")
        own = dataclasses.asdict(settings)
    del own["_target_"]
    choice = f"hydra/launcher={config.hydra.runtime.choices['hydra/launcher']}"
    if own.get("n_jobs") == 0:
        raise InputError("hydra.launcher.n_jobs=0: must be the number of workers, or -1 for one on each core")
    if kind in _NEEDS:
        package, commands = _NEEDS[kind]
        if importlib.util.find_spec(package) is None:
            raise InputError(f"{choice}: {package} is not installed; {install_command(kind)}")
        missing = [name for name in commands if shutil.which(name) is None]
        if missing:
            raise InputError(
                f"{choice}: no {missing[0]} on this machine; start the sweep on a machine of the cluster"
            )
    return "basic" if kind == "forks" and not can_fork() else kind, own


def run_groups(launch: Launch, launcher: str, own: Mapping[str, Any]) -> None:
    """Run populations. Raises `SystemExit`, or `InputError` where a cluster takes no jobs."""
    if launcher in _NEEDS:
        import_module(f"gridworld.sweeps.launchers.{launcher}").run(launch, own)
        return
    apart: list[partial[list[str]]] = []  # in other processes
    here: list[partial[list[str]]] = []  # in this one, when the others have ended
    for group in launch.groups:
        (apart if runs_apart(launcher, group[0].config) else here).append(partial(launch.worker, group))
    if apart:
        if launcher == "forks":
            import_for(apart[0].args[0][0].config)  # once for all: forks share it
        processes = Processes(worker_count(own["n_jobs"]), launcher == "forks")
        processes.run(apart, lambda task, errors: launch.ended(task.args[0], errors), launch.tick)
    with repeating(_SECONDS_BETWEEN_TICKS, launch.tick):
        for task in here:
            launch.ended(task.args[0], task())


def collect(
    launch: Launch,
    tasks: Mapping[Task, Group],
    is_done: Callable[[Task], bool],
    result: Callable[[Task], list[str]],
) -> None:
    """Wait until tasks on a cluster have ended."""
    left = dict(tasks)
    while left:
        launch.tick()
        time.sleep(_SECONDS_BETWEEN_TICKS)
        for task in [task for task in left if is_done(task)]:
            jobs = left.pop(task)
            try:
                launch.ended(jobs, result(task))
            except LostError as error:
                launch.ended(jobs, error)
