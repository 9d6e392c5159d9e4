"""Settings of sweeps and of where their jobs run: `hydra.sweeper` and `hydra.launcher`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Optional, Union

# OmegaConf reads these annotations at run time and knows no `X | None`.


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
    jobs_per_task: int = 1
    array_parallelism: int = 256
    timeout_min: int = 60
    signal_delay_s: int = 60
    cpus_per_task: int = 1  # cores
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
