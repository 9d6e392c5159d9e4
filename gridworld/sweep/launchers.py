"""Which launcher runs the jobs, and what to install for it."""

from __future__ import annotations

import importlib.util

from hydra.core.plugins import Plugins
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig

from gridworld.errors import InputError

# By the class: the package that it needs, and the extra that brings it.
_NEEDS = {
    "hydra_plugins.gridworld_sweeper.JoblibLauncher": ("joblib", "sweep"),
    "hydra_plugins.hydra_submitit_launcher.": ("hydra_plugins.hydra_submitit_launcher", "slurm"),
    "hydra_plugins.hydra_ray_launcher.": ("hydra_plugins.hydra_ray_launcher", "ray"),
}


def make_launcher(context: HydraContext, task: TaskFunction, config: DictConfig) -> Launcher:
    """The launcher that is configured. Raises `InputError` if it is not installed."""
    for target, (package, extra) in _NEEDS.items():
        if str(config.hydra.launcher._target_).startswith(target) and not _is_installed(package):
            choice = config.hydra.runtime.choices["hydra/launcher"]
            raise InputError(
                f"hydra/launcher={choice}: {package.split('.')[-1]} is not installed; "
                f"pip install 'gridworld[{extra}]'"
            )
    n_jobs = config.hydra.launcher.get("n_jobs")
    if n_jobs == 0:
        raise InputError("hydra.launcher.n_jobs=0: must be the number of workers, or -1 for one on each core")
    return Plugins.instance().instantiate_launcher(context, task, config)


def _is_installed(package: str) -> bool:
    try:
        return importlib.util.find_spec(package) is not None
    except ModuleNotFoundError:
        return False
