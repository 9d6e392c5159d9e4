"""TRPO: J. Schulman et al., Trust Region Policy Optimization, 2015; as sb3-contrib has it.

All samples of one (state, action) share one ratio ρ = π_θ(a|s) / π_old(a|s). So with G(s, a) the sum of a
batch's B advantages per pair over B, and w_s the share of samples in state s,

    surrogate  = Σ_(s,a) G(s, a) ρ(s, a),            ∂/∂ log π(a|s) = G(s, a) ρ(s, a)
    divergence = Σ_s w_s KL(π_θ(.|s) || π_start(.|s))

and a slope g in log π is g - π Σ_a g in the logits z. The divergence's second derivative in the logits, where
θ is the start, is per state w_s (diag(π) - π π^T); with the logits' Jacobian J the Fisher matrix is

    F = J^T [w_s (diag(π) - π π^T)] J

(appendix C). So conjugate gradients multiply with it by a pass forward and a pass back through the network,
and the line search compares tables. The value network is fitted by an optimiser, the policy by the line
search alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from gridworld.engine.losses import Array, log_softmax, normalized
from gridworld.engine.networks import Networks
from gridworld.engine.on_policy import OnPolicy
from gridworld.engine.optimizer import Optimizer
from gridworld.engine.population import FEW_STATES, make_networks
from gridworld.engine.run import Run
from gridworld.storage.serialization import State
from gridworld.world.mdp import BoolArray, FloatArray, IntArray

_OF_VALUES = ("mlp_extractor.value_net.", "value_net.", "vf_features_extractor.")  # parameters of these alone
_RESIDUAL = 1e-10  # squared, at which conjugate gradients end


class TRPO(OnPolicy):
    """P runs of TRPO."""

    same: ClassVar[tuple[str, ...]] = (
        *OnPolicy.same,
        *("batch_size", "n_critic_updates", "sub_sampling_factor", "cg_max_steps", "cg_damping"),
        *("line_search_max_iter", "line_search_shrinking_factor"),
    )

    def __init__(self, runs: Sequence[Run], states: Sequence[State | None]) -> None:
        self.critic: Networks = make_networks(runs, value_parameters, slice(1, 2))
        super().__init__(runs, states)

    def _make_networks(self) -> Networks:
        """Of the policies."""
        return make_networks(self.runs, policy_parameters, slice(0, 1))

    def _optimizer(self) -> Optimizer:
        own = [run.model.policy.optimizer for run in self.runs]
        return Optimizer(own, self.critic.weights, self.critic.gradients, [math.inf] * len(own))

    def fitted(self, run: Run) -> Sequence[Tensor]:
        """See `Population.fitted`."""
        return value_parameters(run)

    def weights(self, run: Run) -> dict[str, tuple[Networks, Sequence[Tensor]]]:
        """See `Population.weights`."""
        values = self.critic, value_parameters(run)
        return {"weights": (self.networks, policy_parameters(run)), "value_weights": values}

    @property
    def outputs(self) -> tuple[Array, Array]:
        """See `OnPolicy.outputs`."""
        if self._outputs is None:
            self._outputs = self.networks.run()[0], self.critic.run()[0][..., 0]
        return self._outputs

    def update(self, old: tuple[Array, Array], pairs: IntArray, advantages: Array, returns: Array) -> None:
        """See `OnPolicy.update`."""
        active = self.active.copy()
        surrogate, kl, is_success = self._improve_policies(active, old[0], pairs, advantages)
        value_loss = self._fit_values(active, pairs // self.num_actions, returns)
        for run in self.going():
            run.model._n_updates += 1
            run.record("train/policy_objective", float(surrogate[run.row]))
            run.record("train/value_loss", float(value_loss[run.row]))
            run.record("train/kl_divergence_loss", float(kl[run.row]))
            run.record("train/is_line_search_success", float(is_success[run.row]))
        self.check_losses(value_loss)

    def _improve_policies(
        self, active: BoolArray, old: Array, pairs: IntArray, advantages: Array
    ) -> tuple[Array, Array, BoolArray]:
        """Make the policies' steps; returns surrogates, divergences and whether one was made, (P,) each."""
        (order,) = self._batches(active, pairs.shape[1], pairs.shape[1])
        part = order[:, :: self.runs[0].model.sub_sampling_factor]
        pairs, advantages = (np.take_along_axis(each, part, axis=1) for each in (pairs, advantages))
        if self.normalize_advantage:
            advantages = normalized(advantages)
        states = None
        if self.num_states > max(FEW_STATES, pairs.shape[1]):
            states, distinct = self.distinct(pairs[0])
            old, pairs = old[:, states], distinct[None]
        count, shape = pairs.shape[1], old.shape
        gains = _summed(pairs, advantages, shape[1] * shape[2]).reshape(shape) / count
        shares = _summed(pairs // self.num_actions, None, shape[1]) / count
        steps, start = self._steps(states, old, gains, shares)
        return self._search_lines(active, states, old, gains, shares, steps, start)

    def _steps(
        self, states: IntArray | None, old: Array, gains: FloatArray, shares: FloatArray
    ) -> tuple[Tensor, Array]:
        """The longest steps (P, W) along the natural gradients in the trust regions; log π at their start."""
        start = log_softmax(self.networks.run(states)[0])
        prob, damping = np.exp(start), self.runs[0].model.cg_damping

        def damped_fisher(vectors: Tensor) -> Tensor:
            (moved,) = self.networks.push(vectors)
            pulled = prob * (moved - (prob * moved).sum(axis=-1, keepdims=True))
            self.networks.backward(shares[..., None] * pulled)
            return self.networks.gradients.add(vectors, alpha=damping)

        slope = gains * np.exp(start - old)
        slope -= prob * slope.sum(axis=-1, keepdims=True)
        self.networks.backward(slope)
        gradients = self.networks.gradients.clone()
        guess = torch.zeros_like(gradients)
        for run in self.going():  # where a gradient is small, zeros would be an unstable beginning
            noise = torch.randn(gradients.shape[1], generator=run.torch_generator)
            guess[run.row] = 1e-4 * noise.to(guess.device)
        directions = conjugate_gradients(damped_fisher, gradients, guess, self.runs[0].model.cg_max_steps)
        curvature = _dots(directions, damped_fisher(directions)).double().cpu().numpy()
        radius = np.array([2 * run.model.target_kl for run in self.runs])
        with np.errstate(divide="ignore", invalid="ignore"):  # a gradient of 0, or one that diverges
            lengths = np.sqrt(radius / curvature)
        scales = torch.as_tensor(lengths, dtype=directions.dtype, device=directions.device)
        return directions * scales[:, None], start

    def _search_lines(
        self,
        active: BoolArray,
        states: IntArray | None,
        old: Array,
        gains: FloatArray,
        shares: FloatArray,
        steps: Tensor,
        start: Array,
    ) -> tuple[Array, Array, BoolArray]:
        """Shorten steps until they improve surrogates in the trust regions; see `_improve_policies`."""
        model, weights = self.runs[0].model, self.networks.weights
        target = np.array([run.model.target_kl for run in self.runs])
        before, surrogate = weights.clone(), _surrogate(start, old, gains)
        reached, kl, searching, scale = surrogate.copy(), np.zeros(len(target)), active.copy(), 1.0
        for _ in range(model.line_search_max_iter):
            rows = torch.as_tensor(np.flatnonzero(searching), device=weights.device)
            if not len(rows):
                break
            weights[rows] = before[rows] + scale * steps[rows]
            log_prob = log_softmax(self.networks.run(states)[0])
            for run in self.going(searching & ~np.isfinite(log_prob).all(axis=(1, 2))):
                run.diverge("the network's weights are no finite number")
                searching[run.row] = False
            found, now = _divergence(log_prob, start, shares), _surrogate(log_prob, old, gains)
            improved = searching & (found < target) & (now > surrogate)
            reached, kl = np.where(improved, now, reached), np.where(improved, found, kl)
            searching &= ~improved
            scale *= model.line_search_shrinking_factor
        rows = torch.as_tensor(np.flatnonzero(searching), device=weights.device)
        weights[rows] = before[rows]
        active &= self.active
        return reached, kl, active & ~searching

    def _fit_values(self, active: BoolArray, states: IntArray, returns: Array) -> Array:
        """Fit the value networks; returns the mean losses (P,)."""
        model, losses = self.runs[0].model, []
        learning_rates = self.settings("learning_rate")
        for _ in range(model.n_critic_updates):
            for batch in self._batches(active, states.shape[1], model.batch_size):
                index, which = np.take_along_axis(states, batch, axis=1), None
                if self.num_states > max(FEW_STATES, batch.shape[1]):
                    which, index = np.unique(index[0], return_inverse=True)
                    index = index[None]
                own = np.take_along_axis(returns, batch, axis=1)
                values = self.critic.run(which)[0][..., 0]
                samples = _summed(index, None, values.shape[1])
                mean = _summed(index, own, values.shape[1]) / np.maximum(samples, 1)
                error, count = values - mean, index.shape[1]
                pull = samples / count * error
                apart = own - np.take_along_axis(mean, index, axis=1)
                losses.append((pull * error).sum(axis=1) + (apart * apart).sum(axis=1) / count)
                self.critic.backward((2 * pull)[..., None])
                finite = self.optimizer.step(learning_rates, active)
                self.check_gradients(finite | ~active)
                active &= finite
        mean_loss: Array = np.stack(losses, axis=1).mean(axis=1)
        return mean_loss

    def _batches(self, active: BoolArray, count: int, size: int) -> Iterator[IntArray]:
        """All samples of each run in random order, cut into batches (P, B); the draws are SB3's own."""
        order = np.zeros((len(self.runs), count), dtype=np.int64)
        for run in self.going(active):
            order[run.row] = run.numpy_generator.permutation(count)
        for first in range(0, count, size):
            yield order[:, first : first + size]


def policy_parameters(run: Run) -> list[nn.Parameter]:
    """The parameters that the policy depends on."""
    named = run.model.policy.named_parameters()
    return [each for name, each in named if not name.startswith(_OF_VALUES)]


def value_parameters(run: Run) -> list[nn.Parameter]:
    """The parameters that only the values depend on."""
    named = run.model.policy.named_parameters()
    return [each for name, each in named if name.startswith(_OF_VALUES)]


def conjugate_gradients(
    product: Callable[[Tensor], Tensor], vectors: Tensor, guess: Tensor, steps: int
) -> Tensor:
    """Solve P linear systems A x = b.

    M. Hestenes and E. Stiefel, Methods of conjugate gradients for solving linear systems, 1952.

    Args:
        product: A x (P, W) of x (P, W).
        vectors: b (P, W).
        guess: (P, W), where to begin.
        steps: at most.
    """
    solution = guess.clone()
    residual = vectors - product(solution)
    direction, square = residual.clone(), _dots(residual, residual)
    going = square >= _RESIDUAL
    for step in range(steps):
        if not going.any():
            break
        product_ = product(direction)
        alpha = torch.where(going, square / _dots(direction, product_), 0)[:, None]
        solution += alpha * direction
        if step + 1 == steps:
            break
        residual -= alpha * product_
        new = _dots(residual, residual)
        going = going & (new >= _RESIDUAL)
        direction = torch.where(going[:, None], residual + (new / square)[:, None] * direction, direction)
        square = new
    return solution


def _dots(these: Tensor, those: Tensor) -> Tensor:
    """(P,), the products of rows, each as one alone is made."""
    return torch.stack([one @ other for one, other in zip(these, those, strict=True)])


def _summed(index: IntArray, numbers: Array | None, size: int) -> FloatArray:
    """(P, size), the sums of numbers (P, B), or their count, by their index (P, B)."""
    runs = len(index)
    keys = (index + size * np.arange(runs)[:, None]).ravel()
    weights = None if numbers is None else numbers.ravel()
    summed: FloatArray = np.bincount(keys, weights, size * runs).reshape(runs, size).astype(np.float64)
    return summed


def _surrogate(log_prob: Array, old: Array, gains: FloatArray) -> FloatArray:
    """(P,) of log π_θ and log π_old (P, U, A)."""
    return np.asarray((gains * np.exp(log_prob - old)).reshape(len(gains), -1).sum(axis=1))


def _divergence(log_prob: Array, start: Array, states: FloatArray) -> FloatArray:
    """(P,), the divergence of log π_θ from log π_start (P, U, A); `states` (P, U) has the shares w."""
    per_state = (np.exp(log_prob) * (log_prob - start)).sum(axis=-1)
    return np.asarray((states * per_state).sum(axis=-1))
