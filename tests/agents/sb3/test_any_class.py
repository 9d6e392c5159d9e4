"""Any class with SB3's interface by yaml alone: sb3-contrib's, and one's own by its import path."""

import json
import sys
from pathlib import Path

import pytest
from helpers.own_class import OWN_CLASS, any_class
from helpers.support import SHORT, configure, script, train_in

from gridworld.agents import family
from gridworld.commands.evaluate import main as evaluate
from gridworld.errors import InputError
from gridworld.training.train import train

OWN_YAML = """# @package _global_
# an agent of my own
defaults:
  - /agent/schema/sb3@agent
  - _self_

total_timesteps: 500
n_envs: 4
agent:
  name: mine
  algorithm: my_agents.Mine
  arguments: {caution: 0.7, gamma: 0.9}
"""


def test_a_class_that_asks_for_action_masks_gets_them(tmp_path: Path) -> None:
    words = any_class(
        "sb3_contrib.MaskablePPO", "+agent.arguments.n_steps=16", "+agent.arguments.batch_size=32"
    )
    assert train_in(tmp_path, *words)["timesteps"] == 512


A2C = "stable_baselines3.A2C"


@pytest.mark.parametrize(
    ("algorithm", "overrides", "words"),
    [
        ("sb3_contrib.RecurrentPPO", ["agent.policy=MlpLstmPolicy"], "keeps a memory from step to step"),
        (
            "sb3_contrib.ARS",
            ["~agent.arguments.gamma"],
            "tells neither probabilities and values nor Q values",
        ),
        ("stable_baselines3.SAC", [], "cannot be built: The algorithm only supports"),
        ("stable_baselines3.A3C", [], "agent.algorithm=stable_baselines3.A3C: must be the import path of"),
        ("torch.nn.ReLU", [], "must be the import path of a BaseAlgorithm class"),
        ("A2C", [], "agent.algorithm=A2C: must be the import path of a BaseAlgorithm class"),
        (A2C, ["agent.policy=MlpLstmPolicy"], "agent.policy=MlpLstmPolicy: stable_baselines3.A2C has MlpPol"),
        (
            A2C,
            ["+agent.arguments.gama=1"],
            "stable_baselines3.A2C cannot be built: A2C.__init__() got an unexpected keyword argument 'gama'",
        ),
        (A2C, ["+agent.arguments.n_steps=many"], "agent.arguments.n_steps=many: must be int"),
        (A2C, ["+agent.arguments.ent_coef=true"], "agent.arguments.ent_coef=True: must be float"),
        (A2C, ["agent.arguments.gamma=2"], "agent.arguments.gamma=2: must be from 0 to 1"),
        (A2C, ["+agent.arguments.n_steps=0"], "agent.arguments.n_steps=0: must be at least 1"),
        (A2C, ["+agent.arguments.ent_coef=abc"], "agent.arguments.ent_coef=abc: must be float"),
        (A2C, ["+agent.arguments.ent_coef=-1"], "agent.arguments.ent_coef=-1: must be at least 0"),
        (A2C, ["+agent.arguments.ent_coef=nan"], "agent.arguments.ent_coef=nan: must be at least 0"),
        (
            "sb3_contrib.TRPO",
            ["+agent.arguments.batch_size=-1"],
            "batch_size=-1: must be at least 1",
        ),
        (
            "sb3_contrib.QRDQN",
            ["+agent.arguments.train_freq=0"],
            "train_freq=0: must be a whole number",
        ),
        (A2C, ["+agent.arguments.seed=2"], "agent.arguments.seed: is not set here but by seed="),
        (A2C, ["+agent.arguments.learning_rate=fast"], "agent.arguments.learning_rate=fast: must be a numb"),
    ],
)
def test_what_cannot_work_is_refused_before_anything_is_written(
    algorithm: str, overrides: list[str], words: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError) as mistake:
        train(configure(*any_class(algorithm, *overrides)), tmp_path, [])
    assert words in str(mistake.value)
    assert list(tmp_path.iterdir()) == []


def test_a_schedule_and_classes_in_the_arguments(tmp_path: Path) -> None:
    words = any_class(
        "stable_baselines3.A2C",
        "+agent.arguments.learning_rate=lin_0.01",
        "+agent.arguments.policy_kwargs={net_arch: [16], activation_fn: torch.nn.ReLU}",
    )
    config = configure(*words)
    family(config.agent).check(config)
    assert train_in(tmp_path, *words)["timesteps"] == 500


def test_ones_own_class_in_ones_own_yaml(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "my_agents.py").write_text(OWN_CLASS)
    (tmp_path / "my_conf" / "agent").mkdir(parents=True)
    (tmp_path / "my_conf" / "agent" / "mine.yaml").write_text(OWN_YAML)
    words = ("--config-dir", "my_conf", "agent=mine", "hydra.run.dir=out", "agent.arguments.caution=0.9")
    done = script("train.py", *words, cwd=tmp_path, PYTHONPATH=str(tmp_path))
    assert done.returncode == 0, done.stderr
    assert "mine on classic, seed 0: 500 steps" in done.stdout
    settings = json.loads((tmp_path / "out" / "manifest.json").read_text())["config"]["agent"]
    assert settings["arguments"] == {"caution": 0.9, "gamma": 0.9}

    refused = script("evaluate.py", "out", cwd=tmp_path, PYTHONPATH=str(tmp_path))
    assert refused.returncode == 2
    assert "algorithm=my_agents.Mine is from none of" in refused.stderr
    assert "add --trust" in refused.stderr
    trusted = script("evaluate.py", "out", "--trust", cwd=tmp_path, PYTHONPATH=str(tmp_path))
    assert trusted.returncode == 0, trusted.stderr
    assert "greedy policy of out on classic" in trusted.stdout


@pytest.mark.parametrize("agent", ["a2c", "qrdqn", "trpo"])
def test_a_finished_run_is_read_back(agent: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    summary = train_in(tmp_path, *SHORT[agent])
    evaluate([str(tmp_path), "--episodes", "10"])
    shown = capsys.readouterr().out
    assert f"{summary['value']:.4g}" in shown


def test_a_missing_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "sb3_contrib", None)
    with pytest.raises(
        InputError, match=r"agent\.algorithm=sb3_contrib\.QRDQN: needs sb3-contrib; pip install"
    ):
        train(configure(*SHORT["qrdqn"]), tmp_path, [])
