"""A2C with the network run once per state.

At the policy that it starts from, PPO's clipped surrogate has the slope of A2C's loss, -A log π(a|s): the
ratio is 1 there, and nothing is clipped. So an update is PPO's first one on the whole rollout.
S. Huang et al., A2C is a special case of PPO, 2022.
"""

from __future__ import annotations

from stable_baselines3 import A2C

from gridworld.agents.sb3.tabulated.on_policy import TabulatedOnPolicy, normalized, tables
from gridworld.agents.sb3.tabulated.ppo_loss import Weights, losses_and_slopes, sum_up


class TabulatedA2C(TabulatedOnPolicy, A2C):
    """SB3's A2C on a `GridWorldVecEnv`, whose files stock `A2C.load` opens."""

    def train(self) -> None:
        """See SB3's `A2C.train`."""
        self._update_learning_rate(self.policy.optimizer)
        states, actions, advantages, returns = self._samples()
        weighed = normalized(advantages) if self.normalize_advantage else advantages
        which, index = self.inputs.distinct(states)
        outputs = self.outputs(which)
        new = tables(*outputs)
        sums = sum_up(index, actions, weighed, returns, new.log_prob.shape)
        losses, *slopes = losses_and_slopes(new, new, sums, Weights(0.0, None, self.ent_coef, self.vf_coef))
        self.descent.step(outputs, slopes, self.max_grad_norm)
        self._n_updates += 1
        self._log_update()
        self.logger.record("train/entropy_loss", losses.entropy_loss)
        policy_loss = -float(((sums.positive + sums.negative) * new.log_prob).sum())
        self.logger.record("train/policy_loss", policy_loss)
        self.logger.record("train/value_loss", losses.value_loss)
