"""Jobs of a sweep that train as one population, in any launcher.

A launcher gets one job for each population: the first of its jobs, with the names of all in
`hydra.sweeper.together`. Where that runs, `PopulationTask` runs them all, each as it would run alone, with
files and a folder of its own (`training.together`). On CUDA they form a population only if a number of runs
is asked for: there their numbers depend on each other.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Container, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, cast

from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.types import Quote, QuotedString
from hydra.core.utils import JobReturn
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig

from gridworld.agents import family
from gridworld.config.composition.compose import to_config
from gridworld.config.sweep import SweepConfig
from gridworld.errors import InputError
from gridworld.process.parallel.forks import can_fork
from gridworld.process.parallel.machine import file_limit, free_memory, worker_count
from gridworld.process.parallel.together import LARGEST, mixing
from gridworld.sweep.folder import JobEntry, SweepFolder
from gridworld.sweep.plan import Job
from gridworld.training.together import run_together

AUTO = "auto"
_SHARE_OF_MEMORY = 4  # a population takes a fourth of what is free, shared by the workers
_RUNS_BYTES = 16 * 2**20  # of a run beside its agent, with its pictures
RUNS_FILES = 3  # that a run has open: its lock, its curve, its events
_OTHER_FILES = 64  # of the process
_FEWEST = 4  # runs of a population for which another core is taken
_KEY = "hydra.sweeper.together"
_IN_FORK = "hydra.sweeper.in_fork=true"


@dataclass(frozen=True)
class PopulationTask:
    """The function that launchers run: one job, or those of a population.

    Args:
        context: Hydra's, whose loader composes the jobs.
        task: runs a job.
        config: of the sweep itself.
    """

    context: HydraContext
    task: TaskFunction
    config: DictConfig

    def __call__(self, settings: DictConfig) -> Any:
        """Run the job, or all jobs of the population that it stands for.

        Raises:
            Exception: a job failed; of a population, the first one's, or an `OSError` of any. Its row in the
                table says why, where it could be written.
            SystemExit: it was interrupted.
        """
        shared = cast("Any", HydraConfig.instance())
        own = HydraConfig.get()
        together = [str(each).split(":", 1) for each in own.sweeper.get("together") or ()]
        if not together:
            return self.task(settings)
        before, folder = shared.cfg, Path(own.sweep.dir)
        try:
            entries = {entry.job: entry for entry in SweepFolder(folder).entries.values()}
            jobs = [(int(number), entries[name]) for number, name in together]
            with mixing(self._mixed(settings, [entry for _, entry in jobs])):
                results = self._run_all(folder, jobs)
        finally:
            shared.cfg = before
        failures = [failure for result in results if (failure := _failure(result)) is not None]
        if failures:  # one of the machine goes first: after that, jobs are tried again that noted none
            raise min(failures, key=lambda failure: not isinstance(failure, OSError))
        return None

    def _mixed(self, settings: DictConfig, entries: Sequence[JobEntry]) -> dict[str, str]:
        """The jobs whose numbers come to depend on each other, as `mixing` takes them."""
        if len(entries) == 1 or self.config.hydra.sweeper.population == AUTO:
            return {}
        config = to_config(settings)  # the first one's; all have one device
        if family(config.agent).on_processor(config.device):
            return {}
        return {entry.job: entry.hash for entry in entries}

    def _run_all(self, folder: Path, jobs: Sequence[tuple[int, JobEntry]]) -> list[JobReturn | Exception]:
        # Here, since most jobs are planned without it.
        from gridworld.sweep.launchers.worker import JobRunner

        runner = JobRunner(self.context, self.task, self.config)
        return run_together(
            [
                partial(runner.job, line(folder, entry), number, configures_logging=False)
                for number, entry in jobs
            ]
        )


def _failure(result: JobReturn | Exception) -> Exception | None:
    if isinstance(result, Exception):
        return result
    try:
        _ = result.return_value  # raises what the job did
    except Exception as error:
        return error
    return None


def line(folder: Path, entry: JobEntry) -> list[str]:
    """A launcher's overrides for a job: its own, and those that name its folder in the sweep's."""
    where = {"dir": str(folder.absolute()), "subdir": entry.job}
    return [*entry.overrides, *(f"hydra.sweep.{key}={_quoted(text)}" for key, text in where.items())]


def lines(
    folder: Path, groups: Sequence[Sequence[JobEntry]], first: int, in_fork: Container[str] = ()
) -> list[list[str]]:
    """A launcher's overrides for each population.

    Args:
        folder: the sweep's.
        groups: the populations.
        first: the number of their first job, `hydra.job.num`.
        in_fork: the jobs that may run in a fork of this process.
    """
    found = []
    for number_given, group in enumerate(groups, first):  # by the launcher, to each population
        words = line(folder, group[0])
        if len(group) > 1 or number_given != first or group[0].job in in_fork:
            names = ",".join(_quoted(f"{number}:{each.job}") for number, each in enumerate(group, first))
            words += [f"{_KEY}=[{names}]", "hydra.output_subdir=null"]
            words += [_IN_FORK] if group[0].job in in_fork else []
        found.append(words)
        first += len(group)
    return found


def goes_in_fork(overrides: Sequence[str]) -> bool:
    """Whether a launcher's job may run in a fork of this process."""
    return _IN_FORK in overrides


