"""An entropy bonus that falls over training, which SB3 has as a number only.

A bonus that is large enough to keep a policy trying aims at a policy that goes on trying, and what is best
beside that one may be another action than the optimal one. Falling to 0, it ends at the world's own optimum.
"""

from __future__ import annotations

from typing import Any

from stable_baselines3.common.callbacks import BaseCallback

from gridworld.agents.sb3.settings.schemas import SB3Config
from gridworld.config.agents import falls, parse_schedule


class FallingEntropyBonus(BaseCallback):
    """Before each update, sets the `ent_coef` of a model of SB3's; usable in its own `learn()`.

    Args:
        initial: what it falls from, linearly, to 0 at the end of training.
    """

    def __init__(self, initial: float) -> None:
        super().__init__()
        self._initial = initial

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        model: Any = self.model
        left = max(0.0, 1 - model.num_timesteps / model._total_timesteps)
        model.ent_coef = self._initial * left
        model.logger.record("train/ent_coef", model.ent_coef)


def entropy_schedules(config: SB3Config) -> list[BaseCallback]:
    """The callback that an agent's settings ask for, if they do."""
    settings = vars(config) | vars(config).get("arguments", {})
    given = settings.get("ent_coef")
    return [FallingEntropyBonus(parse_schedule("ent_coef", given)[0])] if falls(given) else []
