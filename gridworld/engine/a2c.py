"""A2C: V. Mnih et al., Asynchronous methods for deep reinforcement learning, 2016; without the asynchrony.

At the policy that it starts from, PPO's clipped surrogate has the slope of A2C's loss, -A log π(a|s): the
ratio is 1 there, and nothing is clipped. So an update is PPO's first one on the whole rollout.
S. Huang et al., A2C is a special case of PPO, 2022.
"""

from __future__ import annotations

import numpy as np

from gridworld.engine.networks import Array
from gridworld.engine.on_policy import OnPolicy, log_softmax, losses_and_slopes
from gridworld.world.mdp import IntArray


class A2C(OnPolicy):
    def update(self, old: tuple[Array, Array], pairs: IntArray, advantages: Array, returns: Array) -> None:
        ((states, sums),) = self.summed_up(pairs[:, None], advantages[:, None], returns[:, None])
        logits, values = self.networks.run(states)
        new = log_softmax(logits), values[..., 0]
        settings = {name: self.column(name) for name in ("ent_coef", "vf_coef")}
        none = np.zeros((len(self.runs), 1, 1))
        losses, of_logits, of_values = losses_and_slopes(new, new, sums, clip_range=none, **settings)
        self.networks.backward(of_logits, of_values[..., None])
        self.check(self.optimizer.step(self.settings("learning_rate"), self.active), "the gradient")
        policy_loss = -((sums.positive + sums.negative) * new[0]).sum(axis=(-2, -1))
        for run in self.going():
            run.model._n_updates += 1
            run.record("train/entropy_loss", float(losses["entropy_loss"][run.row]))
            run.record("train/policy_loss", float(policy_loss[run.row]))
            run.record("train/value_loss", float(losses["value_loss"][run.row]))
        self.check(np.isfinite(losses["loss"]), "a loss")
