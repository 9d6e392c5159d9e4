"""QR-DQN: W. Dabney et al., Distributional Reinforcement Learning with Quantile Regression, 2017.

As DQN, with N quantiles of the return in place of its mean: the best action is that of the largest mean, and
a sample's targets are the quantiles of the next state's best action. With τ_n = (n - 1/2) / N the level of
quantile θ_n(s, a), the N targets y_m of a sample, δ = y_m - θ_n, and h the Huber function, of which
clip(δ, -1, 1) is the derivative,

    loss       =  1/B Σ_samples Σ_n 1/N Σ_m |τ_n - (δ < 0)| h(δ)
    ∂loss/∂θ_n = -1/B Σ_samples     1/N Σ_m |τ_n - (δ < 0)| clip(δ, -1, 1)

as sb3-contrib has it.
"""

from __future__ import annotations

import numpy as np
import torch

from gridworld.engine.dqn import DQN
from gridworld.engine.networks import Array
from gridworld.engine.replay import Transitions
from gridworld.world.mdp import FloatArray, IntArray


class QRDQN(DQN):
    def _shaped(self, outputs: Array) -> Array:
        """The quantiles, (P, U, N, A)."""
        return outputs.reshape(*outputs.shape[:2], -1, self.num_actions)

    @staticmethod
    def q_of(outputs: Array) -> Array:
        return torch.as_tensor(outputs).mean(dim=-2).numpy()

    @staticmethod
    def of_best_action(outputs: Array) -> Array:
        """See `DQN.of_best_action`; (P, N, S)."""
        best = QRDQN.q_of(outputs).argmax(axis=-1)
        chosen = np.take_along_axis(outputs, best[..., None, None], axis=-1)[..., 0]
        return np.ascontiguousarray(chosen.swapaxes(1, 2))

    def _targets(self, drawn: Transitions, best: Array, gamma: Array) -> Array:
        following = np.stack(
            [of_run.take(drawn.following[:, run], axis=-1) for run, of_run in enumerate(best)]
        )
        values = following.transpose(2, 0, 1, 3)
        discounts = ((1 - drawn.ends) * gamma)[:, :, None]
        targets: Array = drawn.rewards[:, :, None] + discounts * values
        return targets

    @staticmethod
    def losses_and_slopes(
        outputs: Array, index: IntArray, actions: IntArray, targets: Array, shares: FloatArray | None
    ) -> tuple[Array, Array]:
        """See `DQN.losses_and_slopes`; targets are (P, N, B), of single transitions only."""
        assert shares is None
        runs, num_states, count, num_actions = outputs.shape
        state = index + num_states * np.arange(runs)[:, None]
        first = state * count * num_actions + actions
        where = first[:, None] + num_actions * np.arange(count)[:, None]  # (P, N, B)
        quantiles = outputs.take(where)
        # Run by run, since every target meets every quantile.
        found = [quantile_loss(*of_run) for of_run in zip(quantiles, targets, strict=True)]
        of_samples = np.concatenate([slopes.ravel() for _, slopes in found])
        return np.array([loss for loss, _ in found]), np.bincount(where.ravel(), of_samples, outputs.size)


def quantile_loss(quantiles: Array, targets: Array) -> tuple[float, Array]:
    """The loss of a minibatch, and its slopes (N, B) at the quantiles (N, B); targets are (N, B)."""
    count, batch_size = quantiles.shape
    scale = np.float32(1 / (batch_size * count))
    level = ((np.arange(count, dtype=np.float32) + np.float32(0.5)) / np.float32(count))[:, None]
    error = targets[:, None] - quantiles
    clipped, above = np.clip(error, -1, 1), np.clip(error, 0, 1)
    slopes = _weighed(level, clipped.sum(axis=0), above.sum(axis=0))
    error -= clipped * np.float32(0.5)  # h(δ) = clip(δ, -1, 1) (δ - clip(δ, -1, 1) / 2)
    losses = _weighed(level, *(np.einsum("mnb,mnb->nb", part, error) for part in (clipped, above)))
    return float(losses.sum() * scale), slopes * -scale


def _weighed(level: Array, all_of_it: Array, above: Array) -> Array:
    """Sums over targets, weighed by |τ - (δ < 0)|, of the sums over all and over those above the quantile."""
    weighed: Array = level * above + (1 - level) * (all_of_it - above)
    return weighed
