"""Selection of the launcher: what must be installed for it, and the checks of its settings."""

from __future__ import annotations

import importlib.util
import shutil

from hydra.core.plugins import Plugins
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, open_dict, read_write

from gridworld.bounds import Bounds
from gridworld.errors import InputError, install_command

_HYDRAS = "hydra._internal.core_plugins.basic_launcher.BasicLauncher"
_OURS = "hydra_plugins.gridworld_sweeper."
# By the launcher's class: the package that it needs, and the extra that installs it.
_NEEDS = {
    f"{_OURS}JoblibLauncher": ("joblib", "sweep"),
    f"{_OURS}SlurmLauncher": ("submitit", "slurm"),
    f"{_OURS}RayLauncher": ("ray", "ray"),
}
_COMMANDS = {f"{_OURS}SlurmLauncher": ("sbatch", "srun", "squeue", "scancel")}
_AT_LEAST_ONE = ("jobs_per_task", "array_parallelism", "timeout_min", "cpus_per_task", "signal_delay_s")


def make_launcher(context: HydraContext, task: TaskFunction, config: DictConfig) -> Launcher:
    """The launcher of `hydra.launcher`.

    Args:
        context: for the launcher.
        task: the function that runs a job.
        config: the configuration of the sweep itself.
    """
    settings = config.hydra.launcher
    choice = f"hydra/launcher={config.hydra.runtime.choices['hydra/launcher']}"
    if settings.get("n_jobs") == 0:
        raise InputError("hydra.launcher.n_jobs=0: must be the number of workers, or -1 for one on each core")
    if needed := _NEEDS.get(settings._target_):
        package, extra = needed
        if not _is_installed(package):
            raise InputError(f"{choice}: {package} is not installed; {install_command(extra)}")
        for key in _AT_LEAST_ONE:
            if settings.get(key) is not None:
                Bounds(1).check(f"hydra.launcher.{key}", settings[key])
        missing = [name for name in _COMMANDS.get(settings._target_, ()) if shutil.which(name) is None]
        if missing:
            raise InputError(
                f"{choice}: there is no {missing[0]} on this machine; start the sweep on one of the cluster's"
            )
    if settings._target_ == _HYDRAS:
        with read_write(config), open_dict(config):
            config.hydra.launcher._target_ = f"{_OURS}BasicLauncher"
    return Plugins.instance().instantiate_launcher(context, task, config)


def _is_installed(package: str) -> bool:
    try:
        return importlib.util.find_spec(package) is not None
    except (ModuleNotFoundError, ValueError):  # the latter where sys.modules has None
        return False
