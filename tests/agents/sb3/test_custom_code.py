"""Custom algorithms, layers, optimisers, buffers and callbacks in SB3's own loop, by code or by yaml alone.

Those that say what they keep go on to the bit; with others a run trains without checkpoints. Mistakes that
are found before anything is built are in commands/bad_input.txt.
"""

import importlib
import json
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.own_class import OWN_CLASS, any_class, importable
from helpers.resuming import begin, differences, go_on, left_behind, rows, stopped_after
from helpers.support import NO_FILES, SHORT, configure, script, train_in

import gridworld
from gridworld.agents.sb3.model_file import read_weights
from gridworld.base.errors import InputError
from gridworld.run.checkpoints import Checkpoints
from gridworld.run.reader import check_free, read_run
from gridworld.training.resume import open_unfinished
from gridworld.training.saved_run import SavedRun, settings_of
from gridworld.training.train import train

MODULE = """
import numpy as np
import torch
from stable_baselines3 import A2C, DQN
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from torch import nn

CALLS = []

class Stirring(BaseCallback):  # changes learning by what it has counted
    def __init__(self, every):
        super().__init__()
        self.every, self.rollouts, self.rates = every, 0, []

    def get_state(self):
        return {"rollouts": self.rollouts, "rates": self.rates}

    def set_state(self, state):
        self.rollouts, self.rates = state["rollouts"], list(state["rates"])
        if self.rates:
            self.model.gamma = self.model.ent_coef = self.rates[-1]

    def _on_rollout_start(self):
        self.rollouts += 1

    def _on_step(self):
        if self.n_calls % self.every == 0:
            self.rates.append(1e-3 * (1 + 3.5 * self.rollouts % 3))
            self.model.gamma = self.model.ent_coef = self.rates[-1]
            self.logger.record("mine/rate", self.rates[-1])
        return True

class Recording(BaseCallback):
    def _init_callback(self):
        CALLS.append("init")
    def _on_training_start(self):
        CALLS.append("start")
    def _on_rollout_start(self):
        CALLS.append("rollout start")
    def _on_step(self):
        CALLS.append("new_obs" in self.locals)
        return self.num_timesteps < 300
    def _on_training_end(self):
        CALLS.append("end")

class Counting:  # changes learning by what it has counted, and draws numbers of its own
    def __init__(self, *arguments, **options):
        super().__init__(*arguments, **options)
        self.count, self.numbers = 0, np.random.default_rng(5)

    def train(self, *arguments, **options):
        self.count += 1
        self.gamma = 0.9 + 0.01 * (self.count % 7) + 0.01 * self.numbers.random()
        super().train(*arguments, **options)

class WithState:
    def get_state(self):
        return {"count": self.count, "numbers": self.numbers.bit_generator.state}

    def set_state(self, state):
        self.count, self.numbers.bit_generator.state = state["count"], state["numbers"]

class SilentA2C(Counting, A2C): pass
class CountingA2C(WithState, Counting, A2C): pass
class CountingDQN(WithState, Counting, DQN): pass

class Shifting(nn.Module):  # by a number that it keeps outside of its parameters
    def __init__(self):
        super().__init__()
        self.shift = 0.1

    def forward(self, x):
        return torch.tanh(x + self.shift)

class SavedShifting(Shifting):
    def get_state(self):
        return {"shift": self.shift}

    def set_state(self, state):
        self.shift = state["shift"]

class Remembering(ReplayBuffer): pass

class Contrary(A2C):  # does not do what its network says
    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        actions, _ = super().predict(observation, state, episode_start, deterministic)
        return (actions + 1) % 4, None

class Starting(A2C):  # does another thing where an episode begins
    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        actions, _ = super().predict(observation, state, episode_start, deterministic)
        return (actions if episode_start is None or not episode_start.any() else 0 * actions + 3), None

class Alternating(A2C):  # every other time
    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        self.asked = 1 + getattr(self, "asked", 0)
        actions, _ = super().predict(observation, state, episode_start, deterministic)
        return (actions + self.asked % 2) % 4, None
"""
LESS = ["recording.frames=false", "recording.gif=false"]
STIRRING = "callbacks=[{_target_: own_code.Stirring, every: 3}]"
LAYER = "+agent.arguments.policy_kwargs.activation_fn="
STATEFUL = {
    "an algorithm on policy": ["own_code.CountingA2C"],
    "an algorithm with a replay": ["own_code.CountingDQN", "+agent.arguments.learning_starts=50"],
    "a layer": ["stable_baselines3.A2C", f"{LAYER}own_code.SavedShifting"],
    "one that asks for masks": ["sb3_contrib.MaskablePPO", "+agent.arguments.n_steps=16"],
}
EVERY = "{_target_: stable_baselines3.common.callbacks.EveryNTimesteps, n_steps: 9, callback: "
SILENT = {
    "SilentA2C": ["own_code.SilentA2C"],
    "Shifting": ["stable_baselines3.A2C", f"{LAYER}own_code.Shifting"],
    "Remembering": ["stable_baselines3.DQN", "+agent.arguments.replay_buffer_class=own_code.Remembering"],
    "Recording": ["stable_baselines3.A2C", f"callbacks=[{EVERY}{{_target_: own_code.Recording}}}}]"],
}


