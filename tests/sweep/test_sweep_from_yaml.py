"""Sweeps that stand in a yaml, and settings that vary together."""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from helpers.support import CONF, script
from hydra import initialize_config_dir
from hydra.core.config_loader import ConfigLoader
from hydra.core.global_hydra import GlobalHydra

from gridworld.config.composition.compose import register_schemas
from gridworld.errors import InputError
from gridworld.storage.safe_read import read_object
from gridworld.sweep.plan import expand

GRID = """\
# @package _global_
defaults: [{override /agent: q_learning}]
total_timesteps: 300
recording: {frames: false, gif: false, learning: false}
hydra:
  mode: MULTIRUN
  sweeper:
    params: {seed: range(2), agent.learning_rate: "0.1,0.2", env: "classic,cliff", n_envs: 4}
    paired: [agent.learning_rate, env]
"""
OTHER = "# @package _global_\nhydra: {sweeper: {params: {seed: '0,1'}}}\n"
NO_TEXT = "# @package _global_\nhydra: {sweeper: {params: {seed: [0, 1]}}}\n"


@pytest.fixture
def loader() -> Iterator[ConfigLoader]:
    register_schemas()
    with initialize_config_dir(version_base="1.3", config_dir=str(CONF)):
        yield GlobalHydra.instance().config_loader()


@pytest.fixture(scope="module")
def conf(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("conf")
    (folder / "experiment").mkdir()
    for name, text in {"grid": GRID, "other": OTHER, "no_text": NO_TEXT}.items():
        (folder / "experiment" / f"{name}.yaml").write_text(text)
    return folder


def test_a_yaml_says_what_is_swept_and_that_it_is_a_sweep(conf: Path, tmp_path: Path) -> None:
    words = ["--config-dir", str(conf), "experiment=grid", "hydra.sweep.dir=sweep", "hydra.job.chdir=true"]
    done = script("train.py", *words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    names = {path.parent.name for path in tmp_path.glob("sweep/*/summary.json")}
    pairs = ("agent.learning_rate=0.1,env=classic", "agent.learning_rate=0.2,env=cliff")
    assert names == {f"seed={seed},{pair}" for seed in (0, 1) for pair in pairs}
    config = read_object(tmp_path / "sweep" / min(names) / "manifest.json")["config"]
    assert (config["total_timesteps"], config["n_envs"]) == (300, 4)

    words[2:3] = ["-m", "experiment=grid", "seed=1", "total_timesteps=300"]  # the command line goes before
    again = script("train.py", *words, cwd=tmp_path)
    assert "2 jobs: 2 done; 0 to run" in again.stderr + again.stdout, again.stderr


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("experiment=grid env=maze", "[agent.learning_rate,env]: env has no list of values; give it one"),
        ("experiment=other,maze_dqn", "hydra.sweeper: is set in a file that only some of the jobs choose"),
        ("experiment=no_text", "hydra.sweeper.params.seed: must be text as on the command line, such as 0,1"),
    ],
)
def test_a_yaml_that_cannot_be_swept_is_refused(words: str, told: str, conf: Path, tmp_path: Path) -> None:
    done = script("train.py", "--config-dir", str(conf), "-m", *words.split(), cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("error: ")
    assert told in done.stderr
    assert list(tmp_path.rglob("*.*")) == []


def test_lists_that_vary_together(loader: ConfigLoader) -> None:
    words = ["agent=dqn,ppo", "device=cpu", "seed=0,1", "+n_envs=2,4", "threads=3,4"]

    def lines(*paired: object) -> list[str]:
        return [" ".join(job) for job, _ in expand(words, loader, 16, paired)]

    assert lines("agent", "n_envs") == [
        f"agent={agent} device=cpu seed={seed} +n_envs={n_envs} threads={threads}"
        for agent, n_envs in (("dqn", 2), ("ppo", 4))
        for seed in (0, 1)
        for threads in (3, 4)
    ]
    assert lines(["threads", "seed"], ["n_envs", "agent"]) == [
        f"agent={agent} device=cpu seed={seed} +n_envs={n_envs} threads={threads}"
        for agent, n_envs in (("dqn", 2), ("ppo", 4))
        for seed, threads in ((0, 3), (1, 4))
    ]
    assert len(lines()) == 16
    _, swept = expand(words, loader, 4, [["seed", "threads"], ["agent", "n_envs"]])[0]
    assert swept == ["agent=dqn", "seed=0", "+n_envs=2", "threads=3"]


@pytest.mark.parametrize(
    ("paired", "told"),
    [
        (
            ["agent", "seed"],
            "[agent,seed]: lists that vary together are equally long; agent has 2, seed has 3",
        ),
        (["agent", "n_envs"], "[agent,n_envs]: n_envs has no list of values; give it one, n_envs=A,B"),
        (["agent", "sed"], "[agent,sed]: sed has no list of values"),
        (["agent"], "[agent]: names one setting; a pair is of two or more"),
        (["agent", "agent"], "[agent,agent]: agent is paired already; name it once"),
        ([["agent", "env"], ["env", "agent"]], "[env,agent]: env is paired already; name it once"),
        ([1, 2], "[1,2]: 1 has no list of values"),
    ],
)
def test_pairs_that_cannot_be_are_refused(loader: ConfigLoader, paired: list[object], told: str) -> None:
    with pytest.raises(InputError, match=re.escape(f"hydra.sweeper.paired={told}")):
        expand(["agent=dqn,ppo", "env=maze,cliff", "n_envs=3", "seed=0,1,2"], loader, 100, paired)
