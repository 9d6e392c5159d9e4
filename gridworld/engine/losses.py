"""Losses and their slopes at a network's outputs, from sums per state and action instead of sample by sample.

All samples of one (state, action) share one ratio ρ = π_θ(a|s) / π_old(a|s). For an advantage A ≥ 0 the
clipped surrogate of PPO is A · min(ρ, 1+ε), for A < 0 it is A · max(ρ, 1-ε). So with A⁺ and A⁻ the sums of a
minibatch's positive and negative advantages per pair, and n_s the number of samples of a state, their
returns' mean m_s and squared deviations from it d_s,

    surrogate = 1/B Σ_(s,a) [ A⁺ min(ρ, 1+ε) + A⁻ max(ρ, 1-ε) ]
    entropy   = 1/B Σ_s n_s H(π_θ(·|s))
    squares   = 1/B Σ_s [ n_s (V_θ(s) - m_s)² + d_s ]

which are the means over samples that SB3 takes, term by term; clipping the value's change keeps it a
function of the state. Their slopes at the network's outputs are as short:

    ∂ surrogate / ∂ log π(a|s) =  1/B ρ [ A⁺ (ρ ≤ 1+ε) + A⁻ (ρ ≥ 1-ε) ]
    ∂ entropy   / ∂ log π(a|s) = -1/B n_s π(a|s) (log π(a|s) + 1)
    ∂ squares   / ∂ V(s)       =  2/B n_s (V(s) - m_s)

and a slope g in log π is g - π Σ_a g in the logits. All arrays have a leading axis P.
J. Schulman et al., Proximal Policy Optimization Algorithms, 2017, has the losses.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gridworld.world.mdp import FloatArray, IntArray

Array = NDArray[Any]


@dataclass(frozen=True, eq=False, slots=True)
class Sums:
    """Sums over minibatches in which U states occur, divided by the number of samples.

    Attributes:
        positive: (..., U, A), of positive advantages.
        negative: (..., U, A), of negative advantages.
        pairs: (..., U, A), the share of the samples.
        states: (..., U), the share of the samples.
        mean_return: (..., U).
        deviation: (...), of returns from their state's mean, squared.
    """

    positive: FloatArray
    negative: FloatArray
    pairs: FloatArray
    states: FloatArray
    mean_return: FloatArray
    deviation: FloatArray

    def of(self, minibatch: int) -> Sums:
        """Those of one of K minibatches, of sums (P, K, ...)."""
        return Sums(*(getattr(self, name)[:, minibatch] for name in Sums.__slots__))


@dataclass(frozen=True, eq=False, slots=True)
class Coefficients:
    """The settings that the losses depend on, (P, 1, 1) each."""

    clip_range: FloatArray
    clip_range_vf: FloatArray | None
    ent_coef: FloatArray
    vf_coef: FloatArray


def log_softmax(logits: Array) -> Array:
    """log π (..., A) of logits (..., A)."""
    shifted: Array = logits - logits.max(axis=-1, keepdims=True)
    shifted -= np.log(np.exp(shifted).sum(axis=-1, keepdims=True))
    return shifted


def normalized(advantages: Array) -> Array:
    """Advantages (..., B) with mean 0 and standard deviation 1, as SB3 scales them."""
    mean = advantages.mean(axis=-1, keepdims=True)
    scaled: Array = (advantages - mean) / (advantages.std(axis=-1, ddof=1, keepdims=True) + 1e-8)
    return scaled


def sum_up(pairs: IntArray, advantages: Array, returns: Array, shape: tuple[int, int]) -> Sums:
    """Sum up minibatches of B samples.

    Args:
        pairs: (..., B), state · A + action of each sample.
        advantages: (..., B), float32.
        returns: (..., B), float32.
        shape: (U, A).
    """
    (num_states, num_actions), (*batches, count) = shape, pairs.shape
    size, number = num_states * num_actions * 2, pairs.size // count
    keys = 2 * pairs + (advantages < 0)
    keys += size * np.arange(number).reshape(*batches, 1)
    keys, returns = keys.ravel(), returns.astype(np.float64)
    counts, gains, total = (
        np.bincount(keys, weights, size * number).reshape(*batches, num_states, num_actions, 2)
        for weights in (None, advantages.ravel(), returns.ravel())
    )
    shares, gains, total = counts.sum(axis=-1) / count, gains / count, total.sum(axis=(-2, -1))
    states = shares.sum(axis=-1)
    mean = total / np.maximum(states * count, 1)
    deviation = np.einsum("...b,...b->...", returns, returns) - (total * mean).sum(axis=-1)
    return Sums(gains[..., 0], gains[..., 1], shares, states, mean, deviation / count)


def slopes_of(
    new: tuple[Array, Array], old: tuple[Array, Array], sums: Sums, coefficients: Coefficients
) -> tuple[FloatArray, FloatArray]:
    """Slopes of PPO's loss, see above.

    Args:
        new: log π (P, U, A) and values (P, U) of the policies that learn.
        old: of those that collected the samples.
        sums: of a minibatch.
        coefficients: of the losses.

    Returns:
        The slopes in the logits (P, U, A) and in the values (P, U).
    """
    (log_prob, values), clip, clip_vf = new, coefficients.clip_range, coefficients.clip_range_vf
    ratio, prob = np.exp(log_prob - old[0]), np.exp(log_prob)
    low, high = (1 - clip).astype(np.float32), (1 + clip).astype(np.float32)  # as exact as the ratio
    slope = -ratio * (sums.positive * (ratio <= high) + sums.negative * (ratio >= low))
    slope += coefficients.ent_coef * sums.states[..., None] * prob * (log_prob + 1)
    slope -= prob * slope.sum(axis=-1, keepdims=True)
    moves: Array = (2 * coefficients.vf_coef[..., 0]).astype(np.float32)
    if clip_vf is not None:
        values, unclipped = _clipped_values(values, old[1], clip_vf[..., 0])
        moves = moves * unclipped
    return slope, moves * (sums.states * (values - sums.mean_return))


def divergence(log_prob: Array, old: Array, pairs: FloatArray) -> FloatArray:
    """The approximate KL divergence of minibatches, (...); http://joschu.net/blog/kl-approx.html."""
    log_ratio = log_prob - old
    return np.asarray((pairs * (np.exp(log_ratio) - 1 - log_ratio)).sum(axis=(-2, -1)))


