"""A job run by `run_job` of our own leaves and sees what Hydra's leaves and shows."""

import inspect
import os
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
from helpers.support import CONF
from hydra import initialize_config_dir
from hydra.core import utils
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.utils import JobStatus
from hydra.types import HydraContext, RunMode
from omegaconf import DictConfig, OmegaConf, open_dict

from gridworld.config.composition.compose import register_schemas, to_config
from gridworld.sweep import hydra_job
from gridworld.sweep.config_loader import SweepLoader
from gridworld.sweep.launchers import select
from gridworld.training.together import run_alone


class Callbacks(SimpleNamespace):
    def on_job_start(self, config: DictConfig, task_function: object) -> None:
        self.told = [config.hydra.runtime.output_dir]

    def on_job_end(self, config: DictConfig, job_return: utils.JobReturn) -> None:
        self.told.append(job_return.status)


@pytest.fixture
def loader() -> Iterator[SweepLoader]:
    register_schemas()
    utils.setup_globals()
    with initialize_config_dir(version_base="1.3", config_dir=str(CONF)):
        yield SweepLoader(GlobalHydra.instance().hydra.config_loader)  # type: ignore[union-attr]


def run_job(*arguments: object, **keys: object) -> object:
    return run_alone(hydra_job.job(*arguments, **keys))  # type: ignore[arg-type]


OVERRIDES = [
    ["agent=ppo", "seed=3", "hydra.sweep.subdir='a=1,b=2'", "agent.learning_rate=1e-5"],
    ["env.layout='a name that is far too long for one line of YAML, so that it is folded somewhere, Ü'"],
    [
        "hydra.job.chdir=true",
        "env.layout='on'",
        "+hydra.job.env_set={GRIDWORLD_TEST: 'yes'}",
        "callbacks=[{a: {}}]",
    ],
]


@pytest.mark.parametrize("overrides", OVERRIDES)
def test_files_variables_and_results_are_hydras(
    loader: SweepLoader, overrides: list[str], tmp_path: Path
) -> None:
    def task(settings: DictConfig) -> object:
        assert "hydra" not in settings
        with pytest.raises(Exception, match="read-only"):
            HydraConfig.get().job.num = 8
        files = {
            path.name: path.read_text()
            for path in Path(HydraConfig.get().runtime.output_dir, ".hydra").iterdir()
        }
        seen = os.environ.get("GRIDWORLD_TEST"), HydraConfig.get().runtime.output_dir, Path.cwd().name
        return files, seen, to_config(settings), OmegaConf.to_container(HydraConfig.get().job, resolve=True)

    def result(run_job: object, again: bool) -> object:
        master = loader.load_configuration("train", [f"hydra.sweep.dir={tmp_path}"], RunMode.MULTIRUN)
        config = loader.load_sweep_config(master, overrides)
        with open_dict(config):
            config.hydra.job.id = config.hydra.job.num = 7
        callbacks = Callbacks()
        context = HydraContext(config_loader=loader, callbacks=callbacks)  # type: ignore[arg-type]
        before = Path.cwd(), HydraConfig.instance().cfg
        keys = {"job_dir_key": "hydra.sweep.dir", "job_subdir_key": "hydra.sweep.subdir"}
        done = run_job(hydra_context=context, task_function=task, config=config, **keys)  # type: ignore[operator]
        assert (Path.cwd(), HydraConfig.instance().cfg) == before
        assert not again or done.cfg is None
        return done.return_value, done.overrides, done.working_dir, done.task_name, callbacks.told

    theirs = result(utils.run_job, again=False)
    for _ in range(2):  # afresh, and from what is kept
        assert result(run_job, again=True) == theirs


def test_a_failed_job_has_its_error(loader: SweepLoader, tmp_path: Path) -> None:
    def task(settings: DictConfig) -> object:
        raise ValueError(settings.seed)

    master = loader.load_configuration("train", [f"hydra.sweep.dir={tmp_path}"], RunMode.MULTIRUN)
    config = loader.load_sweep_config(master, ["seed=5", "hydra.sweep.subdir=x"])
    context = HydraContext(config_loader=loader, callbacks=Callbacks())  # type: ignore[arg-type]
    done = run_job(task, config, "hydra.sweep.dir", "hydra.sweep.subdir", context)
    assert done.status is JobStatus.FAILED
    with pytest.raises(ValueError, match="5"):
        _ = done.return_value


def test_our_basic_launcher_gives_what_hydras_gives() -> None:
    """Should Hydra's call `run_job` otherwise one day, `launchers.in_process` is to be looked at."""
    from hydra._internal.core_plugins.basic_launcher import BasicLauncher

    source = inspect.getsource(BasicLauncher.launch)
    given = set(inspect.signature(hydra_job.job).parameters) - {"configures_logging"}
    assert all(f"{name}=" in source for name in given)
    assert f"{BasicLauncher.__module__}.{BasicLauncher.__name__}" == select._HYDRAS
