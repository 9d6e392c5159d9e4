"""Which jobs of a sweep train together as populations, and which may run in forks.

On CUDA they do only if a number of runs is asked for, since their numbers then depend on each other.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any

from omegaconf import DictConfig

from gridworld.config.sweep import SweepConfig
from gridworld.errors import InputError
from gridworld.process.processes import file_limit, free_memory, worker_count
from gridworld.sweep.plan import Job

AUTO = "auto"
LARGEST = 32  # runs of a population unless more are asked for; larger ones train no faster
RUNS_FILES = 5  # that a run has open: its lock, its curve, its events, its log
_SHARE_OF_MEMORY = 4  # a population takes a fourth of what is free, shared by the workers
_RUNS_BYTES = 16 * 2**20  # of a run beside its agent, with its pictures
_OTHER_FILES = 64  # of the process
_FEWEST = 4  # runs of a population for which another core is taken


def populations(
    jobs: Sequence[Job], settings: SweepConfig, launcher: str, own: Mapping[str, Any], hydra: DictConfig
) -> list[list[Job]]:
    """Divide jobs into populations.

    Args:
        jobs: as they were planned.
        settings: of the sweep.
        launcher: where they run.
        own: the launcher's settings.
        hydra: Hydra's own part of the sweep's configuration.

    Returns:
        The populations, in the order of their first jobs; of one job each where they cannot train together.
    """
    workers = worker_count(own["n_jobs"]) if launcher in ("forks", "joblib") else 1
    memory = free_memory() / _SHARE_OF_MEMORY / workers
    shapes: dict[str, list[Job]] = {}
    for job in jobs:
        shapes.setdefault(job.hash if job.shape is None else f"shape {job.shape}", []).append(job)
    most = _most(settings)
    if runs_in_turn(settings, hydra):
        most = 1
    found = []
    for members in shapes.values():
        in_this_process = launcher == "forks" and not any(job.in_fork for job in members)
        share = len(members) if most and in_this_process else math.ceil(len(members) / workers)
        bounds = [most or LARGEST, (file_limit() - _OTHER_FILES) // RUNS_FILES]
        bounds.append(max(share, _FEWEST) if launcher == "forks" else share)
        if most is None:
            bounds.append(int(memory / (_RUNS_BYTES + max(job.memory for job in members))))
        bounds.append(own.get("jobs_per_task", len(members)))
        count = math.ceil(len(members) / max(1, min(bounds)))
        if count > workers:
            count = min(len(members), math.ceil(count / workers) * workers)  # so that all end at once
        ends = [len(members) * part // count for part in range(count + 1)]
        found += [members[start:end] for start, end in itertools.pairwise(ends)]
    return found


def runs_in_turn(settings: SweepConfig, hydra: DictConfig) -> bool:
    """Whether jobs cannot train together: the first failure counts, or each has a current folder."""
    return bool(settings.stop_at_first_failure or hydra.job.chdir)


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
