"""QR-DQN's loss and its slopes at the quantiles.

With τ_n = (n - 1/2) / N the level of quantile θ_n(s, a), the N targets y_m of a sample, δ = y_m - θ_n, and h
the Huber function, of which clip(δ, -1, 1) is the derivative,

    loss       =  1/B Σ_samples Σ_n 1/N Σ_m |τ_n - (δ < 0)| h(δ)
    ∂loss/∂θ_n = -1/B Σ_samples     1/N Σ_m |τ_n - (δ < 0)| clip(δ, -1, 1)

W. Dabney et al., Distributional Reinforcement Learning with Quantile Regression, 2017; SB3's has κ = 1.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def losses_and_slopes(quantiles: NDArray[Any], targets: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Compute the losses of minibatches of B samples, see above.

    Args:
        quantiles: (..., N, B), of the samples' states and actions.
        targets: (..., N, B).

    Returns:
        The losses, (...); their slopes at the quantiles, (..., N, B).
    """
    count, batch_size = quantiles.shape[-2:]
    scale = np.float32(1 / (batch_size * count))
    level = ((np.arange(count, dtype=np.float32) + np.float32(0.5)) / np.float32(count))[:, None]
    error = targets[..., :, None, :] - quantiles[..., None, :, :]
    clipped, above = np.clip(error, -1, 1), np.clip(error, 0, 1)
    slopes = _weighed(level, clipped.sum(axis=-3), above.sum(axis=-3))
    error -= clipped * np.float32(0.5)  # h(δ) = clip(δ, -1, 1) (δ - clip(δ, -1, 1) / 2)
    losses = _weighed(level, *(np.einsum("...mnb,...mnb->...nb", part, error) for part in (clipped, above)))
    return losses.sum(axis=(-2, -1)) * scale, slopes * -scale


def _weighed(level: NDArray[Any], all_of_it: NDArray[Any], above: NDArray[Any]) -> NDArray[Any]:
    """Sums over targets, weighed by |τ - (δ < 0)|, of the sums over all and over those above the quantile."""
    weighed: NDArray[Any] = level * above + (1 - level) * (all_of_it - above)
    return weighed
