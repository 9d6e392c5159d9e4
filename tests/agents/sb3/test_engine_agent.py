"""Which settings the engine learns with, SB3's own model that it leaves, and settings that fall."""

import contextlib
import sys
from pathlib import Path
from subprocess import run
from typing import Any

import numpy as np
import pytest
import torch
from helpers.own_class import importable
from helpers.support import SHORT, configure
from sb3_contrib import QRDQN
from stable_baselines3 import A2C, DQN, PPO

import gridworld
from gridworld.agents import Agent
from gridworld.agents.sb3.agent import ACTIVATIONS, EngineAgent, SB3Agent
from gridworld.agents.sb3.callbacks import FallingSetting
from gridworld.base.errors import InputError
from gridworld.training.setup import make_context


def built(*words: str, log: Any = None) -> Agent:
    config = configure(*words)
    return config.agent.build(make_context(config, config.env.compile(), log))


SB3S = {"dqn": DQN, "ppo": PPO, "a2c": A2C, "qrdqn": QRDQN}


@pytest.mark.parametrize("agent", SB3S)
def test_the_model_is_sb3s_own_and_learns_on(agent: str, tmp_path: Path) -> None:
    features = ["observation=coordinates"] if agent == "ppo" else []  # of a class of ours
    trained = built(*SHORT[agent], "n_envs=4", *features)
    trained.learn(200, lambda steps: steps + 1)
    file, model = tmp_path / "model.zip", trained.model
    file.write_bytes(trained.model_file())
    loaded = SB3S[agent].load(file, device="cpu")
    assert type(model) is type(loaded) is SB3S[agent]
    for mine, theirs in zip(model.policy.parameters(), loaded.policy.parameters(), strict=True):
        assert torch.equal(mine, theirs)
    greedy = loaded.predict(model.env.observation.table(), deterministic=True)[0]
    assert np.array_equal(greedy, trained.snapshot().greedy)
    assert model.num_timesteps >= 200
    for each in (model, loaded.set_env(model.env) or loaded):
        before = each.num_timesteps
        each.learn(100, reset_num_timesteps=False)
        assert each.num_timesteps >= before + 100


OURS = "gridworld.agents.sb3"
WITHOUT_US = """
import sys
sys.modules["gridworld"] = None  # an import of it fails
import numpy as np, stable_baselines3 as sb3
for name in sys.argv[1:]:
    model = getattr(sb3, name.split(".")[0]).load(name, device="cpu")
    print(*model.predict(np.load(name + ".npy"), deterministic=True)[0])
"""


@pytest.mark.slow
def test_a_model_file_opens_where_this_package_is_not_installed(tmp_path: Path) -> None:
    counting = [f"agent.replay_buffer_class={OURS}.replay_counts.ReplayCounts"]
    cases = {
        "PPO.coordinates": ["ppo", "observation=coordinates"],
        "A2C.image": ["a2c", "observation=image"],
        "DQN.colour": ["dqn", "observation=image", f"observation.features={OURS}.features.AgentByColour"],
        "DQN.stock": ["dqn", "observation=coordinates", "agent.engine=stock", *counting],
        "PPO.number": ["ppo", "observation=none"],
    }
    expected = []
    for name, (agent, *words) in cases.items():
        trained = built(*SHORT[agent], "n_envs=4", *words)
        trained.learn(100, lambda steps: steps + 1)
        (tmp_path / name).write_bytes(trained.model_file())
        np.save(tmp_path / f"{name}.npy", trained.observation.table())
        expected.append(trained.snapshot().greedy.tolist())
    opened = run([sys.executable, "-c", WITHOUT_US, *cases], cwd=tmp_path, capture_output=True, text=True)
    assert opened.returncode == 0, opened.stderr
    assert [[int(each) for each in line.split()] for line in opened.stdout.splitlines()] == expected


UNKNOWN = [
    "agent.n_steps=3",
    *(f"agent.policy_kwargs.activation_fn=torch.nn.{name}" for name in ("RReLU", "Dropout", "Softmax")),
    *(f"agent.policy_kwargs.activation_fn=own_modules.{name}" for name in ("Drawn", "Among", "ReLU")),
    "agent.policy=own_modules.Policy",
    "agent.policy_kwargs.optimizer_class=own_modules.Adam",
    "agent.policy_kwargs.optimizer_class=torch.optim.Rprop",
    "agent.replay_buffer_class=stable_baselines3.common.buffers.ReplayBuffer",
]


