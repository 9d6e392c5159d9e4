"""PPO with the network run once per state.

In an update, a minibatch's loss depends on the network only through its outputs at the states, and has its
slopes there in closed form (`tabulated.ppo_loss`); from there they go back through the network once.
`tabulated.state_inputs` says why that is the gradient of the whole batch.
"""

from __future__ import annotations

from typing import Any, cast

import numpy as np
from stable_baselines3 import PPO

from gridworld.agents.sb3.tabulated.on_policy import TabulatedOnPolicy, minibatches, normalized, tables
from gridworld.agents.sb3.tabulated.ppo_loss import Losses, Outputs, Weights, losses_and_slopes, sum_up


class TabulatedPPO(TabulatedOnPolicy, PPO):
    """SB3's PPO on a `GridWorldVecEnv`, whose files stock `PPO.load` opens."""

    def train(self) -> None:
        """See SB3's `PPO.train`."""
        self._update_learning_rate(self.policy.optimizer)
        clip_range, clip_range_vf = self._clip_ranges()
        states, actions, advantages, returns = self._samples()
        weights = Weights(clip_range, clip_range_vf, self.ent_coef, self.vf_coef)
        logged: list[Losses] = []
        goes_on, epoch = True, 0
        while goes_on and epoch < self.n_epochs:
            first = len(logged)
            for batch in minibatches(len(states), self.batch_size):
                which, index = self.inputs.distinct(states[batch])
                weighed = advantages[batch]
                if self.normalize_advantage and len(batch) > 1:
                    weighed = normalized(weighed)
                old = self._old if which is None else Outputs(*(table[which] for table in self._old))
                sums = sum_up(index, actions[batch], weighed, returns[batch], old.log_prob.shape)
                outputs = self.outputs(which)
                losses, *slopes = losses_and_slopes(tables(*outputs), old, sums, weights)
                logged.append(losses)
                goes_on = self.target_kl is None or losses.approx_kl <= 1.5 * self.target_kl
                if not goes_on:
                    break
                self.descent.step(outputs, slopes, self.max_grad_norm)
            epoch += 1
        self._n_updates += epoch
        self._log(logged, first, weights)

    def _clip_ranges(self) -> tuple[float, float | None]:
        progress = self._current_progress_remaining
        clip_range, clip_range_vf = cast(Any, self.clip_range), cast(Any, self.clip_range_vf)
        return clip_range(progress), None if clip_range_vf is None else clip_range_vf(progress)

    def _log(self, logged: list[Losses], last_epoch: int, weights: Weights) -> None:
        """SB3 reports the divergence of the last epoch alone, and the loss of the last minibatch."""
        means = Losses(*np.mean(logged, axis=0).tolist())._asdict()
        means["approx_kl"] = float(np.mean([losses.approx_kl for losses in logged[last_epoch:]]))
        means["loss"] = logged[-1].loss
        for name, mean in means.items():
            self.logger.record(f"train/{name}", mean)
        self._log_update()
        self.logger.record("train/clip_range", weights.clip_range)
        if weights.clip_range_vf is not None:
            self.logger.record("train/clip_range_vf", weights.clip_range_vf)
