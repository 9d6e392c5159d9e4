"""Jobs that are composed together are what Hydra composes of each by itself."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from helpers.support import CONF
from hydra import compose, initialize_config_dir
from hydra.core.config_loader import ConfigLoader
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig

from gridworld.config.composition.compose import register_schemas, to_config
from gridworld.config.composition.hydra_errors import sentence
from gridworld.errors import InputError
from gridworld.sweep.configurations import Configurations
from gridworld.sweep.plan import expand


@pytest.fixture
def loader() -> Iterator[ConfigLoader]:
    register_schemas()
    with initialize_config_dir(version_base="1.3", config_dir=str(CONF)):
        yield GlobalHydra.instance().config_loader()
    HydraConfig.instance().cfg = None


def sweep(loader: ConfigLoader, *words: str) -> DictConfig:
    return loader.load_configuration("train", list(words), RunMode.MULTIRUN)


@pytest.mark.parametrize(
    ("words", "composed"),
    [
        ([], 1),
        (["agent=ppo", "seed=range(3)"], 1),
        (["agent=ppo,q_learning", "env.slip=0,0.1", "seed=0,1"], 2),
        (["env=maze", "agent=q_learning", "agent.learning_rate=lin_0.5,0.25", "seed=1,2"], 1),
        (["agent=a2c", "+agent.arguments.max_grad_norm=0.5", "seed=0,1", "observation=coordinates"], 1),
        (["agent.gamma=0.1,0.2", "agent.policy_kwargs.net_arch=[8,8]", "agent=dqn", "++n_envs=4"], 2),
        (["agent.gamma=0.1,0.2", "agent={gamma: 0.5}", "env.layout='my map.txt'"], 2),
        (["n_envs=${seed}", "seed=1,2,3"], 1),  # it follows from the seed
        (["seed=${n_envs}", "n_envs=1,2"], 1),
        (["evaluation.stop_after=null", "device='cpu'", "stratified_draws=true,false"], 1),
    ],
)
def test_each_job_is_what_hydra_composes(
    loader: ConfigLoader, words: list[str], composed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    by_hydra: list[list[str]] = []
    load = type(loader).load_sweep_config

    def counted(self: ConfigLoader, master: DictConfig, words: list[str]) -> DictConfig:
        by_hydra.append(words)
        return load(self, master, words)

    monkeypatch.setattr(type(loader), "load_sweep_config", counted)
    configure = Configurations(loader, sweep(loader))
    jobs = [overrides for overrides, _ in expand(words, loader, 100)]
    configs = [configure(job) for job in jobs]
    assert len(by_hydra) == composed
    assert configs == [to_config(compose("train", job)) for job in jobs]


@pytest.mark.parametrize(
    ("word", "told"),
    [("agent.gama=0.5", "did you mean gamma"), ("total_timesteps=often", "total_timesteps=often: Value")],
)
def test_a_mistake_is_told_as_hydra_tells_it(loader: ConfigLoader, word: str, told: str) -> None:
    with pytest.raises(HydraException) as mistake:
        Configurations(loader, sweep(loader))(["agent=dqn", word])
    assert told in sentence(mistake.value)


def test_what_all_jobs_have_in_common_is_not_some_jobs_own(loader: ConfigLoader, tmp_path: Path) -> None:
    (tmp_path / "experiment").mkdir()
    text = "# @package _global_\nhydra: {sweep: {dir: mine}}\n"
    (tmp_path / "experiment" / "dir.yaml").write_text(text)
    master = sweep(loader, f"hydra.searchpath=[file://{tmp_path}]")
    with pytest.raises(InputError, match=r"^hydra\.sweep: is set in a file that only some of the jobs"):
        Configurations(loader, master)(["experiment=dir"])
    with pytest.raises(InputError, match=r"^hydra\.sweep\.subdir=\$\{seed\}: a sweep names the folders"):
        Configurations(loader, sweep(loader, "hydra.sweep.subdir=${seed}"))
