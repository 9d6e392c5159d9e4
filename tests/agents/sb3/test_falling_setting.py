"""Settings that fall over training, in SB3's own loop and in the engine: what is logged of each update."""

from typing import Any

import pytest
from helpers.support import configure
from stable_baselines3 import A2C

import gridworld
from gridworld.agents import family
from gridworld.agents.sb3.callbacks import FallingSetting
from gridworld.envs.observations import make_observation
from gridworld.training.setup import make_context


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
    config = configure("agent=ppo", f"agent.engine={engine}", *words, f"agent.{name}={value}")
    mdp, logged = config.env.compile(), []
    context = make_context(
        *(config, mdp, make_observation(mdp, "one_hot")), lambda values, _: logged.append(dict(values))
    )
    family(config.agent).build(config.agent, context).learn(320, lambda steps: steps + 1)
    found = [values[f"train/{name}"] for values in logged if f"train/{name}" in values]
    assert found == pytest.approx(expected)
