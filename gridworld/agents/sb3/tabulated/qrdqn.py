"""QR-DQN with the network run once per state.

As in DQN, with N quantiles of the return in place of its mean: the best action is that of the largest mean,
and a sample's targets are the quantiles of the next state's best action (`tabulated.qrdqn_loss`).
"""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import torch
from sb3_contrib import QRDQN
from torch import Tensor

from gridworld.agents.sb3.tabulated.off_policy import Float32Array, TabulatedOffPolicy
from gridworld.agents.sb3.tabulated.qrdqn_loss import losses_and_slopes
from gridworld.world.mdp import FloatArray, IntArray


class TabulatedQRDQN(TabulatedOffPolicy, QRDQN):  # type: ignore[misc]
    """sb3-contrib's QRDQN on a `GridWorldVecEnv`, whose files stock `QRDQN.load` opens."""

    network = "quantile_net"

    def outputs(self, network: Any, states: IntArray | None = None) -> Tensor:
        """See `TabulatedOffPolicy.outputs`; the quantiles, (U, N, A)."""
        quantiles = super().outputs(network, states)
        return quantiles.view(len(quantiles), self.n_quantiles, -1)

    @staticmethod
    def q_of(outputs: Tensor) -> Tensor:
        """See `TabulatedOffPolicy.q_of`."""
        return outputs.mean(dim=1)

    @staticmethod
    def of_best_action(outputs: Tensor) -> Tensor:
        """See `TabulatedOffPolicy.of_best_action`; (N, U)."""
        best = outputs.mean(dim=1).argmax(dim=1)
        return outputs[torch.arange(len(best)), :, best].t()

    @staticmethod
    def loss_and_slopes(
        outputs: Float32Array, index: IntArray, actions: IntArray, targets: Float32Array
    ) -> tuple[float, FloatArray]:
        """See `TabulatedOffPolicy.loss_and_slopes`; the quantile Huber loss."""
        _, count, num_actions = outputs.shape
        where = index * count * num_actions + actions + num_actions * np.arange(count)[:, None]  # (N, B)
        loss, slopes = losses_and_slopes(outputs.ravel()[where], targets)
        return float(loss), cast(FloatArray, np.bincount(where.ravel(), slopes.ravel(), outputs.size))
