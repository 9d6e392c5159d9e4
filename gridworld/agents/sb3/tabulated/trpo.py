"""TRPO with the network run once per state.

The surrogate, the divergence and its curvature depend on the policy only through its table over states
(`tabulated.losses.trpo`). So conjugate gradients multiply with the Fisher matrix by two passes through the
network on the states that occur, and the line search compares tables.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from sb3_contrib import TRPO
from sb3_contrib.common.utils import conjugate_gradient_solver
from torch import Tensor

from gridworld.agents.sb3.tabulated.flat_optimizer import ENGINE, FlatOptimizer
from gridworld.agents.sb3.tabulated.losses import trpo as losses
from gridworld.agents.sb3.tabulated.losses.jacobian import Jacobian
from gridworld.agents.sb3.tabulated.losses.ppo import log_softmax
from gridworld.agents.sb3.tabulated.on_policy import (
    TabulatedOnPolicy,
    explained_variances,
    normalized,
)
from gridworld.agents.sb3.tabulated.state_buffers import Float32Array
from gridworld.world.mdp import FloatArray, IntArray


class TabulatedTRPO(TabulatedOnPolicy, TRPO):  # type: ignore[misc]
    """sb3-contrib's TRPO on a `GridWorldVecEnv`, whose files stock `TRPO.load` opens."""

    derived = (*TabulatedOnPolicy.derived, "_actor")
    learns_all_at_once = False

    def _make_descent(self) -> FlatOptimizer:
        """That of the value network; what the policy depends on is changed by the line search alone."""
        logits, values = self.outputs(np.zeros(1, dtype=np.int64))
        parameters = list(self.policy.parameters())
        of_policy, of_values = (_slopes(output, parameters) for output in (logits, values))
        triples = list(zip(parameters, of_policy, of_values, strict=True))
        self._actor = [parameter for parameter, slope, _ in triples if slope is not None]
        fitted = [p for p, policy, value in triples if policy is None and value is not None]
        return FlatOptimizer(self.policy.optimizer, fitted)

    def train(self) -> None:
        """See sb3-contrib's `TRPO.train`."""
        self._update_learning_rate(self.policy.optimizer)
        states, actions, advantages, returns = self.samples()
        surrogate, divergence, is_success = self._improve_policy(states, actions, advantages)
        value_losses = self._fit_values(states, returns)
        self._n_updates += 1
        self.logger.record("train/policy_objective", surrogate)
        self.logger.record("train/value_loss", np.mean(value_losses))
        self.logger.record("train/kl_divergence_loss", divergence)
        self.logger.record("train/is_line_search_success", float(is_success))
        self.log_update(*explained_variances([self]))

    def _improve_policy(
        self, states: IntArray, actions: IntArray, advantages: Float32Array
    ) -> tuple[float, float, bool]:
        """Make the policy's step; return the surrogate, the divergence, and whether the step was made."""
        (order,) = _minibatches(len(states), len(states))
        part = order[:: self.sub_sampling_factor]
        which, index = self.inputs.distinct(states[part])
        weighed = normalized(advantages[part]) if self.normalize_advantage else advantages[part]
        old = self.old.log_prob if which is None else self.old.log_prob[which]
        gains, shares = losses.sum_up(index, actions[part], weighed, old.shape)
        step, start = self._step(which, old, gains, shares)
        surrogate = float(losses.surrogate(start, old, gains))
        before = torch.cat([parameter.detach().reshape(-1) for parameter in self._actor])
        scale = 1.0
        for _ in range(self.line_search_max_iter):
            self._put(before + scale * step)
            with torch.no_grad():
                log_prob = log_softmax(self.outputs(which)[0].cpu().numpy())
            if not np.isfinite(log_prob).all():
                raise FloatingPointError("the network's weights are no finite number")
            divergence = float(losses.divergence(log_prob, start, shares))
            reached = float(losses.surrogate(log_prob, old, gains))
            if divergence < self.target_kl and reached > surrogate:
                return reached, divergence, True
            scale *= self.line_search_shrinking_factor
        self._put(before)
        return surrogate, 0.0, False

    def _step(
        self, which: IntArray | None, old: Float32Array, gains: FloatArray, shares: FloatArray
    ) -> tuple[Tensor, Float32Array]:
        """The longest step along the natural gradient in the trust region; log π (U, A) where it starts."""
        logits, _ = self.outputs(which)
        start = log_softmax(logits.detach().cpu().numpy())
        prob, jacobian = np.exp(start), Jacobian(logits, self._actor)

        def damped_fisher(vector: Tensor) -> Tensor:
            curved = losses.curved(prob, shares, jacobian.push(vector))
            return jacobian.pull(curved).add(vector, alpha=self.cg_damping)

        gradient = jacobian.pull(losses.surrogate_slope(start, old, gains))
        direction: Tensor = conjugate_gradient_solver(damped_fisher, gradient, max_iter=self.cg_max_steps)
        squared = 2 * self.target_kl / float(direction @ damped_fisher(direction))
        return direction.mul(np.sqrt(squared)), start

    def _put(self, vector: Tensor) -> None:
        """Set the policy's parameters."""
        parts = torch.split(vector, [parameter.numel() for parameter in self._actor])
        with torch.no_grad():
            for parameter, part in zip(self._actor, parts, strict=True):
                parameter.copy_(part.view_as(parameter))

    def _fit_values(self, states: IntArray, returns: Float32Array) -> list[float]:
        """Fit the value network; return the losses."""
        fitted = []
        for _ in range(self.n_critic_updates):
            for batch in _minibatches(len(states), self.batch_size):
                which, index = self.inputs.distinct(states[batch])
                _, values = self.outputs(which)
                sums = losses.value_sums(index, returns[batch], len(values))
                loss, slope = losses.value_loss_and_slope(values.detach().cpu().numpy()[:, 0], *sums)
                fitted.append(float(loss))
                self.descent.step([values], [slope], math.inf)
        return fitted


def _minibatches(count: int, batch_size: int) -> list[IntArray]:
    """All samples in random order, cut into batches; the draw is SB3's own."""
    order = np.random.permutation(count)
    return [order[start : start + batch_size] for start in range(0, count, batch_size)]


def _slopes(output: Tensor, parameters: Sequence[Tensor]) -> Any:
    """The slopes of an output's sum in each parameter; None: it does not depend on it."""
    return ENGINE.run_backward(
        *((output,), (torch.ones_like(output),), True, False, tuple(parameters)),
        allow_unreachable=True,
        accumulate_grad=False,
    )
