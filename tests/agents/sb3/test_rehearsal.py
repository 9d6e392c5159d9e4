"""Settings that only the agent's class can judge are tried out before a run's folder is begun."""

import random
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.support import DEEP, SHORT, configure, train_in

from gridworld.agents import TrainingContext, family
from gridworld.agents.sb3 import rehearsal
from gridworld.agents.sb3.settings.validation import left_to_the_class
from gridworld.config.train import TrainConfig
from gridworld.envs.observations import make_observation
from gridworld.errors import InputError
from gridworld.training.setup import check_settings, make_context
from gridworld.training.train import train

KWARGS = {"dqn": "agent.policy_kwargs", "ppo": "agent.policy_kwargs", "a2c": "+agent.arguments.policy_kwargs"}

OWN_MODULE = """
import numpy as np
import torch
from stable_baselines3 import A2C
from torch import nn

calls = []
generator = np.random.default_rng(3)

class Drawn(nn.Module):  # in either mode
    def forward(self, x):
        return x + torch.randn_like(x)

class Among(nn.Module):  # depends on the rest of the batch
    def forward(self, x):
        return (x - x.mean(dim=0)).tanh()

class Counted(nn.Tanh):  # remembers what it was asked
    made = 0
    seen = {}

    def __init__(self):
        super().__init__()
        Counted.made += 1

    def forward(self, x):
        calls.append(float(generator.random()))
        self.seen[len(calls)] = True
        Counted.later = 1
        print("noise")
        return super().forward(x)

class Learner(A2C):
    def learn(self, *arguments, **options):
        calls.append("learn")
        raise KeyError("no such thing")
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


def rehearse(config: TrainConfig) -> None:
    """As before a run."""
    mdp = check_settings(config)
    observation = make_observation(mdp, config.observation.kind, config.observation.cell_size)

    def context(num_envs: int) -> TrainingContext:
        config.n_envs, own = num_envs, config.n_envs
        made = make_context(config, mdp, observation)
        config.n_envs = own
        return made

    family(config.agent).rehearse(config, context)


def kwarg(agent: str, name: str, path: str) -> str:
    """The word that gives a class to the agent's policy."""
    if agent == "a2c":
        return f"{KWARGS[agent]}={{{name}: {path}}}"
    return f"{KWARGS[agent]}.{name}={path}"


