"""A2C with the network run once per state.

At the policy that it starts from, PPO's clipped surrogate has the slope of A2C's loss, -A log π(a|s): the
ratio is 1 there, and nothing is clipped. So an update is PPO's first one on the whole rollout.
S. Huang et al., A2C is a special case of PPO, 2022.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from stable_baselines3 import A2C

from gridworld.agents.sb3.tabulated.flat_optimizer import not_finite
from gridworld.agents.sb3.tabulated.losses.ppo import losses_and_slopes, sum_up
from gridworld.agents.sb3.tabulated.on_policy import (
    Rollouts,
    TabulatedOnPolicy,
    explained_variances,
    normalized,
    tables_of_runs,
    weights_of,
)
from gridworld.agents.sb3.tabulated.side_by_side import SideBySide, update_together
from gridworld.process.parallel.together import meet


class TabulatedA2C(TabulatedOnPolicy, A2C):
    """SB3's A2C on a `GridWorldVecEnv`, whose files stock `A2C.load` opens."""

    def train(self) -> None:
        """See SB3's `A2C.train`."""
        self._update_learning_rate(self.policy.optimizer)
        shape = (self.rollout_buffer.buffer_size, self.rollout_buffer.n_envs, self.normalize_advantage)
        meet(_train_together, _Run(self), (self.inputs.kind, shape))


@dataclass(frozen=True)
class _Run:
    """One of the models that are updated together."""

    model: TabulatedA2C


def _train_together(runs: Sequence[_Run]) -> list[Exception | None]:
    return update_together(_train, runs)


def _train(runs: Sequence[_Run]) -> list[Exception | None]:
    """Make the update of a rollout of each of P models; returns what is to be raised in each."""
    models = [run.model for run in runs]
    with SideBySide([model.descent for model in models]) as rows:
        batch = Rollouts(models, rows)
        advantages = normalized(batch.advantages) if models[0].normalize_advantage else batch.advantages
        which, states, pairs = batch.distinct(batch.states, batch.pairs)
        outputs = batch.outputs(which)
        new = tables_of_runs(*outputs)
        sums = sum_up(states, pairs, advantages, batch.returns, new.log_prob.shape)
        losses, *slopes = losses_and_slopes(new, new, sums, weights_of(models, [0.0] * len(models)))
        norms = [model.max_grad_norm for model in models]
        finite = rows.step(outputs, slopes, norms, range(len(models)))
    gains = (sums.positive + sums.negative) * new.log_prob
    policy_losses = (-gains).reshape(len(models), -1).sum(axis=1).tolist()
    numbers = zip(models, losses, policy_losses, explained_variances(models), finite, strict=True)
    for model, found, policy_loss, explained, is_finite in numbers:
        if is_finite:
            model._n_updates += 1
            model.log_update(explained)
            model.logger.record("train/entropy_loss", found.entropy_loss)
            model.logger.record("train/policy_loss", policy_loss)
            model.logger.record("train/value_loss", found.value_loss)
    return [None if is_finite else not_finite() for is_finite in finite]