@pytest.fixture(autouse=True)
def _module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "own_code.py").write_text(MODULE)
    monkeypatch.syspath_prepend(tmp_path)
    sys.modules.pop("own_code", None)
    monkeypatch.setitem(sys.modules, "own_code", importlib.import_module("own_code"))  # taken out at the end


def calls() -> list[Any]:
    return sys.modules["own_code"].CALLS  # type: ignore[no-any-return]


@pytest.mark.parametrize("name", STATEFUL)
def test_what_says_its_state_goes_on_to_the_bit(name: str, tmp_path: Path) -> None:
    words = [*any_class(*STATEFUL[name]), *LESS, "checkpoint.every=100"]
    begin(tmp_path / "calm", *words)
    stopped_after(2, tmp_path / "run", *words)
    go_on(tmp_path / "run")
    assert differences(left_behind(tmp_path / "run"), left_behind(tmp_path / "calm")) == []


@pytest.mark.parametrize("name", SILENT)
def test_what_does_not_trains_without_checkpoints(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [*any_class(*SILENT[name]), *LESS]
    begin(tmp_path / "run", *words, "checkpoint.every=100")
    line = f"no checkpoints, since own_code.{name} does not define get_state and set_state\n"
    assert capsys.readouterr().err.count(line) == 1
    assert line in (tmp_path / "run" / "train.log").read_text()
    assert Checkpoints(tmp_path / "run").files() == []
    assert read_run(tmp_path / "run").is_finished
    if name == "SilentA2C":
        with pytest.raises(InputError, match="checkpoint"):
            open_unfinished(tmp_path / "run", trust=True).resume(1000)
        capsys.readouterr()
        begin(tmp_path / "none", *words, "checkpoint.every=null")
        assert "checkpoints" not in capsys.readouterr().err


def test_a_callback_goes_on_to_the_bit(tmp_path: Path) -> None:
    words = [*SHORT["a2c"], *LESS, "logging.policy_map_every=0"]
    begin(tmp_path / "calm", *words, STIRRING)
    begin(tmp_path / "without", *words)
    stopped_after(2, tmp_path / "run", *words, STIRRING, "checkpoint.every=150")
    with pytest.raises(InputError, match=r"_target_=own_code\.Stirring is called with .* add trust=true"):
        open_unfinished(tmp_path / "run")
    go_on(tmp_path / "run")
    calm, run = left_behind(tmp_path / "calm"), left_behind(tmp_path / "run")
    assert differences(run, calm) == []
    assert "mine/rate" in {tag for tag, _, _ in calm["points"]}
    assert len(calm["state"]["agent"]["own"][-1]["rates"]) > 3
    mine, others = (read_weights(tmp_path / name / "model.zip", 10**8) for name in ("run", "without"))
    weights = [name for name in mine if name.startswith("policy.") and name.endswith(".weight")]
    assert weights
    for name in weights:
        assert not np.array_equal(mine[name], others[name]), name
    assert SavedRun(tmp_path / "run").snapshot().greedy.shape == (30,)  # which calls no callback


def test_it_is_called_as_sb3_calls_it_and_may_end_training(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    begin(tmp_path / "run", *SHORT["ppo"], *LESS, "callbacks=[{_target_: own_code.Recording}]")
    found = calls()
    assert found[:3] == ["init", "start", "rollout start"]
    assert found[3:] == [True] * 19 + ["end"]  # 304 steps of 16 environments; the rollout is not over
    assert rows(tmp_path / "run")[-1]["step"] == "304"
    assert read_run(tmp_path / "run").is_finished
    told = "callbacks[0]: own_code.Recording stopped training after 304 steps\n"
    assert told in capsys.readouterr().err
    assert told in (tmp_path / "run" / "train.log").read_text()
    with pytest.raises(InputError, match=r"contains a run already; choose another folder$"):
        check_free(tmp_path / "run")  # it has no checkpoint to go on from


def test_callbacks_of_sb3_may_hold_others(tmp_path: Path) -> None:
    path, words = "stable_baselines3.common.callbacks", [*SHORT["a2c"], *LESS]
    held = f"{{_target_: {path}.EveryNTimesteps, n_steps: 200, callback: {{_target_: own_code.Recording}}}}"
    begin(tmp_path / "run", *words, f"callbacks=[{held}]")
    assert [call for call in calls() if isinstance(call, bool)] == [True, True]
    begin(tmp_path / "list", *words, f"callbacks=[{{_target_: {path}.CallbackList, callbacks: [{held}]}}]")
    assert calls().count("init") == 2
    wrong = f"callbacks=[{held.replace('own_code.Recording', 'torch.nn.ReLU')}]"
    with pytest.raises(AttributeError, match="'ReLU' object"):
        begin(tmp_path / "wrong", *words, wrong)
    limit = f"callbacks=[{{_target_: {path}.StopTrainingOnMaxEpisodes, max_episodes: 1}}]"
    stopped_after(1, tmp_path / "limit", *words, limit, "checkpoint.every=20")
    open_unfinished(tmp_path / "limit", trust=True).resume()


def test_callbacks_of_a_strangers_run_write_nothing_without_trust(tmp_path: Path) -> None:
    """Stable-Baselines3's own write files where they are told to; those of recipes: config/test_fields.py."""
    made = tmp_path / "made.json"
    held = {"_target_": "stable_baselines3.common.logger.JSONOutputFormat", "filename": str(made)}
    begin(tmp_path / "run", *SHORT["a2c"], *LESS)
    run = read_run(tmp_path / "run")
    run.manifest["config"]["callbacks"] = [held]
    with pytest.raises(InputError, match="may write files; add "):
        settings_of(run)
    assert not made.exists()


# ---- any class with SB3's interface, by yaml alone ---------------------------------------------------------

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


def test_ones_own_class_in_ones_own_yaml(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "my_agents.py").write_text(OWN_CLASS)
    (tmp_path / "my_conf" / "agent").mkdir(parents=True)
    (tmp_path / "my_conf" / "agent" / "mine.yaml").write_text(OWN_YAML)
    words = ("--config-dir", "my_conf", "agent=mine", "hydra.run.dir=out", "agent.arguments.caution=0.9")
    done = script("train.py", *words, cwd=tmp_path)  # which finds the module in its folder
    assert done.returncode == 0, done.stderr
    assert "mine on classic, seed 0: 500 steps" in done.stdout
    settings = json.loads((tmp_path / "out" / "manifest.json").read_text())["config"]["agent"]
    assert settings["arguments"] == {"caution": 0.9, "gamma": 0.9}

    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(InputError, match=r"algorithm=my_agents\.Mine is not from one of"):
        SavedRun(tmp_path / "out").snapshot()
    assert SavedRun(tmp_path / "out", trust=True).snapshot().greedy.shape == (30,)


DERIVED = """
import stable_baselines3
from stable_baselines3.common.callbacks import BaseCallback

class MyDQN(stable_baselines3.DQN): pass
class MyPPO(stable_baselines3.PPO): pass
class Counts(BaseCallback):
    def _on_step(self): return True
"""


@pytest.mark.slow
@pytest.mark.parametrize("named", ["derived.{}", "derived:{}", "derived.py:{}", "others/random.py:{}"])
def test_a_class_derived_from_a_known_one_has_its_settings(
    named: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is found in the current folder, by a file also where a module of Python's has the name."""
    (tmp_path / "others").mkdir()
    for name in ("derived.py", "others/random.py"):
        (tmp_path / name).write_text(DERIVED)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.delitem(sys.modules, "derived", raising=False)
    counts = f"callbacks=[{{_target_: '{named.format('Counts')}'}}]"
    for agent, kind in (("dqn", "MyDQN"), ("ppo", "MyPPO")):
        words = [*SHORT[agent], *NO_FILES, f"agent.algorithm={named.format(kind)}", counts]
        train_in(tmp_path / agent, *words)
        with pytest.raises(InputError, match="is not from one of"):
            SavedRun(tmp_path / agent).snapshot()
        model: Any = SavedRun(tmp_path / agent, trust=True).agent().model
        assert type(model).__name__ == kind
        assert model.gamma == configure(*words).agent.gamma
    with pytest.raises(InputError, match="must be the import path of a DQN class"):
        train_in(tmp_path / "wrong", *SHORT["dqn"], f"agent.algorithm={named.format('MyPPO')}")


def test_a_librarys_name_is_not_looked_up_in_the_current_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Anybody's run may name it, and be opened in a folder with a module of the library's name."""
    train_in(tmp_path / "run", *SHORT["qrdqn"], *NO_FILES)
    (tmp_path / "sb3_contrib.py").write_text("raise RuntimeError('imported')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [])
    for name in [name for name in sys.modules if name.partition(".")[0] == "sb3_contrib"]:
        monkeypatch.delitem(sys.modules, name)
    with pytest.raises(InputError, match="needs sb3-contrib"):
        SavedRun(tmp_path / "run").snapshot()


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
        (
            "dqn",
            "agent.policy_kwargs.activation_fn=torch.nn.Module",
            "agent=dqn: DQN cannot be evaluated: NotImplementedError: Module [Module] is missing the "
            'required "forward" function; check agent.policy_kwargs.activation_fn=torch.nn.Module',
        ),
        ("dqn", "agent.policy_kwargs.activation_fn=torch.nn.ModuleList", "torch.nn.ModuleList"),
        ("dqn", "agent.policy_kwargs.activation_fn=torch.nn.Dropout", ""),
        ("a2c", "+agent.arguments.policy_kwargs.optimizer_class=torch.optim.LBFGS", "torch.optim.LBFGS"),
        ("a2c", "+agent.arguments.policy_kwargs.optimizer_class=torch.optim.Adafactor", ""),
        ("ppo", "agent.learning_rate=1e307", "training diverged at update"),
        ("dqn", "agent.policy_kwargs.activation_fn=own_modules.Drawn", "DQN does not always answer the same"),
        (
            "a2c",
            f"{LAYER}own_modules.Among",
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


def test_a_run_scores_what_predict_does(tmp_path: Path) -> None:
    run = gridworld.train(*any_class("own_code.Contrary"), *NO_FILES, folder=tmp_path / "run")
    greedy = run.policy.greedy
    rows = run.model.observation_space.shape[0]
    network, _ = (
        type(run.model).__mro__[1].predict(run.model, np.eye(rows, dtype=np.float32), deterministic=True)
    )
    assert np.array_equal(greedy, (network + 1) % 4)
    assert gridworld.evaluate(run.model, "classic").regret == pytest.approx(run.summary["regret"], abs=1e-12)
    assert run.summary["scope"] == "by construction; actions are what own_code.Contrary.predict answers"


@pytest.mark.parametrize("name", ["Starting", "Alternating"])
def test_a_predict_that_is_not_a_function_of_the_state_is_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not always take the same action in the same state"):
        gridworld.train(*any_class(f"own_code.{name}"), *NO_FILES, folder=tmp_path / "run")
