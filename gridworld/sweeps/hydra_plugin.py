"""The plugin for Hydra: the sweeper.

Installed, this file is `hydra_plugins/gridworld_sweeper.py`: Hydra takes plugins from that namespace only. It
imports them in every program, so this module is light; `gridworld.sweeps.sweeper` does the work.
"""

from __future__ import annotations

from typing import Any

from hydra.plugins.sweeper import Sweeper
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig


class GridWorldSweeper(Sweeper):
    """Runs the jobs that are not done yet."""

    def __init__(self, **settings: Any) -> None:
        self._settings = settings  # of `gridworld.config.sweep.SweepConfig`

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        """Called by Hydra once all is composed."""
        self._context, self._config = hydra_context, config

    def sweep(self, arguments: list[str]) -> None:
        """Run the jobs that `arguments` ask for. Raises `SystemExit` unless all are done."""
        from gridworld.config.sweep import SweepConfig
        from gridworld.sweeps.sweeper import run_sweep

        run_sweep(arguments, self._context, self._config, SweepConfig(**self._settings))
