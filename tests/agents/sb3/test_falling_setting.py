"""Settings that fall over training, in SB3's own loop and in the engine."""

from typing import Any

import pytest
from stable_baselines3 import A2C, PPO

import gridworld
from gridworld.agents.sb3.callbacks import FallingSetting
from gridworld.engine.population import Population

SHORT = (
    "total_timesteps=320",
    "n_envs=4",
    "agent.n_steps=16",
    "agent.batch_size=16",
    "logging.tensorboard=false",
)


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
def test_a_bonus_falls_to_nothing_in_plain_sb3(algorithm: Any) -> None:
    model = algorithm("MlpPolicy", gridworld.make_vec_env("classic", n_envs=4), n_steps=16, ent_coef=0.4)
    callback = Noting("ent_coef", 0.4)
    model.learn(300, callback=callback)
    assert callback.noted == pytest.approx([0.4, *(0.4 * (1 - steps / 300) for steps in (64, 128, 192, 256))])
    assert model.ent_coef == 0  # also where the last rollout ends beyond the end


@pytest.mark.parametrize("algorithm", [PPO, A2C])
def test_lambda_falls_to_nothing_in_plain_sb3(algorithm: Any) -> None:
    model = algorithm("MlpPolicy", gridworld.make_vec_env("classic", n_envs=4), n_steps=16, gae_lambda=0.4)
    callback = Noting("gae_lambda", 0.4)
    model.learn(256, callback=callback)
    assert callback.noted == pytest.approx([0.4, 0.3, 0.2, 0.1])


@pytest.mark.parametrize("engine", ["tabulated", "stock"])
@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("ent_coef", "lin_0.5", [0.4, 0.3, 0.2, 0.1, 0]),
        ("ent_coef", "quad_0.5", [0.32, 0.18, 0.08, 0.02, 0]),
        ("gae_lambda", "lin_0.5", [0.5, 0.4, 0.3, 0.2, 0.1]),
        ("gae_lambda", "quad_0.5", [0.5, 0.32, 0.18, 0.08, 0.02]),
        ("learning_rate", "sqrt_0.5", [0.5 * left**0.5 for left in (0.8, 0.6, 0.4, 0.2, 0)]),
    ],
)
def test_a_run_has_it_by_its_setting(
    engine: str, name: str, value: str, expected: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    found: dict[float, None] = {}  # in the order in which they were set
    own, settings = FallingSetting._set, Population.settings

    def noting(callback: FallingSetting) -> None:
        own(callback)
        model: Any = callback.model
        found[model.lr_schedule(0) if name == "learning_rate" else getattr(model, name)] = None

    def asked(population: Population, asked_for: str) -> list[float]:
        numbers = settings(population, asked_for)
        if asked_for == name:
            found[numbers[0]] = None
        return numbers

    monkeypatch.setattr(FallingSetting, "_set", noting)
    monkeypatch.setattr(Population, "settings", asked)
    falling = gridworld.train("agent=ppo", f"agent.engine={engine}", *SHORT, f"agent.{name}={value}")
    assert list(found) == pytest.approx(expected)
    assert getattr(falling.config.agent, name) == value
