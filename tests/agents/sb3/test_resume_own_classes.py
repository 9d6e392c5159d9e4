"""Custom classes say what they keep and go on to the bit, or train without checkpoints."""

import importlib
import sys
from pathlib import Path

import pytest
from helpers.own_class import any_class
from helpers.resuming import begin, differences, go_on, left_behind, rows, stopped_after

from gridworld.errors import InputError
from gridworld.restore.resume import open_unfinished
from gridworld.run.checkpoints import Checkpoints

LESS = ["recording.frames=false", "recording.gif=false", "checkpoint.every=100"]
MODULE = """
import numpy as np
import torch
from stable_baselines3 import A2C, DQN
from stable_baselines3.common.buffers import ReplayBuffer
from torch import nn

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

class Adam(torch.optim.Adam): pass
class Remembering(ReplayBuffer): pass
"""
LAYER = "+agent.arguments.policy_kwargs.activation_fn="
STATEFUL = {
    "an algorithm on policy": ["learner.CountingA2C"],
    "an algorithm with a replay": ["learner.CountingDQN", "+agent.arguments.learning_starts=50"],
    "a layer": ["stable_baselines3.A2C", f"{LAYER}learner.SavedShifting"],
    "one that asks for masks": ["sb3_contrib.MaskablePPO", "+agent.arguments.n_steps=16"],
}
SILENT = {
    "SilentA2C": ["learner.SilentA2C"],
    "Shifting": ["stable_baselines3.A2C", f"{LAYER}learner.Shifting"],
    "Adam": ["stable_baselines3.A2C", "+agent.arguments.policy_kwargs.optimizer_class=learner.Adam"],
    "Remembering": ["stable_baselines3.DQN", "+agent.arguments.replay_buffer_class=learner.Remembering"],
}


@pytest.fixture(autouse=True)
def _module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "learner.py").write_text(MODULE)
    monkeypatch.syspath_prepend(tmp_path)
    sys.modules.pop("learner", None)
    monkeypatch.setitem(sys.modules, "learner", importlib.import_module("learner"))  # taken out at the end


@pytest.mark.parametrize("name", STATEFUL)
def test_what_says_its_state_goes_on_to_the_bit(name: str, tmp_path: Path) -> None:
    words = [*any_class(*STATEFUL[name]), *LESS]
    begin(tmp_path / "calm", *words)
    stopped_after(2, tmp_path / "run", *words)
    go_on(tmp_path / "run")
    assert differences(left_behind(tmp_path / "run"), left_behind(tmp_path / "calm")) == []


@pytest.mark.parametrize("name", SILENT)
def test_what_does_not_trains_without_checkpoints(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    begin(tmp_path / "run", *any_class(*SILENT[name]), *LESS)
    line = f"checkpoints: none, since learner.{name} does not define get_state and set_state\n"
    assert capsys.readouterr().err.count(line) == 1
    assert line in (tmp_path / "run" / "train.log").read_text()
    assert Checkpoints(tmp_path / "run").files() == []
    assert int(rows(tmp_path / "run")[-1]["step"]) >= 500
    if name == "SilentA2C":
        with pytest.raises(InputError, match="checkpoint"):
            open_unfinished(tmp_path / "run", trust=True).resume(1000)
        capsys.readouterr()
        begin(tmp_path / "none", *any_class(*SILENT[name]), *LESS, "checkpoint.every=null")
        assert "checkpoints" not in capsys.readouterr().err
