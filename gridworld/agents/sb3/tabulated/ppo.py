"""PPO with the network run once per state.

In an update, a minibatch's loss depends on the network only through its outputs at the states, and has its
slopes there in closed form (`tabulated.losses.ppo`); from there they go back through the network once.
`tabulated.state_inputs` says why that is the gradient of the whole batch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np
from stable_baselines3 import PPO

from gridworld.agents.sb3.tabulated.flat_optimizer import not_finite
from gridworld.agents.sb3.tabulated.losses.ppo import Losses, Outputs, Sums, losses_and_slopes, sum_up
from gridworld.agents.sb3.tabulated.on_policy import (
    Rollouts,
    TabulatedOnPolicy,
    explained_variances,
    normalized,
    tables_of_runs,
    weights_of,
)
from gridworld.agents.sb3.tabulated.side_by_side import SideBySide, update_together
from gridworld.process.parallel.together import chance, meet
from gridworld.world.mdp import FloatArray, IntArray


class TabulatedPPO(TabulatedOnPolicy, PPO):
    """SB3's PPO on a `GridWorldVecEnv`, whose files stock `PPO.load` opens."""

    def train(self) -> None:
        """See SB3's `PPO.train`."""
        self._update_learning_rate(self.policy.optimizer)
        buffer = self.rollout_buffer
        shape = (buffer.buffer_size, buffer.n_envs, self.batch_size, self.normalize_advantage)
        meet(_train_together, _Run(self, chance()), (self.inputs.kind, shape, self.clip_range_vf is None))

    def clip_ranges(self) -> tuple[float, float | None]:
        """Of the ratio and, if it is clipped, of the value, at this time of training."""
        progress = self._current_progress_remaining
        clip_range, clip_range_vf = cast(Any, self.clip_range), cast(Any, self.clip_range_vf)
        return clip_range(progress), None if clip_range_vf is None else clip_range_vf(progress)

    def log_epochs(self, epochs: int, logged: list[Losses], last_epoch: int, explained: float) -> None:
        """Log an update's losses; SB3 has the divergence of the last epoch and the last minibatch's loss."""
        self._n_updates += epochs
        means = Losses(*np.mean(logged, axis=0).tolist())._asdict()
        means["approx_kl"] = float(np.mean([losses.approx_kl for losses in logged[last_epoch:]]))
        means["loss"] = logged[-1].loss
        for name, mean in means.items():
            self.logger.record(f"train/{name}", mean)
        self.log_update(explained)
        clip_range, clip_range_vf = self.clip_ranges()
        self.logger.record("train/clip_range", clip_range)
        if clip_range_vf is not None:
            self.logger.record("train/clip_range_vf", clip_range_vf)


def _train_together(runs: Sequence[_Run]) -> list[Exception | None]:
    return update_together(_train, runs)


def _train(runs: Sequence[_Run]) -> list[Exception | None]:
    """Make the updates of a rollout of each of P models; returns what is to be raised in each."""
    with SideBySide([run.model.descent for run in runs]) as rows:
        update = _Update(runs, rows)
        for epoch in range(max(run.model.n_epochs for run in runs)):
            update.make_epoch(epoch)
    for run, explained in zip(runs, explained_variances([run.model for run in runs]), strict=True):
        if run.error is None:
            run.model.log_epochs(run.epochs, run.logged, run.last_epoch, explained)
    return [run.error for run in runs]


@dataclass
class _Run:
    """One of the models that are updated together."""

    model: TabulatedPPO
    chance: np.random.RandomState  # that its minibatches are drawn with
    logged: list[Losses] = field(default_factory=list)
    last_epoch: int = 0  # where in `logged` it begins
    epochs: int = 0
    error: Exception | None = None


