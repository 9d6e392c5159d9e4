"""Settings of many runs: of a sweep, of where its jobs run, and of a search (the command `tune`)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Optional, Union

from gridworld.config.fields import MISSING, bounds

# OmegaConf reads these annotations at run time and knows no `X | None`.

_MOST_RUNS = 10_000  # of one kind: seeds, finalists
_MOST_LOOKS = 100_000  # at a seed's training


@dataclass
class SweepConfig:
    """How `-m` runs its jobs; `hydra.sweeper` on the command line."""

    _target_: str = "hydra_plugins.gridworld_sweeper.GridWorldSweeper"
    retry_failed: bool = False  # run again what failed
    stop_at_first_failure: bool = False  # leave the rest for later
    extend: bool = False  # use the folder of a sweep that shares no job with this one
    max_jobs: int = 10_000  # more are taken for a slip
    params: dict[str, Any] = field(default_factory=dict)  # settings and their values, as on a command line
    paired: list[Any] = field(default_factory=list)  # swept settings that vary together, or lists of such
    population: Optional[Union[int, str]] = "auto"  # noqa: UP007, UP045  # runs that train as one; 1: each alone


@dataclass
class ForksConfig:
    """`hydra/launcher=forks`, the default: populations in forks of the sweep's process, on Linux."""

    _target_: str = "gridworld.sweep.launchers.forks"
    n_jobs: int = -1


@dataclass
class JoblibConfig:
    """`hydra/launcher=joblib`: populations in new processes on this machine, on any system."""

    _target_: str = "gridworld.sweep.launchers.joblib"
    n_jobs: int = -1


@dataclass
class SlurmConfig:
    """`hydra/launcher=slurm`; all but the first two are submitit's, by its names."""

    _target_: str = "gridworld.sweep.launchers.slurm"
    jobs_per_task: int = field(default=1, metadata=bounds(1))
    array_parallelism: int = field(default=256, metadata=bounds(1))
    timeout_min: int = field(default=60, metadata=bounds(1))
    signal_delay_s: int = field(default=60, metadata=bounds(1))
    cpus_per_task: int = field(default=1, metadata=bounds(1))  # cores
    mem_gb: Optional[float] = None  # noqa: UP045
    partition: Optional[str] = None  # noqa: UP045  # of Slurm's, and so below; null: the default
    account: Optional[str] = None  # noqa: UP045  # that pays
    qos: Optional[str] = None  # noqa: UP045  # quality of service
    constraint: Optional[str] = None  # noqa: UP045  # features that a node must have
    setup: list[str] = field(default_factory=list)
    more: dict[str, Any] = field(default_factory=dict)


@dataclass
class RayConfig:
    """`hydra/launcher=ray`."""

    _target_: str = "gridworld.sweep.launchers.ray"
    init: dict[str, Any] = field(default_factory=dict)
    remote: dict[str, Any] = field(default_factory=dict)


LAUNCHER_SCHEMAS: dict[str, type] = {
    "forks": ForksConfig,
    "joblib": JoblibConfig,
    "slurm": SlurmConfig,
    "ray": RayConfig,
}


@dataclass
class DimensionConfig:
    """What a search may choose for one key: a range, or a list."""

    type: str = MISSING  # float, int, categorical
    low: Optional[float] = None  # noqa: UP045  # of a range, included
    high: Optional[float] = None  # noqa: UP045  # the same
    log: bool = False  # even on a logarithmic scale
    step: Optional[float] = None  # noqa: UP045  # between the values of a range
    choices: Optional[list[Any]] = None  # noqa: UP045  # of a categorical one


@dataclass
class TuneConfig:
    """How `scripts/tune.py` searches; `tune` on the command line."""

    trials: int = field(default=100, metadata=bounds(1))  # the search ends after so many
    seeds: int = field(default=3, metadata=bounds(1, _MOST_RUNS))  # a trial's: seed, seed + 1, ...
    # trials that go on to more seeds, beside what the search began from
    finalists: int = field(default=5, metadata=bounds(1, _MOST_RUNS))
    final_seeds: int = field(default=10, metadata=bounds(0, _MOST_RUNS))  # the next ones, for the finalists
    # the next ones, for the winner and for what the search began from
    confirm_seeds: int = field(default=20, metadata=bounds(2, _MOST_RUNS))
    study: Optional[str] = None  # noqa: UP045  # its name; null: of agent and world
    folder: Optional[str] = None  # noqa: UP045  # null: runs/STUDY
    storage: Optional[str] = None  # noqa: UP045  # any URL that Optuna takes; null: study.db in the folder
    workers: int = field(default=-1, metadata=bounds(-1))  # processes; -1 for one on each core
    # trials of a worker at once; null: 8 of all, 1 of one
    together: Optional[int] = field(default=None, metadata=bounds(1))  # noqa: UP045
    # seconds; no trial begins after that
    timeout: Optional[float] = field(default=None, metadata=bounds(0, above=True))  # noqa: UP045
    sampler: str = "tpe"  # or random
    sampler_seed: int = field(default=0, metadata=bounds(0))  # of the search itself
    pruner: str = "median"  # or hyperband, none
    # of a seed, at least, so that who is certified sooner shows
    evaluations: int = field(default=50, metadata=bounds(1, _MOST_LOOKS))
    reports: int = field(default=10, metadata=bounds(1, _MOST_LOOKS))  # looks of the pruner at a seed's curve
    # a trial's seed ends at this many certificates in a row
    stop_after: Optional[int] = field(default=3, metadata=bounds(1))  # noqa: UP045
    space: dict[str, DimensionConfig] = field(default_factory=dict)  # conf/tune/*.yaml


@dataclass
class SearchConfig:
    """The root of conf/tune.yaml."""

    tune: TuneConfig = field(default_factory=TuneConfig)
