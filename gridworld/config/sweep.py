"""Settings of many runs: of a sweep, of where its jobs run, and of a search (the command `tune`)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from gridworld.base.bounds import Bounds
from gridworld.config.fields import MISSING, setting

_MOST_RUNS = 10_000  # of one kind: seeds, finalists
_MOST_LOOKS = 100_000  # at a seed's training


@dataclass
class SweepConfig:
    """How `-m` runs its jobs; `hydra.sweeper` on the command line."""

    _target_: str = "hydra_plugins.gridworld_sweeper.GridWorldSweeper"
    retry_failed: bool = False  # run again what failed
    extend: bool = False  # use the folder of a sweep that shares no job with this one
    max_jobs: int = 10_000  # more are refused as a mistake
    params: dict[str, Any] = setting(dict)  # settings and their values, as on a command line
    paired: list[Any] = setting(list)  # swept settings that vary together, or lists of such
    population: int | str | None = "auto"  # runs that train as one; 1: each alone


@dataclass
class ForksConfig:
    """`hydra/launcher=forks`, the default: populations in forks of the sweep's process, on Linux."""

    _target_: str = "gridworld.sweeps.launchers.forks"  # a name, as of the other launchers: not imported
    n_jobs: int = -1


@dataclass
class JoblibConfig(ForksConfig):
    """`hydra/launcher=joblib`: populations in new processes on this machine, on any system."""

    _target_: str = "gridworld.sweeps.launchers.joblib"


@dataclass
class SlurmConfig:
    """`hydra/launcher=slurm`; conf/hydra/launcher/slurm.yaml says what each setting is."""

    _target_: str = "gridworld.sweeps.launchers.slurm"
    jobs_per_task: int = setting(1, Bounds(1))
    array_parallelism: int = setting(256, Bounds(1))
    timeout_min: int = setting(60, Bounds(1))
    signal_delay_s: int = setting(60, Bounds(1))
    cpus_per_task: int = setting(1, Bounds(1))  # cores
    mem_gb: float | None = None
    partition: str | None = None  # of Slurm's, and so below; null: the default
    account: str | None = None  # that pays
    qos: str | None = None  # quality of service
    constraint: str | None = None  # features that a node must have
    setup: list[str] = setting(list)
    more: dict[str, Any] = setting(dict)


@dataclass
class RayConfig:
    """`hydra/launcher=ray`."""

    _target_: str = "gridworld.sweeps.launchers.ray"
    init: dict[str, Any] = setting(dict)
    remote: dict[str, Any] = setting(dict)


LAUNCHER_SCHEMAS = {"forks": ForksConfig, "joblib": JoblibConfig, "slurm": SlurmConfig, "ray": RayConfig}


@dataclass
class DimensionConfig:
    """What a search may choose for one key: a range, or a list."""

    type: str = MISSING  # float, int, categorical
    low: float | None = None  # of a range, included
    high: float | None = None  # the same
    log: bool = False  # uniform on a logarithmic scale
    step: float | None = None  # between the values of a range
    choices: list[Any] | None = None  # of a categorical one


@dataclass
class TuneConfig:
    """How `scripts/tune.py` searches; conf/tune.yaml says what each setting is."""

    trials: int = setting(100, Bounds(1))  # the search ends after so many
    seeds: int = setting(3, Bounds(1, _MOST_RUNS))
    finalists: int = setting(5, Bounds(1, _MOST_RUNS))
    final_seeds: int = setting(10, Bounds(0, _MOST_RUNS))
    confirm_seeds: int = setting(20, Bounds(2, _MOST_RUNS))
    study: str | None = None
    folder: str | None = None
    storage: str | None = None
    workers: int = setting(-1, Bounds(-1))
    together: int | None = setting(None, Bounds(1))
    timeout: float | None = setting(None, Bounds(0, above=True))
    sampler: str = "tpe"  # or random
    sampler_seed: int = setting(0, Bounds(0))  # of the search itself
    pruner: str = "median"  # or hyperband, none
    evaluations: int = setting(50, Bounds(1, _MOST_LOOKS))
    reports: int = setting(10, Bounds(1, _MOST_LOOKS))
    stop_after: int | None = setting(3, Bounds(1))
    space: dict[str, DimensionConfig] = setting(dict)  # conf/tune/*.yaml


@dataclass
class SearchConfig:
    """The root of conf/tune.yaml."""

    tune: TuneConfig = setting(TuneConfig)
