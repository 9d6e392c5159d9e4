"""Settings that fall over training, in SB3's own loop and in the engine: what is logged of each update."""

from typing import Any

import pytest
from helpers.support import configure
from stable_baselines3 import A2C, PPO

import gridworld
from gridworld.agents import family
from gridworld.agents.sb3.callbacks import FallingSetting
from gridworld.envs.observations import make_observation
from gridworld.training.setup import make_context

SHORT = ("total_timesteps=320", "n_envs=4", "agent.n_steps=16", "agent.batch_size=16")


class Noting(FallingSetting):
    """Notes what each rollout was computed with, or the update before it was made with."""

    def __init__(self, name: str, initial: float) -> None:
        super().__init__(name, initial)
        self.noted: list[float] = []

    def _on_rollout_start(self) -> None:
        super()._on_rollout_start()
        model: Any = self.model
        self.noted.append(getattr(model, self._name))
        assert model.rollout_buffer.gae_lambda == model.gae_lambda


@pytest.mark.parametrize("algorithm", [PPO, A2C])
@pytest.mark.parametrize(
    ("name", "expected", "last"),
    [
        ("ent_coef", [0.4, *(0.4 * (1 - steps / 300) for steps in (64, 128, 192, 256))], 0),
        ("gae_lambda", [0.4 * (1 - steps / 300) for steps in (0, 64, 128, 192, 256)], 0.4 * (1 - 256 / 300)),
    ],
)
def test_it_falls_to_nothing_in_plain_sb3(
    algorithm: Any, name: str, expected: list[float], last: float
) -> None:
    envs = gridworld.make_vec_env("classic", n_envs=4)
    model, callback = algorithm("MlpPolicy", envs, n_steps=16, **{name: 0.4}), Noting(name, 0.4)
    model.learn(300, callback=callback)  # the last rollout ends beyond the end
    assert callback.noted == pytest.approx(expected)
    assert getattr(model, name) == pytest.approx(last)


@pytest.mark.parametrize("engine", ["tabulated", "stock"])
@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("ent_coef", "lin_0.5", [0.4, 0.3, 0.2, 0.1, 0]),
        ("ent_coef", "quad_0.5", [0.32, 0.18, 0.08, 0.02, 0]),
        ("gae_lambda", "lin_0.5", [0.5, 0.4, 0.3, 0.2, 0.1]),
        ("gae_lambda", "quad_0.5", [0.5, 0.32, 0.18, 0.08, 0.02]),
        ("learning_rate", "lin_0.5", [0.4, 0.3, 0.2, 0.1]),
        ("learning_rate", "sqrt_0.5", [0.5 * left**0.5 for left in (0.8, 0.6, 0.4, 0.2)]),
    ],
)
def test_a_run_has_it_by_its_setting(engine: str, name: str, value: str, expected: list[float]) -> None:
    config = configure("agent=ppo", f"agent.engine={engine}", *SHORT, f"agent.{name}={value}")
    mdp, logged = config.env.compile(), []
    context = make_context(
        *(config, mdp, make_observation(mdp, "one_hot")), lambda values, _: logged.append(dict(values))
    )
    family(config.agent).build(config.agent, context).learn(320, lambda steps: steps + 1)
    found = [values[f"train/{name}"] for values in logged if f"train/{name}" in values]
    assert found == pytest.approx(expected)
