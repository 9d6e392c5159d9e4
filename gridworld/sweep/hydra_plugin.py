"""What Hydra sees of the sweeps: a sweeper and a launcher.

Installed, this file is `hydra_plugins/gridworld_sweeper.py`: Hydra takes plugins from that namespace only. It
imports them in every program, so this one is light, and only hands on to the modules beside it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from hydra.core.utils import JobReturn
from hydra.plugins.launcher import Launcher
from hydra.plugins.sweeper import Sweeper
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig


class GridWorldSweeper(Sweeper):
    """Hands the jobs that are not done yet to the launcher; the work is in gridworld/sweep."""

    def __init__(self, **settings: Any) -> None:
        self._settings = settings  # of `gridworld.config.SweepConfig`

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        """Called by Hydra once everything is composed. Raises `InputError` for a launcher that is missing."""
        from gridworld.sweep.compose import SweepLoader
        from gridworld.sweep.launchers import make_launcher

        self._config = config
        self._loader = SweepLoader(hydra_context.config_loader)
        self._launcher = make_launcher(
            HydraContext(config_loader=self._loader, callbacks=hydra_context.callbacks), task_function, config
        )

    def sweep(self, arguments: list[str]) -> None:
        """Run the jobs that `arguments` ask for. Ends the program if they did not all end well."""
        from gridworld.config import SweepConfig
        from gridworld.sweep.sweeper import run_sweep

        settings = SweepConfig(**self._settings)
        run_sweep(arguments, self._loader, self._launcher, self._config, settings)


class JoblibLauncher(Launcher):
    """Runs jobs side by side on this machine; the work is in gridworld/sweep/parallel.py."""

    def __init__(self, n_jobs: int) -> None:
        self._n_jobs = n_jobs

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        """Called by Hydra once everything is composed."""
        self._context, self._task, self._config = hydra_context, task_function, config

    def launch(self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int) -> Sequence[JobReturn]:
        """Called by the sweeper."""
        from gridworld.sweep.parallel import launch

        return launch(self._context, self._task, self._config, self._n_jobs, job_overrides, initial_job_idx)
