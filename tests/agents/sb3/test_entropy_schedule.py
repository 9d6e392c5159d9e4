"""An entropy bonus that falls, in SB3's own loop and in the tabulated one."""

from typing import Any

import pytest
from stable_baselines3 import A2C, PPO

import gridworld
from gridworld.agents.sb3.entropy_schedule import FallingEntropyBonus

SHORT = (
    "total_timesteps=320",
    "n_envs=4",
    "agent.n_steps=16",
    "agent.batch_size=16",
    "logging.tensorboard=false",
)


class Noting(FallingEntropyBonus):
    """Notes what the updates before each rollout were made with."""

    def __init__(self, initial: float) -> None:
        super().__init__(initial)
        self.noted: list[float] = []

    def _on_rollout_start(self) -> None:
        model: Any = self.model
        self.noted.append(model.ent_coef)


@pytest.mark.parametrize("algorithm", [PPO, A2C])
def test_it_falls_to_nothing_in_plain_sb3(algorithm: Any) -> None:
    model = algorithm("MlpPolicy", gridworld.make_vec_env("classic", n_envs=4), n_steps=16, ent_coef=0.4)
    callback = Noting(0.4)
    model.learn(300, callback=callback)
    assert callback.noted == pytest.approx([0.4, *(0.4 * (1 - steps / 300) for steps in (64, 128, 192, 256))])
    assert model.ent_coef == 0  # also where the last rollout ends beyond the end


@pytest.mark.parametrize("engine", ["tabulated", "stock"])
def test_a_run_has_it_by_its_setting(engine: str, monkeypatch: pytest.MonkeyPatch) -> None:
    bonuses: list[float] = []
    own = FallingEntropyBonus._on_rollout_end

    def noting(callback: FallingEntropyBonus) -> None:
        own(callback)
        model: Any = callback.model
        bonuses.append(model.ent_coef)

    monkeypatch.setattr(FallingEntropyBonus, "_on_rollout_end", noting)
    words = ("agent=ppo", f"agent.engine={engine}", *SHORT)
    falling = gridworld.train(*words, "agent.ent_coef=lin_0.5")
    assert bonuses == pytest.approx([0.4, 0.3, 0.2, 0.1, 0])
    assert falling.config.agent.ent_coef == "lin_0.5"  # type: ignore[attr-defined]
    gridworld.train(*words, "agent.ent_coef=0.5")
    assert len(bonuses) == 5
