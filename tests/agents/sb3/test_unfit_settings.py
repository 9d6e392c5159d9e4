"""Settings that only the agent's class can judge are refused in a sentence that names them."""

import sys
import warnings
from collections.abc import Iterator
from pathlib import Path

import pytest
from helpers.support import NO_FILES, SHORT, configure

from gridworld.errors import InputError
from gridworld.training.train import train

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


def outcome(folder: Path, *words: str) -> str:
    """What a run says that makes an update or two; nothing where it says nothing."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            train(configure(*words, *NO_FILES), folder, [])
        except InputError as error:
            return str(error)
    return ""


CLASSES = {  # of torch: whether a policy can be made of it
    ("dqn", "activation_fn", "torch.nn"): {
        **dict.fromkeys(("GLU", "Softmax2d", "Module", "Bilinear", "LSTM", "MSELoss", "ModuleList"), False),
        **dict.fromkeys(("PReLU", "RReLU", "Dropout", "Softmax", "Identity", "Flatten"), True),
    },
    ("a2c", "optimizer_class", "torch.optim"): {
        **dict.fromkeys(("LBFGS", "SparseAdam", "Muon", "Optimizer"), False),
        **dict.fromkeys(("SGD", "NAdam", "Rprop", "ASGD", "Adafactor"), True),
    },
}


@pytest.mark.parametrize(
    ("agent", "setting", "path", "fits"),
    [
        (agent, setting, f"{module}.{name}", fits)
        for (agent, setting, module), names in CLASSES.items()
        for name, fits in names.items()
    ],
)
def test_every_class_of_torch_is_taken_or_refused_in_a_sentence(
    agent: str, setting: str, path: str, fits: bool, tmp_path: Path
) -> None:
    word = f"agent.policy_kwargs.{setting}={path}"
    if agent == "a2c":
        word = f"+agent.arguments.policy_kwargs={{{setting}: {path}}}"
    told = outcome(tmp_path, *SHORT[agent], word)
    assert bool(told) != fits
    if told:
        assert path in told
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