class _Update:
    """The updates that P models make of their rollouts.

    Args:
        runs: of models of one kind, with rollouts of one size.
        rows: their optimisers.
    """

    def __init__(self, runs: Sequence[_Run], rows: SideBySide) -> None:
        self._runs, self._rows = runs, rows
        self._models = [run.model for run in runs]
        self._batch = Rollouts(self._models, rows)
        self._going = np.arange(len(runs))  # those that have not ended their epochs
        self._all_going = True
        self._whole: tuple[IntArray | None, Sums] | None = None  # of a minibatch that is the whole rollout
        self._old = Outputs(*map(np.stack, zip(*(model.old for model in self._models), strict=True)))
        clip_ranges, of_values = zip(*(model.clip_ranges() for model in self._models), strict=True)
        self._weights = weights_of(self._models, clip_ranges, None if of_values[0] is None else of_values)
        self._norms = [model.max_grad_norm for model in self._models]

    def make_epoch(self, epoch: int) -> None:
        """Make the steps of an epoch; the order of samples is SB3's own draw."""
        self._end([self._models[run].n_epochs > epoch for run in self._going])
        going: list[int] = self._going.tolist()
        for run in going:
            self._runs[run].last_epoch = len(self._runs[run].logged)
            self._runs[run].epochs += 1
        count, size = self._batch.states.shape[1], self._models[0].batch_size
        if size >= count:  # whatever their order
            if len(self._going):
                self._whole = self._whole or self._summed_up(np.tile(np.arange(count), (len(self._going), 1)))
                self._make_step(*self._whole)
            return
        order = np.zeros((len(self._runs), count), dtype=np.int64)
        for run in going:
            order[run] = self._runs[run].chance.permutation(count)
        for start in range(0, count, size):
            if len(self._going):
                self._make_step(*self._summed_up(order[self._going, start : start + size]))

    def _summed_up(self, batch: IntArray) -> tuple[IntArray | None, Sums]:
        """Find the states to run the network on, None for all, and the sums there.

        Args:
            batch: (R, B), samples of those R runs that go on.
        """
        taken = batch + self._going[:, None] * self._batch.states.shape[1]
        states, pairs, advantages, returns = (
            getattr(self._batch, name).take(taken) for name in ("states", "pairs", "advantages", "returns")
        )
        if self._models[0].normalize_advantage and batch.shape[1] > 1:
            advantages = normalized(advantages)
        which, states, pairs = self._batch.distinct(states, pairs)
        num_runs, num_states, num_actions = self._old.log_prob.shape
        shape = num_runs, num_states if which is None else len(which), num_actions
        return which, sum_up(states, pairs, advantages, returns, shape)

    def _make_step(self, which: IntArray | None, sums: Sums) -> None:
        """Make a step of those runs that go on; see `_summed_up`."""
        old = self._old if which is None else Outputs(*(table[:, which] for table in self._old))
        outputs = self._batch.outputs(which)
        new, weights = tables_of_runs(*outputs), self._weights
        if not self._all_going:
            new, old = new.of(self._going), old.of(self._going)
            sums, weights = sums.of(self._going), weights.of(self._going)
        losses, *slopes = losses_and_slopes(new, old, sums, weights)
        goes_on = [self._takes(run, found) for run, found in zip(self._going.tolist(), losses, strict=True)]
        slopes = [slope[goes_on] if not all(goes_on) else slope for slope in slopes]
        self._end(goes_on)
        if len(self._going):
            whole = [self._of_all(slope) for slope in slopes]
            finite = self._rows.step(outputs, whole, self._norms, self._going.tolist())
            for run, is_finite in zip(self._going.tolist(), finite, strict=True):
                self._runs[run].error = None if is_finite else not_finite()
            self._end(finite)

    def _takes(self, run: int, losses: Losses) -> bool:
        """Note a step's losses; returns whether the step is to be made."""
        self._runs[run].logged.append(losses)
        target_kl = self._models[run].target_kl
        return target_kl is None or losses.approx_kl <= 1.5 * target_kl

    def _end(self, goes_on: list[bool]) -> None:
        if not all(goes_on):
            self._going, self._all_going = self._going[goes_on], False
            self._whole = None

    def _of_all(self, slopes: FloatArray) -> FloatArray:
        """Slopes of those that go on, and 0 for the others."""
        if self._all_going:
            return slopes
        whole = np.zeros((len(self._runs), *slopes.shape[1:]))
        whole[self._going] = slopes
        return whole
