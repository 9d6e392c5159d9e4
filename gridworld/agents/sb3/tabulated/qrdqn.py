"""QR-DQN with the network run once per state.

As in DQN, with N quantiles of the return in place of its mean: the best action is that of the largest mean,
and a sample's targets are the quantiles of the next state's best action (`tabulated.losses.qrdqn`).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from sb3_contrib import QRDQN
from torch import Tensor

from gridworld.agents.sb3.tabulated.losses.qrdqn import losses_and_slopes
from gridworld.agents.sb3.tabulated.off_policy import TabulatedOffPolicy
from gridworld.agents.sb3.tabulated.stacked_layers import Leaves
from gridworld.agents.sb3.tabulated.state_buffers import Float32Array
from gridworld.world.mdp import FloatArray, IntArray


class TabulatedQRDQN(TabulatedOffPolicy, QRDQN):  # type: ignore[misc]
    """sb3-contrib's QRDQN on a `GridWorldVecEnv`, whose files stock `QRDQN.load` opens."""

    network = "quantile_net"

    def outputs(self, network: Any, states: IntArray | None = None, leaves: Leaves | None = None) -> Tensor:
        """See `TabulatedOffPolicy.outputs`; the quantiles, (..., U, N, A)."""
        outputs = super().outputs(network, states, leaves)
        return outputs.view(*outputs.shape[:-1], self.n_quantiles, -1)

    @staticmethod
    def q_of(outputs: Tensor) -> Tensor:
        """See `TabulatedOffPolicy.q_of`."""
        return outputs.mean(dim=-2)

    @staticmethod
    def of_best_action(outputs: Tensor) -> Tensor:
        """See `TabulatedOffPolicy.of_best_action`; (N, U)."""
        best = outputs.mean(dim=1).argmax(dim=1)
        return outputs[torch.arange(len(best)), :, best].t()

    @staticmethod
    def losses_and_slopes(
        outputs: Float32Array,
        index: IntArray,
        actions: IntArray,
        targets: Float32Array,
        shares: FloatArray | None = None,
    ) -> tuple[list[float], FloatArray]:
        """See `TabulatedOffPolicy.losses_and_slopes`; the quantile Huber loss, of single transitions only."""
        assert shares is None
        runs, num_states, count, num_actions = outputs.shape
        state = index + num_states * np.arange(runs)[:, None]
        first = state * count * num_actions + actions
        where = first[:, None] + num_actions * np.arange(count)[:, None]  # (P, N, B)
        quantiles = outputs.ravel()[where]
        # Run by run, since every target stands against every quantile.
        found = [losses_and_slopes(*of_run) for of_run in zip(quantiles, targets, strict=True)]
        of_samples = np.concatenate([slopes.ravel() for _, slopes in found])
        slopes: Any = np.bincount(where.ravel(), of_samples, outputs.size)
        return [float(loss) for loss, _ in found], slopes
