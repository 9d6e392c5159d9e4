"""What PPO, A2C and TRPO share: tables of the policies, rollouts by look-ups, generalised advantages."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import ClassVar

import numpy as np
import torch

from gridworld.engine.environments import Rollout
from gridworld.engine.losses import Array, Sums, log_softmax, normalized, sum_up
from gridworld.engine.population import FEW_STATES, Population
from gridworld.engine.run import Run
from gridworld.storage.serialization import State
from gridworld.world.mdp import BoolArray, FloatArray, IntArray


class OnPolicy(Population):
    """Actor-critics that alternate between a rollout of `n_steps` steps and an update on it."""

    same: ClassVar[tuple[str, ...]] = ("n_steps", "normalize_advantage")

    def __init__(self, runs: Sequence[Run], states: Sequence[State | None]) -> None:
        self._outputs: tuple[Array, Array] | None = None  # of the networks as they are
        super().__init__(runs, states)
        self.n_steps: int = runs[0].model.n_steps
        self.normalize_advantage: bool = runs[0].model.normalize_advantage

    @property
    def outputs(self) -> tuple[Array, Array]:
        """Logits (P, S, A) and values (P, S) of all states."""
        if self._outputs is None:
            logits, values = self.networks.run()
            self._outputs = logits, values[..., 0]
        return self._outputs

    def log_policy(self) -> tuple[Array, Array]:
        """log π (P, S, A) and values (P, S) of all states."""
        logits, values = self.outputs
        return log_softmax(logits), values

    def snapshot(self, run: Run) -> tuple[FloatArray, FloatArray | None, FloatArray | None]:
        """See `Population.snapshot`."""
        logits, values = self.outputs
        probabilities = torch.as_tensor(logits[run.row]).softmax(dim=-1).numpy()
        return values[run.row].astype(np.float64), probabilities.astype(np.float64), None

    def iterate(self) -> None:
        """See `Population.iterate`: a rollout, and an update by it."""
        gae_lambda = self.settings("gae_lambda")
        for run, value in zip(self.runs, gae_lambda, strict=True):
            if "gae_lambda" in run.falling:
                run.record("train/gae_lambda", value)
        old = self.log_policy()
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
        samples = [_by_run(each) for each in (rollout.pairs, advantages, returns)]
        self._outputs = None
        self.update(old, *samples)
        self._log_update(samples[1], samples[2])

    def update(self, old: tuple[Array, Array], pairs: IntArray, advantages: Array, returns: Array) -> None:
        """Update the networks.

        Args:
            old: log π (P, S, A) and values (P, S) of the policies that collected the samples.
            pairs: (P, n), state · A + action of each sample, environment by environment as SB3 has them.
            advantages: (P, n), float32.
            returns: (P, n), float32.
        """
        raise NotImplementedError

    def orders(self, count: int, active: BoolArray) -> IntArray:
        """(P, n), the places of each run's n samples among all, in SB3's own draw of their order."""
        order = np.zeros((len(self.runs), count), dtype=np.int64)
        for run in self.going(active):
            order[run.row] = run.numpy_generator.permutation(count)
        return order + count * np.arange(len(self.runs))[:, None]

    def minibatches(
        self, order: IntArray, size: int, *samples: Array
    ) -> Iterator[tuple[IntArray | None, Sums]]:
        """Cut samples (P, n) in this order into minibatches of a size, and the last of what is left."""
        runs, count = order.shape
        full = count // size * size
        parts = [order[:, :full].reshape(runs, -1, size), order[:, None, full:]]
        for part in parts[:1] if full == count else parts:
            yield from self.summed_up(*(each.take(part) for each in samples))

    def summed_up(
        self, pairs: IntArray, advantages: Array, returns: Array
    ) -> Iterator[tuple[IntArray | None, Sums]]:
        """The states to run the network on, None for all, and the sums there, of K minibatches (P, K, B)."""
        if self.normalize_advantage and pairs.shape[-1] > 1:
            advantages = normalized(advantages)
        if self.num_states <= max(FEW_STATES, pairs.shape[-1]):
            sums = sum_up(pairs, advantages, returns, (self.num_states, self.num_actions))
            yield from ((None, sums.of(number)) for number in range(pairs.shape[1]))
            return
        for number in range(pairs.shape[1]):
            which, pair = self.distinct(pairs[0, number])
            yield (
                which,
                sum_up(pair[None], advantages[:, number], returns[:, number], (len(which), self.num_actions)),
            )

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
        following, at = values.take(rollout.last_states + row), values.take(visited)
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


def _by_run(table: Array) -> Array:
    """(n, P, E) as (P, E · n), in SB3's order."""
    runs = table.transpose(1, 2, 0)
    return np.ascontiguousarray(runs).reshape(len(runs), -1)
