"""Settings that only the agent's class can judge are refused in a sentence that names them."""

import sys
import warnings
from collections.abc import Iterator
from pathlib import Path

import pytest
from helpers.support import SHORT, configure

from gridworld.errors import InputError
from gridworld.training.train import train

NO_PICTURES = [
    f"recording.{name}=false" for name in ("policy_map", "q_error", "visits", "learning", "frames", "gif")
]
KWARGS = {"dqn": "agent.policy_kwargs", "ppo": "agent.policy_kwargs", "a2c": "+agent.arguments.policy_kwargs"}

OWN_MODULE = """
import torch
from torch import nn

class Drawn(nn.Module):  # in either mode
    def forward(self, x):
        return x + torch.randn_like(x)

class Among(nn.Module):  # depends on the rest of the batch
    def forward(self, x):
        return (x - x.mean(dim=0)).tanh()
"""


@pytest.fixture
def own_module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Makes `learner` importable."""
    folder = tmp_path / "modules"
    folder.mkdir()
    (folder / "learner.py").write_text(OWN_MODULE)
    monkeypatch.syspath_prepend(str(folder))
    yield
    sys.modules.pop("learner", None)


def kwarg(agent: str, name: str, path: str) -> str:
    """The word that gives a class to the agent's policy."""
    if agent == "a2c":
        return f"{KWARGS[agent]}={{{name}: {path}}}"
    return f"{KWARGS[agent]}.{name}={path}"


def outcome(folder: Path, *words: str) -> str:
    """What a run says that makes an update or two; nothing where it says nothing."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            train(configure(*words, "logging.tensorboard=false", *NO_PICTURES), folder, [])
        except InputError as error:
            return str(error)
    return ""


NO_ACTIVATION = {
    "GLU",
    "Softmax2d",
    "Module",
    "Bilinear",
    "LSTM",
    "CosineSimilarity",
    "MSELoss",
    "ModuleList",
}
ACTIVATION = {
    "ReLU",
    "Tanh",
    "GELU",
    "PReLU",
    "RReLU",
    "Dropout",
    "Softmax",
    "LogSoftmax",
    "Identity",
    "Flatten",
}
NO_OPTIMIZER = {"LBFGS", "SparseAdam", "Muon", "Optimizer"}
OPTIMIZER = {"Adam", "SGD", "RMSprop", "AdamW", "NAdam", "Rprop", "ASGD", "Adafactor"}


@pytest.mark.parametrize("name", sorted(NO_ACTIVATION | ACTIVATION))
def test_every_activation_is_taken_or_refused_in_a_sentence(name: str, tmp_path: Path) -> None:
    word = kwarg("dqn", "activation_fn", f"torch.nn.{name}")
    told = outcome(tmp_path, *SHORT["dqn"], word)
    assert bool(told) == (name in NO_ACTIVATION)
    if told:
        assert word in told or f"activation_fn=torch.nn.{name}" in told
        assert "\n" not in told


@pytest.mark.parametrize("name", sorted(NO_OPTIMIZER | OPTIMIZER))
def test_every_optimiser_is_taken_or_refused_in_a_sentence(name: str, tmp_path: Path) -> None:
    told = outcome(tmp_path, *SHORT["a2c"], kwarg("a2c", "optimizer_class", f"torch.optim.{name}"))
    assert bool(told) == (name in NO_OPTIMIZER)
    if told:
        assert f"torch.optim.{name}" in told
        assert "\n" not in told


@pytest.mark.parametrize(
    ("agent", "word", "sentence"),
    [
        ("trpo", "agent.arguments.target_kl=-1", "no finite number"),
        (
            "a2c",
            "+agent.arguments._init_setup_model=false",
            "agent=a2c: stable_baselines3.A2C cannot be built: it makes no policy",
        ),
        (
            "dqn",
            "agent.policy_kwargs.activation_fn=torch.nn.Module",
            'agent=dqn: DQN cannot make its first update: Module [Module] is missing the required "forward" '
            "function; look at agent.policy_kwargs.activation_fn=torch.nn.Module",
        ),
        ("ppo", "agent.ent_coef=1e307", "training diverged at update 0"),
        ("ppo", "agent.learning_rate=1e307", "training diverged at update"),
        ("a2c", "+agent.arguments.vf_coef=1e307", "training diverged at update"),
        ("dqn", "agent.policy_kwargs.activation_fn=learner.Drawn", "DQN does not always give the same"),
        (
            "a2c",
            "+agent.arguments.policy_kwargs.activation_fn=learner.Among",
            "agent=a2c: stable_baselines3.A2C does not always give the same",
        ),
    ],
)
@pytest.mark.usefixtures("own_module")
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_what_only_the_class_can_judge_is_refused_in_a_sentence(
    agent: str, word: str, sentence: str, tmp_path: Path
) -> None:
    assert sentence in outcome(tmp_path, *SHORT[agent], *word.split())
