"""DQN with the network run once per state.

The loss of a minibatch, the mean Huber distance of Q(s_i, a_i) to its target y_i, touches the network only
through the table Q, and there its gradient is a sum over samples:

    ∂L/∂Q(s, a) = 1/B Σ_(i: s_i = s, a_i = a) clip(Q(s, a) - y_i, -1, 1)

Of a buffer that counts transitions, the sum is over distinct ones, times their share of the minibatch.
From this table it goes back through the network once. `tabulated.state_inputs` says why that is the
gradient of the whole batch.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from stable_baselines3 import DQN

from gridworld.agents.sb3.tabulated.losses.products import products
from gridworld.agents.sb3.tabulated.off_policy import TabulatedOffPolicy
from gridworld.agents.sb3.tabulated.state_buffers import Float32Array
from gridworld.world.mdp import FloatArray, IntArray


class TabulatedDQN(TabulatedOffPolicy, DQN):
    """SB3's DQN on a `GridWorldVecEnv`, whose files stock `DQN.load` opens."""

    network = "q_net"

    @staticmethod
    def losses_and_slopes(
        outputs: Float32Array,
        index: IntArray,
        actions: IntArray,
        targets: Float32Array,
        shares: FloatArray | None = None,
    ) -> tuple[list[float], FloatArray]:
        """See `TabulatedOffPolicy.losses_and_slopes`; the Huber loss."""
        runs, num_states, num_actions = outputs.shape
        count = index.shape[1]
        pair = (index + num_states * np.arange(runs)[:, None]) * num_actions + actions
        error = outputs.ravel()[pair] - targets
        slope = np.maximum(np.minimum(error, 1), -1)
        if shares is not None:
            weighed: Any = np.bincount(pair.ravel(), (slope * shares).ravel(), outputs.size)
            sums: Any = np.cumsum(shares * slope * (error - slope / 2), axis=1)  # in turn: shares of 0 add 0
            return sums[:, -1].tolist(), weighed
        slopes = np.bincount(pair.ravel(), slope.ravel(), outputs.size) / count
        losses = products(slope, error - slope / 2)
        return (losses.astype(np.float64) / count).tolist(), slopes
