"""Settings that fall over training in ways that SB3 has not.

An entropy bonus that is large enough to keep a policy trying aims at a policy that goes on trying, and what
is best beside that one may be another action than the optimal one. Falling to 0, it ends at the world's own
optimum. Generalised advantages with a λ near 1 are close to returns, by which the values follow the policy
soon; with a small one they have less noise, once the values have arrived.
"""

from __future__ import annotations

from typing import Any

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import FloatSchedule

from gridworld.agents.sb3.settings.schemas import SB3Config
from gridworld.agents.sb3.settings.validation import FALLING, SCHEDULES
from gridworld.config.agents import Decay, falls, parse_schedule


class FallingSetting(BaseCallback):
    """Sets a number of a model of SB3's as training goes on; usable in SB3's own `learn()`.

    Args:
        name: `ent_coef` or `learning_rate`, set before each update, or `gae_lambda`, set before each rollout.
        initial: what it falls from, to 0 at the end of training.
        power: 1 lets it fall linearly, 2 with the square of what is left of training.
    """

    def __init__(self, name: str, initial: float, power: float = 1.0) -> None:
        super().__init__()
        self._name, self._decay = name, Decay(initial, power)

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        if self._name == "gae_lambda":
            self._set()

    def _on_rollout_end(self) -> None:
        if self._name != "gae_lambda":
            self._set()

    def _set(self) -> None:
        model: Any = self.model
        value = self._decay.at(min(model.num_timesteps / model._total_timesteps, 1.0))
        if self._name == "learning_rate":  # SB3's own, so that its `load` reads the model's file anywhere
            model.lr_schedule = FloatSchedule(value)
            return
        setattr(model, self._name, value)
        if self._name == "gae_lambda":
            model.rollout_buffer.gae_lambda = value
        model.logger.record(f"train/{self._name}", value)


def falling_settings(config: SB3Config) -> list[BaseCallback]:
    """The callbacks that an agent's settings ask for."""
    given = vars(config) | vars(config).get("arguments", {})
    found = {name: parse_schedule(name, given[name]) for name in FALLING if falls(given.get(name))}
    return [
        FallingSetting(name, decay.initial, decay.power)
        for name, decay in found.items()
        if not (name in SCHEDULES and decay.power == 1)
    ]
