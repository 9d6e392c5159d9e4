"""What TRPO's update needs of a policy's table, from sums per state and action instead of sample by sample.

All samples of one (state, action) share one ratio ρ = π_θ(a|s) / π_old(a|s). So with G(s, a) the sum of a
batch's B advantages per pair over B, and w_s the share of samples in state s,

    surrogate  = Σ_(s,a) G(s, a) ρ(s, a),            ∂/∂ log π(a|s) = G(s, a) ρ(s, a)
    divergence = Σ_s w_s KL(π_θ(.|s) || π_start(.|s))

and a slope g in log π is g - π Σ_a g in the logits z. The divergence's second derivative in the logits, where
θ is the start, is per state w_s (diag(π) - π π^T); with the logits' Jacobian J the Fisher matrix is

    F = J^T [w_s (diag(π) - π π^T)] J

J. Schulman et al., Trust Region Policy Optimization, 2015, appendix C. Arrays may have leading axes.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gridworld.world.mdp import FloatArray, IntArray


def sum_up(
    index: IntArray, actions: IntArray, advantages: NDArray[Any], shape: tuple[int, ...]
) -> tuple[FloatArray, FloatArray]:
    """Sum up a batch of B samples.

    Args:
        index: (B,), which of the states each sample has.
        actions: (B,), integers.
        advantages: (B,), float32.
        shape: (U, A), how many states occur and how many actions there are.

    Returns:
        G (U, A) and w (U,), see above.
    """
    count = len(index)
    gains = np.bincount(index * shape[1] + actions, advantages, shape[0] * shape[1]) / count
    return gains.reshape(shape), np.bincount(index, None, shape[0]) / count


def surrogate(log_prob: NDArray[Any], old: NDArray[Any], gains: FloatArray) -> FloatArray:
    """The surrogate (...) of log π_θ and log π_old (..., U, A)."""
    return np.asarray((gains * np.exp(log_prob - old)).sum(axis=(-2, -1)))


def surrogate_slope(log_prob: NDArray[Any], old: NDArray[Any], gains: FloatArray) -> FloatArray:
    """The surrogate's slope in the logits, (..., U, A)."""
    slope: FloatArray = gains * np.exp(log_prob - old)
    slope -= np.exp(log_prob) * slope.sum(axis=-1, keepdims=True)
    return slope


def divergence(log_prob: NDArray[Any], start: NDArray[Any], states: FloatArray) -> FloatArray:
    """The divergence (...) of log π_θ from log π_start (..., U, A); `states` (..., U) has the shares w."""
    per_state = (np.exp(log_prob) * (log_prob - start)).sum(axis=-1)
    return np.asarray((states * per_state).sum(axis=-1))


def curved(prob: NDArray[Any], states: FloatArray, moved: NDArray[Any]) -> FloatArray:
    """w_s (diag(π) - π π^T) z, (..., U, A), of a move z of the logits (..., U, A)."""
    pulled: FloatArray = prob * (moved - (prob * moved).sum(axis=-1, keepdims=True))
    return states[..., None] * pulled


def value_sums(
    index: IntArray, returns: NDArray[Any], num_states: int
) -> tuple[FloatArray, FloatArray, float]:
    """Sum up the returns (B,), float32, of a minibatch in which U states occur.

    Returns:
        Of each state the share of the samples and their mean return, (U,) each; the mean squared deviation
        of returns from their state's mean.
    """
    samples = np.bincount(index, None, num_states)
    mean = np.bincount(index, returns, num_states) / np.maximum(samples, 1)
    apart = returns - mean[index]
    return samples / len(index), mean, float(apart @ apart) / len(index)


def value_loss_and_slope(
    values: NDArray[Any], states: FloatArray, mean: FloatArray, deviation: FloatArray | float
) -> tuple[FloatArray, FloatArray]:
    """The mean squared error (...) of values (..., U), and its slope (..., U); see `value_sums`."""
    error = values - mean
    pull = states * error
    return np.asarray((pull * error).sum(axis=-1) + deviation), 2 * pull
