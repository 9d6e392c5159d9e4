"""TRPO: J. Schulman et al., Trust Region Policy Optimization, 2015; as sb3-contrib has it.

All samples of one (state, action) share one ratio ρ = π_θ(a|s) / π_old(a|s). So with G(s, a) the sum of a
batch's B advantages per pair over B, and w_s the share of samples in state s,

    surrogate  = Σ_(s,a) G(s, a) ρ(s, a),            ∂/∂ log π(a|s) = G(s, a) ρ(s, a)
    divergence = Σ_s w_s KL(π_θ(·|s) || π_start(·|s))

and a slope g in log π is g - π Σ_a g in the logits z. The policy takes a step d that improves the surrogate
while the divergence, which is ½ dᵀFd to second order, stays below δ: along the natural gradient F⁻¹∇, which
conjugate gradients find from products with F alone, and as far as √(2δ / dᵀFd), or less where a line search
finds that too far. The divergence's second derivative in the logits, where θ is the start, is per state
w_s (diag(π) - π πᵀ); so with the logits' Jacobian J a product with the Fisher matrix

    F v = Jᵀ [ w_s (diag(π) - π πᵀ) ] J v

(appendix C) is a pass forward and a pass back through the network. The values are fitted by an optimiser, to
the returns' mean m_s of each state: of B samples the squared error is Σ_s w_s (V(s) - m_s)², and a constant.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from gridworld.engine.networks import Array, Networks, aligned, make_networks
from gridworld.engine.on_policy import OnPolicy, Sums, log_softmax
from gridworld.engine.optimizer import Optimizer
from gridworld.engine.population import Run, diverged
from gridworld.world.mdp import BoolArray, FloatArray, IntArray

_OF_VALUES = ("mlp_extractor.value_net.", "value_net.", "vf_features_extractor.")  # parameters of these alone
_RESIDUAL = 1e-10  # squared, below which conjugate gradients end


class TRPO(OnPolicy):
    pushes: ClassVar[bool] = True

    @classmethod
    def networks_of(cls, runs: Sequence[Run]) -> list[Networks]:
        """See `Population.networks_of`: those of the policies, and those of the values."""
        actors = [run.network.part(slice(0, 1), policy_parameters(run)) for run in runs]
        critics = [run.network.part(slice(1, 2), value_parameters(run)) for run in runs]
        return [make_networks(actors), make_networks(critics)]

    def _optimizer(self) -> Optimizer:
        self.critic = self.all_networks[1]  # the networks of the values
        own = [run.model.policy.optimizer for run in self.runs]
        return Optimizer(own, self.critic.weights, self.critic.gradients, [math.inf] * len(own))

    def fitted(self, run: Run) -> Sequence[Tensor]:
        return value_parameters(run)

    def weights(self, run: Run) -> dict[str, tuple[Networks, Sequence[Tensor]]]:
        values = self.critic, value_parameters(run)
        return {"weights": (self.networks, policy_parameters(run)), "value_weights": values}

    @property
    def outputs(self) -> tuple[Array, Array]:
        if self._outputs is None:
            self._outputs = self.networks.run()[0], self.critic.run()[0][..., 0]
        return self._outputs

    def update(self, old: tuple[Array, Array], pairs: IntArray, advantages: Array, returns: Array) -> None:
        samples = pairs, advantages, returns
        order = self.orders(pairs.shape[1], self.active)
        part = order[:, None, :: self.runs[0].model.sub_sampling_factor]
        ((states, sums),) = self.summed_up(*(each.take(part) for each in samples))
        collected = old[0] if states is None else old[0][:, states]
        start = log_softmax(self.networks.run(states)[0])
        steps = self._longest_steps(start, collected, sums)
        surrogate, divergence, is_improved = self._search_lines(states, start, collected, sums, steps)
        value_loss = self._fit_values(*samples)
        for run in self.going():
            run.model._n_updates += 1
            run.record("train/policy_objective", float(surrogate[run.row]))
            run.record("train/value_loss", float(value_loss[run.row]))
            run.record("train/kl_divergence_loss", float(divergence[run.row]))
            run.record("train/is_line_search_success", float(is_improved[run.row]))
        self.check(np.isfinite(value_loss), "a loss")

    def _longest_steps(self, start: Array, old: Array, sums: Sums) -> Tensor:
        """(P, W), along the natural gradients to the borders of the trust regions, to second order."""
        networks, prob, damping = self.networks, np.exp(start), self.runs[0].model.cg_damping

        def damped_fisher(vectors: Tensor) -> Tensor:
            (moved,) = networks.push(vectors)
            curved = prob * (moved - (prob * moved).sum(axis=-1, keepdims=True))
            networks.backward(sums.states[..., None] * curved)
            return networks.gradients.add_(vectors, alpha=damping)

        slope = (sums.positive + sums.negative) * np.exp(start - old)
        slope -= prob * slope.sum(axis=-1, keepdims=True)
        networks.backward(slope)
        guess = torch.zeros_like(networks.weights)
        for run in self.going():  # sb3-contrib's, so that the first product is not with 0
            noise = torch.randn(guess.shape[1], generator=run.torch_generator)
            guess[run.row] = 1e-4 * noise.to(guess.device)
        steps = self.runs[0].model.cg_max_steps
        directions = conjugate_gradients(damped_fisher, networks.gradients, guess, steps)
        curvature = _dots(directions, damped_fisher(directions)).double().cpu().numpy()
        with np.errstate(divide="ignore", invalid="ignore"):  # a run that diverges
            lengths = np.sqrt(2 * np.array([run.model.target_kl for run in self.runs]) / curvature)
        return directions.mul_(torch.as_tensor(lengths[:, None]).to(directions))

    def _search_lines(
        self, states: IntArray | None, start: Array, old: Array, sums: Sums, steps: Tensor
    ) -> tuple[Array, Array, BoolArray]:
        """Shorten steps until they improve surrogates in the trust regions.

        Returns surrogates, divergences and whether a step was made, (P,) each.
        """
        weights, gains = self.networks.weights, sums.positive + sums.negative
        before, surrogate = weights.clone(), _surrogate(start, old, gains)
        target = np.array([run.model.target_kl for run in self.runs])
        shrinking = np.array([run.model.line_search_shrinking_factor for run in self.runs])
        scale, searching = np.ones(len(target)), self.active.copy()
        reached, divergence = surrogate.copy(), np.zeros(len(target))

        def step(scale: FloatArray) -> None:
            """Set the weights of the runs that still search."""
            rows = torch.as_tensor(np.flatnonzero(searching), device=weights.device)
            column = torch.as_tensor(scale[:, None]).to(weights)
            weights[rows] = before[rows] + column[rows] * steps[rows]

        for _ in range(self.runs[0].model.line_search_max_iter):
            if not searching.any():
                break
            step(scale)
            log_prob = log_softmax(self.networks.run(states)[0])
            for run in self.going(searching & ~np.isfinite(log_prob).all(axis=(1, 2))):
                run.fail(diverged(run.model, "a weight"))
            searching &= self.active
            now, far = _surrogate(log_prob, old, gains), _divergence(log_prob, start, sums.states)
            improved = searching & (far < target) & (now > surrogate)
            reached, divergence = np.where(improved, now, reached), np.where(improved, far, divergence)
            searching &= ~improved
            scale *= shrinking
        step(np.zeros(len(target)))
        return reached, divergence, ~searching

    def _fit_values(self, *samples: Array) -> Array:
        """Fit the value networks; returns the mean losses (P,)."""
        model, count, losses = self.runs[0].model, samples[0].shape[1], []
        learning_rates, whole = self.settings("learning_rate"), None
        if model.batch_size >= count:  # whatever their order
            whole = list(self.summed_up(*(each[:, None] for each in samples)))
        for _ in range(model.n_critic_updates):
            order = self.orders(count, self.active)
            for states, sums in whole or self.minibatches(order, model.batch_size, *samples):
                error = self.critic.run(states)[0][..., 0] - sums.mean_return
                pull = sums.states * error
                losses.append((pull * error).sum(axis=-1) + sums.deviation)
                self.critic.backward(2 * pull[..., None])
                self.check(self.optimizer.step(learning_rates, self.active), "the gradient")
        return np.asarray(np.stack(losses, axis=1).mean(axis=1))


def policy_parameters(run: Run) -> list[nn.Parameter]:
    named = run.model.policy.named_parameters()
    return [each for name, each in named if not name.startswith(_OF_VALUES)]


def value_parameters(run: Run) -> list[nn.Parameter]:
    named = run.model.policy.named_parameters()
    return [each for name, each in named if name.startswith(_OF_VALUES)]


def conjugate_gradients(
    product: Callable[[Tensor], Tensor], vectors: Tensor, guess: Tensor, steps: int
) -> Tensor:
    """Solve P linear systems A x = b (P, W), those of sb3-contrib's solver side by side, from a guess.

    A product A x has `aligned` rows, and may overwrite the one before and b.
    M. Hestenes and E. Stiefel, Methods of conjugate gradients for solving linear systems, 1952.
    """
    vectors, solution = aligned(vectors), aligned(guess)
    residual = aligned(vectors - product(solution))
    direction, square = aligned(residual), _dots(residual, residual)
    going = square >= _RESIDUAL
    for step in range(steps):
        if not going.any():
            break
        image = product(direction)
        alpha = torch.where(going, square / _dots(direction, image), 0)[:, None]
        solution += alpha * direction
        if step + 1 == steps:
            break
        residual -= alpha * image
        new = _dots(residual, residual)
        going = going & (new >= _RESIDUAL)
        direction.mul_(torch.where(going, new / square, 0)[:, None]).add_(residual)
        square = new
    return solution


def _dots(these: Tensor, those: Tensor) -> Tensor:
    """(P,), the products of `aligned` rows, each as one alone is made."""
    return torch.stack([one @ other for one, other in zip(these, those, strict=True)])


def _surrogate(log_prob: Array, old: Array, gains: FloatArray) -> FloatArray:
    """(P,), of log π_θ and log π_old (P, U, A)."""
    return np.asarray((gains * np.exp(log_prob - old)).reshape(len(gains), -1).sum(axis=1))


def _divergence(log_prob: Array, start: Array, shares: FloatArray) -> FloatArray:
    """(P,), of log π_θ from log π_start (P, U, A), with the shares w (P, U) of the states."""
    return np.asarray((shares * (np.exp(log_prob) * (log_prob - start)).sum(axis=-1)).sum(axis=-1))
