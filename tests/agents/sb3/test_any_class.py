"""Any class with SB3's interface by yaml alone; settings that only it can judge are refused in a sentence."""

import json
import sys
import warnings
from pathlib import Path

import pytest
from helpers.own_class import OWN_CLASS, any_class, importable
from helpers.support import NO_FILES, SHORT, configure, script

from gridworld.base.errors import InputError
from gridworld.training.saved_run import SavedRun
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


A2C, KWARGS = "stable_baselines3.A2C", "+agent.arguments.policy_kwargs"


@pytest.mark.parametrize(
    ("algorithm", "overrides", "words"),
    [
        ("sb3_contrib.RecurrentPPO", "agent.policy=MlpLstmPolicy", "keeps memory between steps"),
        (
            "sb3_contrib.ARS",
            "~agent.arguments.gamma",
            "has neither action probabilities and values nor Q values",
        ),
        ("stable_baselines3.SAC", "seed=0", "cannot be built: AssertionError: The algorithm only supports"),
        ("stable_baselines3.A3C", "seed=0", "agent.algorithm=stable_baselines3.A3C: must be the import path"),
        ("torch.nn.ReLU", "seed=0", "must be the import path of a BaseAlgorithm class"),
        (A2C, "agent.policy=MlpLstmPolicy", "agent.policy=MlpLstmPolicy: stable_baselines3.A2C has MlpPol"),
        (A2C, "+agent.arguments.gama=1", "cannot be built: TypeError: A2C.__init__() got an unexpected key"),
        (A2C, "+agent.arguments.n_steps=many", "agent.arguments.n_steps=many: must be a number"),
        (A2C, "+agent.arguments.ent_coef=true", "agent.arguments.ent_coef=True: must be a number"),
        (A2C, "agent.arguments.gamma=2", "agent.arguments.gamma=2: must be from 0 to 1"),
        (A2C, "+agent.arguments.ent_coef=nan", "agent.arguments.ent_coef=nan: must be at least 0"),
        ("sb3_contrib.QRDQN", "+agent.arguments.train_freq=0", "train_freq=0: must be from 1 to 100000"),
        (A2C, "+agent.arguments.seed=2", "agent.arguments.seed: is a setting of the run"),
        (A2C, "+agent.arguments._init_setup_model=false", "cannot be built: AttributeError: "),
    ],
)
def test_what_cannot_work_is_refused_before_anything_is_written(
    algorithm: str, overrides: str, words: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError) as mistake:
        train(configure(*any_class(algorithm, overrides)), tmp_path, [])
    assert words in str(mistake.value)
    assert list(tmp_path.iterdir()) == []


def test_ones_own_class_in_ones_own_yaml(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "my_agents.py").write_text(OWN_CLASS)
    (tmp_path / "my_conf" / "agent").mkdir(parents=True)
    (tmp_path / "my_conf" / "agent" / "mine.yaml").write_text(OWN_YAML)
    words = ("--config-dir", "my_conf", "agent=mine", "hydra.run.dir=out", "agent.arguments.caution=0.9")
    done = script("train.py", *words, cwd=tmp_path, PYTHONPATH=str(tmp_path))
    assert done.returncode == 0, done.stderr
    assert "mine on classic, seed 0: 500 steps" in done.stdout
    settings = json.loads((tmp_path / "out" / "manifest.json").read_text())["config"]["agent"]
    assert settings["arguments"] == {"caution": 0.9, "gamma": 0.9}

    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(InputError, match=r"algorithm=my_agents\.Mine is not from one of"):
        SavedRun(tmp_path / "out").snapshot()
    assert SavedRun(tmp_path / "out", trust=True).snapshot().greedy.shape == (30,)


def test_a_missing_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "sb3_contrib", None)
    with pytest.raises(
        InputError, match=r"agent\.algorithm=sb3_contrib\.QRDQN: needs sb3-contrib; pip install"
    ):
        train(configure(*SHORT["qrdqn"]), tmp_path, [])


def outcome(folder: Path, *words: str) -> str:
    """What a run says that makes an update or two; nothing where it says nothing."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            train(configure(*words, *NO_FILES), folder, [])
        except InputError as error:
            return str(error)
    return ""


@pytest.mark.parametrize(
    ("agent", "word", "sentence"),
    [
        ("trpo", "agent.arguments.target_kl=-1", "agent.arguments.target_kl=-1: must be above 0"),
        (
            "dqn",
            "agent.policy_kwargs.activation_fn=torch.nn.Module",
            "agent=dqn: DQN cannot be evaluated: NotImplementedError: Module [Module] is missing the "
            'required "forward" function; check agent.policy_kwargs.activation_fn=torch.nn.Module',
        ),
        ("dqn", "agent.policy_kwargs.activation_fn=torch.nn.ModuleList", "torch.nn.ModuleList"),
        ("dqn", "agent.policy_kwargs.activation_fn=torch.nn.Dropout", ""),
        ("a2c", f"{KWARGS}.optimizer_class=torch.optim.LBFGS", "torch.optim.LBFGS"),
        ("a2c", f"{KWARGS}.optimizer_class=torch.optim.Adafactor", ""),
        ("ppo", "agent.learning_rate=1e307", "training diverged at update"),
        ("dqn", "agent.policy_kwargs.activation_fn=own_modules.Drawn", "DQN does not always answer the same"),
        (
            "a2c",
            f"{KWARGS}.activation_fn=own_modules.Among",
            "agent=a2c: stable_baselines3.A2C does not always answer the same",
        ),
    ],
)
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_what_only_the_class_can_judge_is_refused_in_a_sentence(
    agent: str, word: str, sentence: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    importable(tmp_path / "modules", monkeypatch)
    (tmp_path / "run").mkdir()
    told = outcome(tmp_path / "run", *SHORT[agent], word)
    assert sentence in told
    assert bool(sentence) == bool(told)
    assert "\n" not in told
