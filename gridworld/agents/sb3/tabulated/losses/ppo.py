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
All arrays have a leading axis P, of the runs that train together (`process.parallel.together`): whatever
adds up over samples or states does so per run, in the order in which it does for one run alone.
J. Schulman et al., Proximal Policy Optimization Algorithms, 2017, has the losses.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gridworld.agents.sb3.tabulated.losses.products import products
from gridworld.world.mdp import FloatArray, IntArray


class Outputs(NamedTuple):
    """What P policies say of U states."""

    log_prob: NDArray[Any]  # (P, U, A)
    values: NDArray[Any]  # (P, U)

    def of(self, rows: IntArray) -> Outputs:
        """Those of some of the policies."""
        return Outputs(self.log_prob[rows], self.values[rows])


@dataclass(frozen=True, eq=False, slots=True)
class Sums:
    """Sums over P minibatches, in which U states occur; everything is divided by the number of samples.

    Attributes:
        positive: (P, U, A), the sum of positive advantages.
        negative: (P, U, A), the sum of negative advantages.
        pairs: (P, U, A), the share of the samples.
        states: (P, U), the share of the samples.
        mean_return: (P, U).
        deviation: (P,), of returns from their state's mean, squared.
    """

    positive: FloatArray
    negative: FloatArray
    pairs: FloatArray
    states: FloatArray
    mean_return: FloatArray
    deviation: FloatArray

    def of(self, rows: IntArray) -> Sums:
        """Those of some of the runs; the deviation is theirs already."""
        of_pairs = self.positive[rows], self.negative[rows], self.pairs[rows]
        return Sums(*of_pairs, self.states[rows], self.mean_return[rows], self.deviation)


@dataclass(frozen=True, eq=False, slots=True)
class Weights:
    """The settings that the losses depend on, (P, 1, 1) each."""

    clip_range: FloatArray
    clip_range_vf: FloatArray | None
    ent_coef: FloatArray
    vf_coef: FloatArray

    def of(self, rows: IntArray) -> Weights:
        """Those of some of the runs."""
        vf = self.clip_range_vf
        clip_range_vf = None if vf is None else vf[rows]
        return Weights(self.clip_range[rows], clip_range_vf, self.ent_coef[rows], self.vf_coef[rows])


def column(numbers: Sequence[float]) -> FloatArray:
    """A setting of P runs as `Weights` has it."""
    return np.array(numbers, dtype=np.float64).reshape(-1, 1, 1)


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
    states: IntArray,
    pairs: IntArray,
    advantages: NDArray[Any],
    returns: NDArray[Any],
    shape: tuple[int, ...],
) -> Sums:
    """Sum up minibatches of B samples each.

    Args:
        states: (R, B), run · U + state of each sample, for R of the P runs.
        pairs: (R, B), states · A + action.
        advantages: (R, B), float32.
        returns: (R, B), float32.
        shape: (P, U, A), how many runs and states there are, and how many actions.

    Returns:
        The sums of all P runs, all 0 where a run has no samples; the deviation of R.
    """
    count, pair, state = pairs.shape[1], pairs.ravel(), states.ravel()
    size = math.prod(shape)
    positive = np.bincount(pair, np.maximum(advantages, 0).ravel(), size).reshape(shape) / count
    negative = np.bincount(pair, np.minimum(advantages, 0).ravel(), size).reshape(shape) / count
    share = np.bincount(pair, None, size).reshape(shape) / count
    of_states = share.sum(axis=-1)
    total = np.bincount(state, returns.ravel(), of_states.size).reshape(of_states.shape)
    mean_return = total / np.maximum(of_states * count, 1)
    apart = returns - mean_return.ravel().take(states)
    deviation = products(apart, apart) / count
    return Sums(positive, negative, share, of_states, mean_return, deviation)


def losses_and_slopes(
    new: Outputs, old: Outputs, sums: Sums, weights: Weights
) -> tuple[list[Losses], FloatArray, FloatArray]:
    """Compute PPO's losses and their slopes, see above.

    Args:
        new: the outputs of the policies that learn.
        old: the outputs of the policies that collected the samples.
        sums: of the minibatches.
        weights: of the losses.

    Returns:
        The losses of each run; the slopes of `loss` in the logits (P, U, A) and in the values (P, U).
    """
    # Bounds are as exact as the outputs that are compared with them.
    low, high, width = (
        bound.astype(np.float32)
        for bound in (1 - weights.clip_range, 1 + weights.clip_range, weights.clip_range)
    )
    log_ratio = new.log_prob - old.log_prob
    ratio, prob = np.exp(log_ratio), np.exp(new.log_prob)
    gains = sums.positive * np.minimum(ratio, high) + sums.negative * np.maximum(ratio, low)
    negative_entropy = (prob * new.log_prob).sum(axis=-1)
    slope = -ratio * (sums.positive * (ratio <= high) + sums.negative * (ratio >= low))
    slope += weights.ent_coef * sums.states[..., None] * prob * (new.log_prob + 1)
    slope -= prob * slope.sum(axis=-1, keepdims=True)

    values, moves = new.values, (2 * weights.vf_coef[:, :, 0]).astype(np.float32)
    if weights.clip_range_vf is not None:
        most = weights.clip_range_vf[:, :, 0].astype(np.float32)
        change = new.values - old.values
        values = old.values + np.minimum(np.maximum(change, -most), most)
        moves = 2 * weights.vf_coef[:, :, 0] * (abs(change) <= most)
    error = values - sums.mean_return
    pull = sums.states * error

    kl = sums.pairs * (ratio - 1 - log_ratio)
    clipped = sums.pairs * (abs(ratio - 1) > width)
    policy_loss, approx_kl, clip_fraction = (
        each.reshape(len(each), -1).sum(axis=1).tolist() for each in (-gains, kl, clipped)
    )
    entropy_loss = products(sums.states, negative_entropy).tolist()
    square = products(pull, error).tolist()
    ent_coefs, vf_coefs = weights.ent_coef.ravel().tolist(), weights.vf_coef.ravel().tolist()
    found = []
    for run, deviation in enumerate(sums.deviation.tolist()):
        value_loss = square[run] + deviation
        loss = policy_loss[run] + ent_coefs[run] * entropy_loss[run] + vf_coefs[run] * value_loss
        found.append(
            Losses(loss, policy_loss[run], value_loss, entropy_loss[run], approx_kl[run], clip_fraction[run])
        )
    return found, slope, moves * pull
