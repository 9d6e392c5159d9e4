"""DQN: V. Mnih et al., Human-level control through deep reinforcement learning, 2015; as SB3 has it.

The loss of a minibatch, the mean Huber distance of Q(s_i, a_i) to its target y_i, touches the network only
through the table Q, and there its slope is a sum over samples:

    ∂L/∂Q(s, a) = 1/B Σ_(i: s_i = s, a_i = a) clip(Q(s, a) - y_i, -1, 1)

Of a replay that counts transitions, the sum is over distinct ones, times their share of the minibatch.
Greedy actions and targets are look-ups in tables, which are made anew when a network has changed.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence

import numpy as np
import torch
from stable_baselines3.common.type_aliases import TrainFrequencyUnit

from gridworld.base.serialization import State
from gridworld.engine.networks import Array, Networks, make_networks
from gridworld.engine.population import FEW_STATES, Population, Run
from gridworld.engine.replay import CountedReplay, Replay, Transitions, UniformReplay
from gridworld.envs.vector_env import Step
from gridworld.world.mdp import FloatArray, IntArray

_DRAWN_AT_ONCE = 2**13  # transitions of a run


class DQN(Population):
    def __init__(self, runs: Sequence[Run], states: Sequence[State | None]) -> None:
        self._outputs: Array | None = None  # of the networks as they are, of all states
        self._greedy: IntArray | None = None  # (P, S), by these
        self._best: Array | None = None  # (P, S), what the target networks say of each state's best action
        targets = [run.target for run in runs if run.target is not None]
        self.target = make_networks(targets, runs[0].met)
        model, envs = runs[0].model, runs[0].envs
        self.replay: Replay = (
            CountedReplay(len(runs), envs.mdp.num_states, envs.mdp.num_actions)
            if runs[0].counts_transitions
            else UniformReplay(len(runs), model.buffer_size, envs.num_envs, envs.mdp.num_states)
        )
        self.batch_size, self.train_freq = model.batch_size, model.train_freq
        self.learning_starts, self.gradient_steps = model.learning_starts, model.gradient_steps
        super().__init__(runs, states)

    @classmethod
    def kind(cls, run: Run) -> Hashable:
        """See `Population.kind`; runs that count episodes make steps of their own."""
        by_episode = run.model.train_freq.unit is TrainFrequencyUnit.EPISODE
        return id(run) if by_episode else super().kind(run)

    def iterate(self) -> None:
        """See `Population.iterate`: some steps into the replay, and an update by it."""
        steps = episodes = 0
        by_episode = self.train_freq.unit is TrainFrequencyUnit.EPISODE
        while (episodes if by_episode else steps) < self.train_freq.frequency:
            states, actions = self.environments.states, self._act()
            step = self.environments.take(actions)
            steps, episodes = steps + 1, episodes + len(step.which)
            self.num_timesteps += self.num_envs
            self._count(step, is_last=steps == self.train_freq.frequency)
            if not self.active.any():
                return
            columns = states, actions, step.reached, step.rewards, step.terminated
            self.replay.store(*(each.reshape(len(self.runs), -1) for each in columns))  # type: ignore[arg-type]
            self._after_step(step)
        if self.num_timesteps > self.learning_starts:
            updates = self.gradient_steps if self.gradient_steps >= 0 else steps * self.num_envs
            if updates > 0:
                self._update(updates)

    def _act(self) -> IntArray:
        """(P · E,), uniformly random at first; then one coin decides for a run's whole batch, as in SB3."""
        actions = np.empty((len(self.runs), self.num_envs), dtype=np.int64)
        states = self.environments.states.reshape(actions.shape)
        for run in self.going():
            is_random = (
                self.num_timesteps < self.learning_starts
                or run.numpy_generator.rand() < run.model.exploration_rate
            )
            if is_random:
                generator = run.model.action_space.np_random
                actions[run.row] = generator.integers(self.num_actions, size=self.num_envs)
            else:
                actions[run.row] = self._greedy_actions(run.row, states[run.row])
        actions[~self.active] = 0
        return actions.ravel()

    def _greedy_actions(self, row: int, states: IntArray) -> IntArray:
        if self.num_states > max(FEW_STATES, len(states)):
            which, index = np.unique(states, return_inverse=True)
            self._outputs = None
            found: IntArray = self.q_of(self._shaped(self.networks.run(which)[0]))[row].argmax(axis=-1)
            return found[index]
        if self._greedy is None:
            self._greedy = self.q_of(self.outputs).argmax(axis=-1)
        greedy: IntArray = self._greedy[row].take(states)
        return greedy

    def _count(self, step: Step, is_last: bool) -> None:
        """Count a step of each run, and call what wants to be called after it."""
        pairs, rewards = step.pairs.reshape(len(self.runs), -1), step.rewards.reshape(len(self.runs), -1)
        cuts = np.searchsorted(step.which, np.arange(len(self.runs) + 1) * self.num_envs).tolist()
        for run in self.going():
            row, part = run.row, slice(cuts[run.row], cuts[run.row + 1])
            run.envs.count(pairs[row][None], rewards[row][None])
            run.envs.add_returns(np.zeros(part.stop - part.start), step.returns[part])
            if is_last or self.num_timesteps >= min(run.next_call, run.total_timesteps):
                run.step_on(self.num_timesteps)
            if self.active[row] and part.start < part.stop:
                run.keep_episodes(step.returns[part], step.lengths[part])
        scales = np.array([run.reward_scale for run in self.runs])
        rewards *= scales[:, None]

    def _after_step(self, step: Step) -> None:
        """Update target networks and exploration rates, and log episodes, as SB3 does after a step."""
        model = self.runs[0].model
        if (self.num_timesteps // self.num_envs) % max(model.target_update_interval // self.num_envs, 1) == 0:
            rows = torch.as_tensor(np.flatnonzero(self.active), device=self.target.weights.device)
            target, own = self.target.weights, self.networks.weights
            target[rows] = (target[rows] * (1 - model.tau)).add(own[rows], alpha=model.tau)
            self._best = None
        ended = np.bincount(step.which // self.num_envs, minlength=len(self.runs))
        for run in self.going():
            model = run.model
            model._current_progress_remaining = 1 - self.progress(run)
            model.exploration_rate = model.exploration_schedule(model._current_progress_remaining)
            if not ended[run.row]:
                continue
            model.num_timesteps, first = self.num_timesteps, model._episode_num
            for number in range(first + 1, first + int(ended[run.row]) + 1):
                model._episode_num = number
                if number % run.log_interval == 0:
                    run.record("rollout/exploration_rate", model.exploration_rate)
                    model.dump_logs()

    def _update(self, steps: int) -> None:
        """Make gradient steps, each on a minibatch of its own."""
        if self._best is None:
            self._best = self.of_best_action(self._shaped(self.target.run_met()[0]))
        going, best, learning_rates = self.active.copy(), self._best, self.settings("learning_rate")
        gamma = np.array([run.model.gamma for run in self.runs], dtype=np.float32)[:, None]
        at_once, losses = max(1, _DRAWN_AT_ONCE // self.replay.width(self.batch_size)), []
        for first in range(0, steps, at_once):
            generators = [
                run.numpy_generator if goes else None for run, goes in zip(self.runs, going, strict=True)
            ]
            drawn = self.replay.draw(generators, min(at_once, steps - first), self.batch_size)
            targets = self._targets(drawn, best, gamma)
            for number in range(len(drawn.states)):
                shares = None if drawn.shares is None else drawn.shares[number]
                found, slopes = self._slopes(
                    drawn.states[number], drawn.actions[number], targets[number], shares
                )
                losses.append(found)
                self.networks.backward(slopes)
                going &= self.optimizer.step(learning_rates, going)
                self._outputs = self._greedy = None
        self.check(going, "the gradient")
        mean = np.stack(losses, axis=1).mean(axis=1)
        for run in self.going():
            run.model._n_updates += steps
            run.record("train/learning_rate", learning_rates[run.row])
            run.record("train/n_updates", run.model._n_updates, for_tensorboard=False)
            run.record("train/loss", float(mean[run.row]))
        self.check(np.isfinite(mean), "a loss")

    def _targets(self, drawn: Transitions, best: Array, gamma: Array) -> Array:
        """(n, P, B): rewards and what the target network expects of the best action in the next state."""
        row = (np.arange(len(self.runs)) * self.num_states)[:, None]
        values = best.take(drawn.following + row)
        return drawn.rewards + (1 - drawn.ends) * gamma * values

    def _slopes(
        self, states: IntArray, actions: IntArray, targets: Array, shares: FloatArray | None
    ) -> tuple[Array, Array]:
        """The losses (P,) of minibatches, and their slopes at the networks' outputs."""
        if self.num_states > max(FEW_STATES, states.shape[1]):
            which, index = np.unique(states[0], return_inverse=True)
            outputs, states = self._shaped(self.networks.run(which)[0]), index[None]
        else:
            outputs = self.outputs
        losses, slopes = self.losses_and_slopes(outputs, states, actions, targets, shares)
        return losses, slopes.reshape(*outputs.shape[:2], -1)

    @property
    def outputs(self) -> Array:
        """(P, S, ...), of the online networks and all states."""
        if self._outputs is None:
            self._outputs = self._shaped(self.networks.run()[0])
        return self._outputs

    def _shaped(self, outputs: Array) -> Array:
        """(P, U, ...) of what the networks return."""
        return outputs

    @staticmethod
    def q_of(outputs: Array) -> Array:
        """Q (P, U, A) of a network's outputs."""
        return outputs

    @staticmethod
    def of_best_action(outputs: Array) -> Array:
        """What a target network's outputs say of each state's best action."""
        best: Array = outputs.max(axis=-1)
        return best

    @staticmethod
    def losses_and_slopes(
        outputs: Array, index: IntArray, actions: IntArray, targets: Array, shares: FloatArray | None
    ) -> tuple[Array, Array]:
        """The Huber losses (P,) of minibatches (P, B), and their slopes, one for each output (P, U, A).

        `index` says which of the U states each transition begins in.
        """
        (runs, num_states, num_actions), count = outputs.shape, index.shape[1]
        pair = (index + num_states * np.arange(runs)[:, None]) * num_actions + actions
        error = outputs.take(pair) - targets
        slope = np.maximum(np.minimum(error, 1), -1)
        loss = slope * (error - slope / 2)
        if shares is not None:
            weighed = np.bincount(pair.ravel(), (slope * shares).ravel(), outputs.size)
            return np.cumsum(shares * loss, axis=1)[:, -1], weighed  # in turn: shares of 0 add 0
        slopes = np.bincount(pair.ravel(), slope.ravel(), outputs.size) / count
        return loss.sum(axis=1) / count, slopes

    def snapshot(self, run: Run) -> tuple[FloatArray, FloatArray | None, FloatArray | None]:
        q = self.q_of(self.outputs)[run.row].astype(np.float64)
        return q.max(axis=-1), None, q

    def weights(self, run: Run) -> dict[str, tuple[Networks, Sequence[torch.Tensor]]]:
        assert run.target is not None
        return {**super().weights(run), "target_weights": (self.target, run.target.parameters)}

    def get_state(self, run: Run) -> State:
        return {
            **super().get_state(run),
            "exploration_rate": float(run.model.exploration_rate),
            "replay": self.replay.get_state(run.row),
        }

    def set_state(self, run: Run, state: State) -> None:
        super().set_state(run, state)
        run.model.exploration_rate = float(state["exploration_rate"])
        self.replay.set_state(run.row, state["replay"])
