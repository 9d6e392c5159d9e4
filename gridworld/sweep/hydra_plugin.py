"""The plugins for Hydra: a sweeper and launchers.

Installed, this file is `hydra_plugins/gridworld_sweeper.py`: Hydra takes plugins from that namespace only. It
imports them in every program, so this module is light; the modules beside it do the work.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from typing import Any

from hydra.core.utils import JobReturn
from hydra.plugins.launcher import Launcher
from hydra.plugins.sweeper import Sweeper
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig


class GridWorldSweeper(Sweeper):
    """Launches the jobs that are not done yet; see `gridworld.sweep.sweeper`."""

    def __init__(self, **settings: Any) -> None:
        self._settings = settings  # of `gridworld.config.sweep.SweepConfig`

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        """Called by Hydra once all is composed. Raises `InputError` for a launcher that cannot work."""
        from gridworld.sweep.config_loader import SweepLoader
        from gridworld.sweep.launchers.select import make_launcher
        from gridworld.sweep.population import PopulationTask

        self._config = config
        self._loader = SweepLoader(hydra_context.config_loader)
        context = HydraContext(config_loader=self._loader, callbacks=hydra_context.callbacks)
        self._launcher = make_launcher(context, PopulationTask(context, task_function, config), config)

    def sweep(self, arguments: list[str]) -> None:
        """Run the jobs that `arguments` ask for. Raises `SystemExit` unless all are done."""
        from gridworld.config.sweep import SweepConfig
        from gridworld.sweep.sweeper import run_sweep

        settings = SweepConfig(**self._settings)
        run_sweep(arguments, self._loader, self._launcher, self._config, settings)


class _OwnLauncher:
    """The launchers' common part: `launch` of a module in gridworld/sweep/launchers runs the jobs."""

    _module: str

    def __init__(self, **settings: Any) -> None:
        self._settings = settings

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        """Called by Hydra once everything is composed."""
        self._given = hydra_context, task_function, config

    def launch(self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int) -> Sequence[JobReturn]:
        """Called by the sweeper. See `gridworld.sweep.launchers.on_joblib.launch`."""
        from gridworld.sweep.launchers.worker import JobRunner

        run = import_module(f"gridworld.sweep.launchers.{self._module}").launch
        results: list[JobReturn] = run(
            JobRunner(*self._given), self._settings, job_overrides, initial_job_idx
        )
        return results


class BasicLauncher(_OwnLauncher, Launcher):
    """Runs jobs one after the other, in place of Hydra's launcher of this name."""

    _module = "in_process"


class ForksLauncher(_OwnLauncher, Launcher):
    """Runs jobs side by side in forks of this process."""

    _module = "on_forks"


class JoblibLauncher(_OwnLauncher, Launcher):
    """Runs jobs side by side on this machine."""

    _module = "on_joblib"


class SlurmLauncher(_OwnLauncher, Launcher):
    """Runs jobs on a Slurm cluster."""

    _module = "on_slurm"


class RayLauncher(_OwnLauncher, Launcher):
    """Runs jobs on a Ray cluster."""

    _module = "on_ray"
