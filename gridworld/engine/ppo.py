"""PPO: J. Schulman et al., Proximal Policy Optimization Algorithms, 2017; as Stable-Baselines3 has it."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Sequence

import numpy as np

from gridworld.base.serialization import State
from gridworld.engine.networks import Array
from gridworld.engine.on_policy import OnPolicy, Sums, log_softmax, losses_and_slopes
from gridworld.engine.population import Run
from gridworld.world.mdp import BoolArray, IntArray


class PPO(OnPolicy):
    def __init__(self, runs: Sequence[Run], states: Sequence[State | None]) -> None:
        super().__init__(runs, states)
        model = runs[0].model
        self.batch_size, self.n_epochs = model.batch_size, model.n_epochs
        self.clips_values = model.clip_range_vf is not None
        limits = [np.inf if run.model.target_kl is None else 1.5 * run.model.target_kl for run in runs]
        self.most_divergence = np.array(limits) if min(limits) < np.inf else None

    @classmethod
    def kind(cls, run: Run) -> Hashable:
        """See `Population.kind`; of a range that is None, nothing is clipped."""
        return super().kind(run), run.model.clip_range_vf is None

    def update(self, old: tuple[Array, Array], pairs: IntArray, advantages: Array, returns: Array) -> None:
        names = ["clip_range", "clip_range_vf"] if self.clips_values else ["clip_range"]
        settings = {name: self.column(name) for name in (*names, "ent_coef", "vf_coef")}
        learning_rates = self.settings("learning_rate")
        active, whole = self.active.copy(), None  # those that have not ended their epochs
        log = _Log(len(self.runs))
        for _ in range(self.n_epochs):
            if not active.any():
                break
            log.epochs += active
            if self.batch_size >= pairs.shape[1]:  # whatever their order
                whole = whole or list(self.summed_up(pairs[:, None], advantages[:, None], returns[:, None]))
                minibatches: Iterator[tuple[IntArray | None, Sums]] = iter(whole)
            else:
                minibatches = self._minibatches(active, pairs, advantages, returns)
            for states, sums in minibatches:
                logits, values = self.networks.run(states)
                new = log_softmax(logits), values[..., 0]
                before = old if states is None else (old[0][:, states], old[1][:, states])
                losses, of_logits, of_values = losses_and_slopes(new, before, sums, **settings)
                log.add(active, losses)
                if self.most_divergence is not None:
                    active &= losses["approx_kl"] <= self.most_divergence
                self.networks.backward(of_logits, of_values[..., None])
                finite = self.optimizer.step(learning_rates, active)
                self.check(finite | ~active, "the gradient")
                active &= finite
        means = log.means()
        means |= {name: settings[name][:, 0, 0] for name in names}
        for run in self.going():
            run.model._n_updates += int(log.epochs[run.row])
            for name, mean in means.items():
                run.record(f"train/{name}", float(mean[run.row]))
        self.check(np.isfinite(means["loss"]), "a loss")

    def _minibatches(self, active: BoolArray, *samples: Array) -> Iterator[tuple[IntArray | None, Sums]]:
        """Cut samples (P, n), in SB3's own draw of their order, and the last minibatch of what is left."""
        runs, count = samples[0].shape
        order = np.zeros((runs, count), dtype=np.int64)
        for run in self.going(active):
            order[run.row] = run.numpy_generator.permutation(count)
        order += count * np.arange(runs)[:, None]  # places among the samples of all runs
        full = count // self.batch_size * self.batch_size
        parts = [order[:, :full].reshape(runs, -1, self.batch_size), order[:, None, full:]]
        for part in parts[:1] if full == count else parts:
            yield from self.summed_up(*(each.take(part) for each in samples))


class _Log:
    """The losses of an update, of which SB3 logs the means."""

    def __init__(self, runs: int) -> None:
        self.epochs = np.zeros(runs, dtype=np.int64)  # that each run began
        self._losses: list[dict[str, Array]] = []
        self._epoch: list[Array] = []  # of each step, that of each run; 0 where it had ended

    def add(self, active: BoolArray, losses: dict[str, Array]) -> None:
        self._losses.append(losses)
        self._epoch.append(np.where(active, self.epochs, 0))

    def means(self) -> dict[str, Array]:
        """(P,) each; SB3 has the divergence of the last epoch, and the loss of the last minibatch."""
        epoch = np.stack(self._epoch, axis=1)
        last = epoch == epoch.max(axis=1, keepdims=True)
        steps = (epoch > 0).sum(axis=1)  # of each run, its first ones
        found = {}
        for name in self._losses[0]:
            losses, means = np.stack([each[name] for each in self._losses], axis=1), np.zeros(len(steps))
            for count in np.unique(steps):  # apart, since how numpy adds up depends on how many there are
                rows, own = steps == count, slice(count)
                chosen = last[rows, own] if name == "approx_kl" else np.ones_like(last[rows, own])
                if name == "loss":
                    chosen[:, :-1] = False
                added = np.where(chosen, losses[rows, own], 0).sum(axis=1)
                means[rows] = added / np.maximum(chosen.sum(axis=1), 1)
            found[name] = means
        return found
