"""What PPO and A2C share: rollouts by look-ups, generalised advantages, and losses by state and action.

A loss and its slopes at a network's outputs follow from sums per state and action, not sample by sample.

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

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from gridworld.base.serialization import State
from gridworld.engine.environments import Rollout
from gridworld.engine.networks import Array
from gridworld.engine.population import FEW_STATES, Population, Run
from gridworld.world.mdp import FloatArray, IntArray


class OnPolicy(Population):
    """Actor-critics that alternate between a rollout of `n_steps` steps and an update on it."""

    def __init__(self, runs: Sequence[Run], states: Sequence[State | None]) -> None:
        self._outputs: tuple[Array, Array] | None = None  # of the networks as they are
        super().__init__(runs, states)
        self.n_steps: int = runs[0].model.n_steps
        self.normalize_advantage: bool = runs[0].model.normalize_advantage

    @property
    def outputs(self) -> tuple[Array, Array]:
        """Logits (P, S, A) and values (P, S) of all states that are ever met."""
        if self._outputs is None:
            logits, values = self.networks.run_met()
            self._outputs = logits, values[..., 0]
        return self._outputs

    def column(self, name: str) -> FloatArray:
        """(P, 1, 1), of `settings`."""
        return np.array(self.settings(name)).reshape(-1, 1, 1)

    def snapshot(self, run: Run) -> tuple[FloatArray, FloatArray | None, FloatArray | None]:
        logits, values = self.outputs
        if self.networks.kept is not None:
            logits, values = self.networks.run()
            values = values[..., 0]
        probabilities = torch.as_tensor(logits[run.row]).softmax(dim=-1).numpy()
        return values[run.row].astype(np.float64), probabilities.astype(np.float64), None

    def iterate(self) -> None:
        """See `Population.iterate`: a rollout, and an update by it."""
        gae_lambda = self.settings("gae_lambda")
        for run in self.runs:
            if "gae_lambda" in run.falling:
                run.record("train/gae_lambda", gae_lambda[run.row])
        logits, values = self.outputs
        old = log_softmax(logits), values
        draws = [torch.rand(self.n_steps, self.num_envs, generator=run.torch_generator) for run in self.runs]
        rollout = self.environments.roll(np.exp(old[0]), torch.cat(draws, dim=1).numpy())
        for run in self.runs:
            self._count(run, rollout)
        self.num_timesteps += self.n_steps * self.num_envs
        for run in self.going():
            self._log_rollout(run)
        if not self.active.any():
            return
        advantages, returns = self._advantages(rollout, old[1], np.array(gae_lambda))
        tables = (rollout.pairs, advantages, returns)  # (n, P, E), below (P, E · n), in SB3's order
        samples = [np.ascontiguousarray(each.transpose(1, 2, 0)).reshape(len(old[0]), -1) for each in tables]
        self._outputs = None
        self.update(old, *samples)
        self._log_update(samples[1], samples[2])

    def update(self, old: tuple[Array, Array], pairs: IntArray, advantages: Array, returns: Array) -> None:
        """Update the networks with samples (P, n), environment by environment as SB3 has them.

        `old` are log π (P, S, A) and values (P, S) of the policies that collected them.
        """
        raise NotImplementedError

    def summed_up(
        self, pairs: IntArray, advantages: Array, returns: Array
    ) -> Iterator[tuple[IntArray | None, Sums]]:
        """The states to run the network on, None for all, and the sums there, of K minibatches (P, K, B)."""
        if self.normalize_advantage and pairs.shape[-1] > 1:  # as SB3 scales them
            mean = advantages.mean(axis=-1, keepdims=True)
            advantages = (advantages - mean) / (advantages.std(axis=-1, ddof=1, keepdims=True) + 1e-8)
        if self.num_states <= max(FEW_STATES, pairs.shape[-1]):
            sums = sum_up(pairs, advantages, returns, (self.num_states, self.num_actions))
            yield from ((None, sums.of(number)) for number in range(pairs.shape[1]))
            return
        for number in range(pairs.shape[1]):
            states, actions = np.divmod(pairs[0, number], self.num_actions)
            which, index = np.unique(states, return_inverse=True)
            pair, shape = (index * self.num_actions + actions)[None], (len(which), self.num_actions)
            yield which, sum_up(pair, advantages[:, number], returns[:, number], shape)

    def _count(self, run: Run, rollout: Rollout) -> None:
        """Count a run's steps, and call what wants to be called after one of them."""
        started, size = self.num_timesteps, self.num_envs
        pairs, rewards = rollout.pairs[:, run.row], rollout.rewards[:, run.row]
        steps, returns, lengths = rollout.ended[run.row]
        first = 0
        while first < self.n_steps:
            due = -(-(run.next_call - started) // size)  # steps of the rollout
            end = min(max(due, first + 1), self.n_steps)
            run.envs.count(pairs[first:end], rewards[first:end])
            a, b = np.searchsorted(steps, (first, end))
            run.envs.add_returns(steps[a:b], returns[a:b])
            run.step_on(started + end * size)
            if not self.active[run.row]:
                return
            run.keep_episodes(returns[a:b], lengths[a:b])
            first = end

    def _advantages(self, rollout: Rollout, values: Array, gae_lambda: FloatArray) -> tuple[Array, Array]:
        """Generalised advantages and returns (n, P, E), float32, as SB3 computes them.

        J. Schulman et al., High-dimensional continuous control using generalized advantage estimation, 2016.
        """
        gamma = np.array([run.model.gamma for run in self.runs], dtype=np.float64)[:, None]
        row = (np.arange(len(self.runs)) * self.num_states)[:, None]
        visited = np.concatenate([rollout.pairs // self.num_actions, rollout.final_states[None]]) + row
        following, at = values.take(rollout.reached + row), values.take(visited)
        rewards = (rollout.rewards + gamma * rollout.truncated * following).astype(np.float32)
        goes_on = 1 - (rollout.terminated | rollout.truncated).astype(np.float32)
        advantages = rewards + gamma.astype(np.float32) * at[1:] * goes_on - at[:-1]
        carry = (gamma * gae_lambda[:, None]).astype(np.float32) * goes_on
        for step in range(self.n_steps - 2, -1, -1):
            advantages[step] += carry[step] * advantages[step + 1]
        return advantages, advantages + at[:-1]

    def _log_rollout(self, run: Run) -> None:
        model = run.model
        model._current_progress_remaining = 1 - self.num_timesteps / run.total_timesteps
        iteration, progress = self.num_timesteps // (self.n_steps * self.num_envs), self.progress(run)
        if "ent_coef" in run.falling:
            run.record("train/ent_coef", run.setting("ent_coef", progress))
        if iteration % run.log_interval == 0:
            model.dump_logs(iteration)
        run.record("train/learning_rate", run.setting("learning_rate", progress))

    def _log_update(self, advantages: Array, returns: Array) -> None:
        """Log the share of the returns' variance that the values explain, as SB3 does."""
        total = returns.var(axis=1)
        total[total == 0] = np.nan
        explained = (1 - advantages.var(axis=1) / total).tolist()
        for run in self.going():
            run.record("train/explained_variance", explained[run.row])
            run.record("train/n_updates", run.model._n_updates, for_tensorboard=False)


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


def log_softmax(logits: Array) -> Array:
    """log π (..., A) of logits (..., A)."""
    shifted: Array = logits - logits.max(axis=-1, keepdims=True)
    shifted -= np.log(np.exp(shifted).sum(axis=-1, keepdims=True))
    return shifted


def sum_up(pairs: IntArray, advantages: Array, returns: Array, shape: tuple[int, int]) -> Sums:
    """Sum up minibatches (..., B); pairs are state · A + action, the others float32, shape is (U, A)."""
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


def losses_and_slopes(
    new: tuple[Array, Array],
    old: tuple[Array, Array],
    sums: Sums,
    *,
    clip_range: FloatArray,
    ent_coef: FloatArray,
    vf_coef: FloatArray,
    clip_range_vf: FloatArray | None = None,
) -> tuple[dict[str, FloatArray], FloatArray, FloatArray]:
    """The numbers that SB3 logs, and the loss's slopes in the logits and in the values, see above.

    `new` and `old` are log π (P, U, A) and values (P, U), of those that learn and those that collected;
    settings are (P, 1, 1). Returns {name: (P,)}, (P, U, A) and (P, U). The divergence is http://joschu.net/blog/kl-approx.html.
    """
    (log_prob, values), clip, over = new, clip_range, (-2, -1)
    log_ratio = log_prob - old[0]
    ratio, prob = np.exp(log_ratio), np.exp(log_prob)
    low, high = (1 - clip).astype(np.float32), (1 + clip).astype(np.float32)  # as exact as the ratio
    slope = -ratio * (sums.positive * (ratio <= high) + sums.negative * (ratio >= low))
    slope += ent_coef * sums.states[..., None] * prob * (log_prob + 1)
    slope -= prob * slope.sum(axis=-1, keepdims=True)
    moves: Array = (2 * vf_coef[..., 0]).astype(np.float32)
    if clip_range_vf is not None:
        most, change = clip_range_vf[..., 0].astype(np.float32), values - old[1]
        values, moves = old[1] + np.clip(change, -most, most), moves * (abs(change) <= most)
    error = values - sums.mean_return
    gains = sums.positive * np.minimum(ratio, 1 + clip) + sums.negative * np.maximum(ratio, 1 - clip)
    policy = -gains.sum(axis=over)
    value = (sums.states * error**2).sum(axis=-1) + sums.deviation
    entropy = (sums.states * (prob * log_prob).sum(axis=-1)).sum(axis=-1)
    losses = {
        "loss": policy + ent_coef[:, 0, 0] * entropy + vf_coef[:, 0, 0] * value,
        "policy_gradient_loss": policy,
        "value_loss": value,
        "entropy_loss": entropy,
        "approx_kl": (sums.pairs * (ratio - 1 - log_ratio)).sum(axis=over),
        "clip_fraction": (sums.pairs * (abs(ratio - 1) > clip)).sum(axis=over),
    }
    return losses, slope, moves * (sums.states * error)