@pytest.mark.parametrize("setting", UNKNOWN)
def test_what_it_does_not_know_learns_in_sb3s_loop_and_a_line_says_why(
    setting: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    importable(tmp_path, monkeypatch)
    with contextlib.suppress(InputError):  # some cannot learn there either
        agent = built("agent=dqn", setting)
        assert type(agent) is SB3Agent
        assert type(agent.model) is DQN
    assert f"engine: stock, since the tabulated engine does not support {setting}" in capsys.readouterr().err


@pytest.mark.parametrize(
    "words",
    [
        ["agent=ppo"],
        ["agent=dqn", "agent.policy_kwargs.activation_fn=torch.nn.modules.activation.GELU"],
        ["agent=ppo", "agent.policy_kwargs.optimizer_class=torch.optim.adamw.AdamW"],
        ["agent=dqn", "agent.policy=stable_baselines3.dqn.policies.DQNPolicy"],
    ],
)
def test_what_it_knows(words: list[str]) -> None:
    assert type(built(*words)) is EngineAgent


@pytest.mark.parametrize("agent", ["a2c", "qrdqn"])
def test_a_class_with_its_arguments(agent: str, capsys: pytest.CaptureFixture[str]) -> None:
    without = [f"~agent.arguments.{name}" for name in vars(configure(f"agent={agent}").agent)["arguments"]]
    assert type(built(f"agent={agent}")) is EngineAgent
    assert type(built(f"agent={agent}", "agent.engine=stock")) is SB3Agent
    other = built(f"agent={agent}", "agent.algorithm=sb3_contrib.MaskablePPO", *without)
    assert type(other) is SB3Agent
    assert capsys.readouterr().err == ""
    unknown = "agent.arguments.policy_kwargs.activation_fn=torch.nn.RReLU"
    assert type(built(f"agent={agent}", f"+{unknown}")) is SB3Agent
    assert f"engine: stock, since the tabulated engine does not support {unknown}" in capsys.readouterr().err
    config = configure(f"agent={agent}", "agent.engine=fast")
    with pytest.raises(InputError, match=r"agent\.engine=fast: must be tabulated or stock"):
        config.agent.check(config)


@pytest.mark.parametrize("kind", ACTIVATIONS)
def test_an_activation_that_is_covered_is_a_function_of_each_number(kind: type[torch.nn.Module]) -> None:
    """The same in both modes, alone and among others, time and again, and nothing is drawn."""
    chance, module = torch.get_rng_state(), kind()
    x = torch.linspace(-4, 4, 42).reshape(6, 7)
    expected = module.train()(x)
    for _ in range(2):
        assert torch.equal(module(x), expected)
    module.eval()
    assert torch.allclose(module(x.flip(0).t().contiguous()).t().flip(0), expected, atol=1e-6)
    assert torch.allclose(torch.stack([module(row) for row in x]), expected, atol=1e-6)
    assert torch.equal(torch.get_rng_state(), chance)
    assert not list(module.buffers())


@pytest.mark.parametrize(("name", "last"), [("ent_coef", 0), ("gae_lambda", 0.4 * (1 - 256 / 300))])
def test_it_falls_to_nothing_in_plain_sb3(name: str, last: float) -> None:
    envs, arguments = gridworld.make_vec_env("classic", n_envs=4), {name: 0.4}
    model: Any = A2C("MlpPolicy", envs, n_steps=16, **arguments)
    model.learn(300, callback=FallingSetting(name, 0.4))  # the last rollout ends beyond the end
    assert getattr(model, name) == pytest.approx(last)
    assert model.rollout_buffer.gae_lambda == model.gae_lambda


@pytest.mark.parametrize("engine", ["tabulated", "stock"])
@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("ent_coef", "lin_0.5", [0.4, 0.3, 0.2, 0.1, 0]),
        ("ent_coef", "quad_0.5", [0.32, 0.18, 0.08, 0.02, 0]),
        ("gae_lambda", "lin_0.5", [0.5, 0.4, 0.3, 0.2, 0.1]),
        ("learning_rate", "lin_0.5", [0.4, 0.3, 0.2, 0.1]),
        ("learning_rate", "sqrt_0.5", [0.5 * left**0.5 for left in (0.8, 0.6, 0.4, 0.2)]),
    ],
)
def test_a_run_has_it_by_its_setting(engine: str, name: str, value: str, expected: list[float]) -> None:
    words = ("total_timesteps=320", "n_envs=4", "agent.n_steps=16", "agent.batch_size=16")
    logged: list[Any] = []
    words = (*words, "agent.n_epochs=1", f"agent.engine={engine}", f"agent.{name}={value}")
    agent = built("agent=ppo", *words, log=lambda values, _: logged.append(dict(values)))
    agent.learn(320, lambda steps: steps + 1)
    found = [values[f"train/{name}"] for values in logged if f"train/{name}" in values]
    assert found == pytest.approx(expected)