def count_jobs(overrides: Sequence[str]) -> int:
    """How many jobs a launcher's job stands for."""
    names = [word for word in overrides if word.startswith(f"{_KEY}=")]
    return names[-1].count("',") + 1 if names else 1


def populations(
    jobs: Sequence[tuple[JobEntry, Job]], settings: SweepConfig, hydra: DictConfig
) -> list[list[JobEntry]]:
    """Divide jobs into populations.

    Args:
        jobs: each as sweep.json has it, and as it was planned.
        settings: of the sweep.
        hydra: Hydra's own, with the launcher's.

    Returns:
        The populations, in the order of their first jobs; of one job each where they cannot train together.
    """
    if settings.together or settings.in_fork:
        raise InputError(
            f"{_KEY if settings.together else _IN_FORK}: tells a launcher's process its runs; leave it out, "
            "and set hydra.sweeper.population"
        )
    workers = _workers(hydra.launcher)
    memory = free_memory() / _SHARE_OF_MEMORY / workers
    shapes: dict[str, list[tuple[JobEntry, Job]]] = {}
    for entry, job in jobs:
        key = entry.job if job.shape is None else f"shape {job.shape}"
        shapes.setdefault(key, []).append((entry, job))
    most = _most(settings)
    if _in_turn(settings, hydra):
        most = 1
    found = []
    for members in shapes.values():
        in_this_process = _forks(hydra.launcher) and not any(job.in_fork for _, job in members)
        share = len(members) if most and in_this_process else math.ceil(len(members) / workers)
        bounds = [most or LARGEST, (file_limit() - _OTHER_FILES) // RUNS_FILES]
        bounds.append(max(share, _FEWEST) if _forks(hydra.launcher) else share)
        if most is None:
            bounds.append(int(memory / (_RUNS_BYTES + max(job.memory for _, job in members))))
        if (own := hydra.launcher.get("jobs_per_task")) is not None:  # a task of Slurm's has its own number
            bounds.append(own)
        count = math.ceil(len(members) / max(1, min(bounds)))
        if count > workers:
            count = min(len(members), math.ceil(count / workers) * workers)  # so that all end at once
        found += _even([entry for entry, _ in members], count)
    return found


def may_fork(jobs: Iterable[tuple[JobEntry, Job]], settings: SweepConfig, hydra: DictConfig) -> set[str]:
    """The jobs, of these as for `populations`, that may run in a fork, by their folders' names."""
    own_callbacks = len(hydra.callbacks) > 1  # in Hydra's configuration, beside ours: one object for all jobs
    if _in_turn(settings, hydra) or own_callbacks:
        return set()
    return {entry.job for entry, job in jobs if job.in_fork}


def _in_turn(settings: SweepConfig, hydra: DictConfig) -> bool:
    """Whether jobs cannot mix: the first failure is to count, or they change what a process has only once."""
    return bool(settings.stop_at_first_failure or hydra.job.chdir or hydra.job.env_set)


def _even(entries: Sequence[JobEntry], count: int) -> list[list[JobEntry]]:
    bounds = [len(entries) * part // count for part in range(count + 1)]
    return [list(entries[start:end]) for start, end in itertools.pairwise(bounds)]


def _most(settings: SweepConfig) -> int | None:
    """The largest population that is asked for; None: as many as train faster, and memory holds."""
    asked = settings.population
    if asked == AUTO:
        return None
    if type(asked) is int and asked >= 1:
        return asked
    raise InputError(
        f"hydra.sweeper.population={asked}: must be the number of runs that train together at most, 1 for "
        f"each by itself, or {AUTO}"
    )


def _workers(launcher: DictConfig) -> int:
    """How many processes the launcher runs jobs in on this machine; of a cluster's, one for each job."""
    if launcher._target_.endswith("BasicLauncher") or "jobs_per_task" in launcher:
        return 1
    if _forks(launcher) and not can_fork():
        return 1
    return worker_count(launcher.get("n_jobs") or -1)


def _forks(launcher: DictConfig) -> bool:
    return bool(launcher._target_.endswith("ForksLauncher"))


def _quoted(text: str) -> str:
    return str(QuotedString(text, Quote.single).with_quotes())