def losses_of(
    new: tuple[Array, Array], old: tuple[Array, Array], sums: Sums, coefficients: Coefficients
) -> dict[str, FloatArray]:
    """The numbers that SB3 logs, (P,) each; arguments as for `slopes_of`."""
    (log_prob, values), clip, over = new, coefficients.clip_range, (-2, -1)
    ratio = np.exp(log_prob - old[0])
    gains = sums.positive * np.minimum(ratio, 1 + clip) + sums.negative * np.maximum(ratio, 1 - clip)
    if coefficients.clip_range_vf is not None:
        values, _ = _clipped_values(values, old[1], coefficients.clip_range_vf[..., 0])
    policy = -gains.sum(axis=over)
    value = (sums.states * (values - sums.mean_return) ** 2).sum(axis=-1) + sums.deviation
    entropy = (sums.states * (np.exp(log_prob) * log_prob).sum(axis=-1)).sum(axis=-1)
    ent_coef, vf_coef = coefficients.ent_coef[:, 0, 0], coefficients.vf_coef[:, 0, 0]
    return {
        "loss": policy + ent_coef * entropy + vf_coef * value,
        "policy_gradient_loss": policy,
        "value_loss": value,
        "entropy_loss": entropy,
        "approx_kl": divergence(log_prob, old[0], sums.pairs),
        "clip_fraction": (sums.pairs * (abs(ratio - 1) > clip)).sum(axis=over),
    }


def _clipped_values(values: Array, old: Array, most: FloatArray) -> tuple[Array, Array]:
    """Values that have changed by no more than `most` (P, 1), and which of them have."""
    most, change = most.astype(np.float32), values - old
    return old + np.clip(change, -most, most), abs(change) <= most