def outcome(*words: str) -> str:
    """What a rehearsal says; nothing where it says nothing."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            rehearse(configure(*words))
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


@pytest.mark.parametrize("agent", KWARGS)
@pytest.mark.parametrize("name", sorted(NO_ACTIVATION | ACTIVATION))
def test_every_activation_is_taken_or_refused_in_a_sentence(agent: str, name: str) -> None:
    told = outcome(*SHORT[agent], kwarg(agent, "activation_fn", f"torch.nn.{name}"))
    assert bool(told) == (name in NO_ACTIVATION)
    if told:
        assert told.startswith(kwarg(agent, "activation_fn", "").rstrip("=").split("=")[0].lstrip("+"))
        assert f"activation_fn=torch.nn.{name}: " in told
        assert "\n" not in told


@pytest.mark.parametrize("agent", KWARGS)
@pytest.mark.parametrize("name", sorted(NO_OPTIMIZER | OPTIMIZER))
def test_every_optimiser_is_taken_or_refused_in_a_sentence(agent: str, name: str) -> None:
    told = outcome(*SHORT[agent], kwarg(agent, "optimizer_class", f"torch.optim.{name}"))
    assert bool(told) == (name in NO_OPTIMIZER)
    if told:
        assert f"optimizer_class=torch.optim.{name}: " in told
        assert "\n" not in told


@pytest.mark.parametrize(
    ("agent", "word", "sentence"),
    [
        (
            "trpo",
            "agent.arguments.target_kl=-1",
            "agent.arguments.target_kl=-1: sb3_contrib.TRPO cannot make its first update: the network's "
            "weights are no finite number; without this setting it can",
        ),
        (
            "a2c",
            "+agent.arguments._init_setup_model=false",
            "agent.arguments._init_setup_model=False: stable_baselines3.A2C cannot be built: it makes no "
            "policy; without this setting it can",
        ),
        (
            "dqn",
            "agent.policy_kwargs.activation_fn=torch.nn.Module",
            "agent.policy_kwargs.activation_fn=torch.nn.Module: DQN cannot make its first update: Module "
            '[Module] is missing the required "forward" function; without this setting it can',
        ),
        (
            "ppo",
            "agent.ent_coef=1e307",
            "agent.ent_coef=1e+307: PPO cannot make its first update: the gradient",
        ),
        ("ppo", "agent.learning_rate=1e307", "agent.learning_rate=1e+307: PPO cannot make its first update"),
        (
            "a2c",
            "+agent.arguments.vf_coef=1e307",
            "agent.arguments.vf_coef=1e+307: stable_baselines3.A2C cannot",
        ),
        (
            "a2c",
            "+agent.arguments.stats_window_size=10000000000000000000",
            "stats_window_size=100000000000000",
        ),
        (
            "dqn",
            "agent.policy_kwargs.activation_fn=learner.Drawn",
            "Drawn: DQN does not always give the same",
        ),
        (
            "a2c",
            "+agent.arguments.policy_kwargs.activation_fn=learner.Among",
            "Among: stable_baselines3.A2C does",
        ),
    ],
)
@pytest.mark.usefixtures("own_module")
def test_a_run_is_refused_before_its_folder_is_begun(
    agent: str, word: str, sentence: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    run.mkdir()
    with pytest.raises(InputError) as mistake:
        train(configure(*SHORT[agent], *word.split()), run, [])
    assert sentence in str(mistake.value)
    assert list(run.iterdir()) == []
    assert capsys.readouterr() == ("", "")


@pytest.mark.usefixtures("own_module")
def test_an_algorithm_of_ones_own_is_not_run_twice() -> None:
    import learner  # type: ignore[import-not-found]

    assert outcome(*SHORT["a2c"], "agent.algorithm=learner.Learner") == ""
    assert learner.calls == []


@pytest.mark.usefixtures("own_module")
def test_nothing_is_touched() -> None:
    import learner

    config = configure(*SHORT["a2c"], "+agent.arguments.policy_kwargs.activation_fn=learner.Counted")
    calls, state = learner.calls, learner.generator.bit_generator.state
    chance = random.getstate(), np.random.get_state()[1].tolist(), torch.get_rng_state().tolist()  # type: ignore[index]
    rehearse(config)
    assert learner.calls is calls
    assert calls == []
    assert learner.generator.bit_generator.state == state
    assert (learner.Counted.made, learner.Counted.seen, hasattr(learner.Counted, "later")) == (0, {}, False)
    now = random.getstate(), np.random.get_state()[1].tolist(), torch.get_rng_state().tolist()  # type: ignore[index]
    assert now == chance


@pytest.mark.parametrize("agent", ["a2c", "trpo"])
def test_a_run_has_the_bits_that_it_has_without(
    agent: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pictures = ("policy_map", "q_error", "visits", "learning", "frames", "gif")
    words = [*SHORT[agent], *(f"recording.{name}=false" for name in pictures), "logging.tensorboard=false"]
    train_in(tmp_path / "with", *words)
    monkeypatch.setattr(rehearsal, "rehearse", lambda config, make_context: None)
    train_in(tmp_path / "without", *words)
    read = family(configure(*words).agent).weights
    weights, expected = (read(tmp_path / name / "model.zip", 10**8) for name in ("with", "without"))
    assert weights.keys() == expected.keys()
    assert all(np.array_equal(weights[name], expected[name]) for name in expected)


def test_a_large_rollout_is_cut_short_and_shipped_settings_need_none() -> None:
    config = configure("agent=trpo", "agent.arguments.n_steps=100000")
    rehearse(config)  # 12,800,000 steps, which would take minutes
    for agent in DEEP:
        assert left_to_the_class(configure(f"agent={agent}").agent) == []  # type: ignore[arg-type]
        assert left_to_the_class(configure(f"agent={agent}_sb3_defaults").agent) == []  # type: ignore[arg-type]
