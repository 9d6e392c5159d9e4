"""PPO's losses and their slopes from sums per state and action, instead of sample by sample.

All samples of one (state, action) share one ratio ρ = π_θ(a|s) / π_old(a|s). For an advantage A ≥ 0 the
clipped surrogate is A · min(ρ, 1+ε), for A < 0 it is A · max(ρ, 1-ε). So with A⁺ and A⁻ the sums of a
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

and a slope g in log π is g - π Σ_a g in the logits.
J. Schulman et al., Proximal Policy Optimization Algorithms, 2017, has the losses.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gridworld.world.mdp import FloatArray, IntArray


class Outputs(NamedTuple):
    """What a policy says of U states."""

    log_prob: NDArray[Any]  # (U, A)
    values: NDArray[Any]  # (U,)


@dataclass(frozen=True, eq=False, slots=True)
class Sums:
    """Sums over a minibatch, in which U states occur; everything is divided by the number of samples.

    Attributes:
        positive: (U, A), the sum of positive advantages.
        negative: (U, A), the sum of negative advantages.
        pairs: (U, A), the share of the samples.
        states: (U,), the share of the samples.
        mean_return: (U,).
        deviation: of returns from their state's mean, squared.
    """

    positive: FloatArray
    negative: FloatArray
    pairs: FloatArray
    states: FloatArray
    mean_return: FloatArray
    deviation: float


@dataclass(frozen=True, slots=True)
class Weights:
    """The settings that the loss depends on."""

    clip_range: float
    clip_range_vf: float | None
    ent_coef: float
    vf_coef: float


class Losses(NamedTuple):
    """A minibatch's numbers under the names that SB3 logs; `loss` is the one to descend."""

    loss: float
    policy_gradient_loss: float
    value_loss: float
    entropy_loss: float
    approx_kl: float
    clip_fraction: float


def log_softmax(logits: NDArray[Any]) -> NDArray[Any]:
    """log π (..., A) of logits (..., A)."""
    shifted: NDArray[Any] = logits - logits.max(axis=-1, keepdims=True)
    shifted -= np.log(np.exp(shifted).sum(axis=-1, keepdims=True))
    return shifted


def sum_up(
    index: IntArray,
    actions: IntArray,
    advantages: NDArray[Any],
    returns: NDArray[Any],
    shape: tuple[int, ...],
) -> Sums:
    """Sum up a minibatch of B samples.

    Args:
        index: (B,), which of the states each sample has.
        actions: (B,), integers.
        advantages: (B,), float32.
        returns: (B,), float32.
        shape: (U, A), how many states occur and how many actions there are.
    """
    count, size = len(index), shape[0] * shape[1]
    pair = index * shape[1]
    pair += actions
    positive = np.bincount(pair, np.maximum(advantages, 0), size).reshape(shape) / count
    negative = np.bincount(pair, np.minimum(advantages, 0), size).reshape(shape) / count
    pairs = np.bincount(pair, None, size).reshape(shape) / count
    states = pairs.sum(axis=1)
    mean_return = np.bincount(index, returns, shape[0]) / np.maximum(states * count, 1)
    apart = returns - mean_return[index]
    return Sums(positive, negative, pairs, states, mean_return, float(apart @ apart) / count)


def losses_and_slopes(
    new: Outputs, old: Outputs, sums: Sums, weights: Weights
) -> tuple[Losses, FloatArray, FloatArray]:
    """Compute PPO's losses and their slopes, see above.

    Args:
        new: the outputs of the policy that learns.
        old: the outputs of the policy that collected the samples.
        sums: of the minibatch.
        weights: of the losses.

    Returns:
        The losses; the slopes of `loss` in the logits (U, A) and in the values (U,).
    """
    low, high = 1 - weights.clip_range, 1 + weights.clip_range
    log_ratio = new.log_prob - old.log_prob
    ratio, prob = np.exp(log_ratio), np.exp(new.log_prob)
    gains = sums.positive * np.minimum(ratio, high) + sums.negative * np.maximum(ratio, low)
    negative_entropy = (prob * new.log_prob).sum(axis=1)
    slope = -ratio * (sums.positive * (ratio <= high) + sums.negative * (ratio >= low))
    slope += weights.ent_coef * sums.states[:, None] * prob * (new.log_prob + 1)
    slope -= prob * slope.sum(axis=1, keepdims=True)

    values, moves = new.values, np.float32(1)
    if weights.clip_range_vf is not None:
        change = new.values - old.values
        values = old.values + np.clip(change, -weights.clip_range_vf, weights.clip_range_vf)
        moves = abs(change) <= weights.clip_range_vf
    error = values - sums.mean_return
    pull = sums.states * error

    policy_loss, entropy_loss = -float(gains.sum()), float(sums.states @ negative_entropy)
    value_loss = float(pull @ error) + sums.deviation
    found = Losses(
        loss=policy_loss + weights.ent_coef * entropy_loss + weights.vf_coef * value_loss,
        policy_gradient_loss=policy_loss,
        value_loss=value_loss,
        entropy_loss=entropy_loss,
        approx_kl=float((sums.pairs * (ratio - 1 - log_ratio)).sum()),
        clip_fraction=float((sums.pairs * (abs(ratio - 1) > weights.clip_range)).sum()),
    )
    return found, slope, 2 * weights.vf_coef * moves * pull
