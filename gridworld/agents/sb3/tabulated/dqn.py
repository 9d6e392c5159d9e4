"""DQN with the network run once per state.

Greedy actions and targets are look-ups in tables of Q values, refreshed only when a network has changed.
The loss of a minibatch, the mean Huber distance of Q(s_i, a_i) to its target y_i, touches the network only
through the table Q, and there its gradient is a sum over samples:

    ∂L/∂Q(s, a) = 1/B Σ_(i: s_i = s, a_i = a) clip(Q(s, a) - y_i, -1, 1)

From this table it goes back through the network once. `tabulated.state_inputs` says why that is the
gradient of the whole batch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3 import DQN
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.type_aliases import RolloutReturn, TrainFreq
from stable_baselines3.common.utils import should_collect_more_steps
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.dqn.policies import QNetwork
from torch import Tensor

from gridworld.agents.sb3.tabulated.flat_optimizer import FlatOptimizer, not_finite
from gridworld.agents.sb3.tabulated.side_by_side import Leaves, SideBySide, forward, update_together
from gridworld.agents.sb3.tabulated.state_inputs import StateInputs, infos_of, smallest_integer
from gridworld.agents.sb3.vec_env import GridWorldVecEnv, StateStep
from gridworld.process.together import chance, meet
from gridworld.world.mdp import BoolArray, IntArray

Float32Array = NDArray[np.float32]


class StateReplayBuffer(ReplayBuffer):
    """SB3's replay buffer with states in the smallest integer type in place of observations."""

    def __init__(
        self,
        buffer_size: int,
        observation_space: Any,
        *arguments: Any,
        num_states: int,
        **options: Any,
    ) -> None:
        super().__init__(buffer_size, spaces.Discrete(1), *arguments, **options)
        shape = (self.buffer_size, self.n_envs)
        self.observations = np.zeros(shape, dtype=smallest_integer(num_states - 1))
        self.next_observations = np.zeros_like(self.observations)
        self.actions = np.zeros(shape, dtype=np.uint8)

    def store(self, states: IntArray, actions: IntArray, step: StateStep) -> None:
        """Add one step of every environment, from `states` (num_envs,) with `actions` (num_envs,)."""
        at = self.pos
        self.observations[at], self.actions[at] = states, actions
        self.next_observations[at] = step.last_states
        self.rewards[at], self.dones[at], self.timeouts[at] = step.rewards, step.dones, step.truncated
        self.pos = (at + 1) % self.buffer_size
        self.full |= self.pos == 0

    def draw(
        self, batch_size: int, chance: np.random.RandomState
    ) -> tuple[IntArray, IntArray, IntArray, Float32Array, Float32Array]:
        """Draw a minibatch of B transitions; drawn from numpy's global generator, they are SB3's own.

        Returns:
            (B,) each: states (int64), actions (uint8), next states (int64), rewards and ends (float32);
            time-outs are no ends.
        """
        steps = chance.randint(0, self.buffer_size if self.full else self.pos, size=batch_size)
        which = steps * self.n_envs + chance.randint(0, high=self.n_envs, size=batch_size)
        ends = self.dones.take(which) * (1 - self.timeouts.take(which))
        states, following = self.observations.take(which), self.next_observations.take(which)
        rewards = self.rewards.take(which)
        return states.astype(np.int64), self.actions.take(which), following.astype(np.int64), rewards, ends


class TabulatedDQN(DQN):
    """SB3's DQN on a `GridWorldVecEnv`, whose files stock `DQN.load` opens."""

    env: GridWorldVecEnv
    replay_buffer: StateReplayBuffer
    derived = (
        "descent",
        "inputs",
        "_q",
        "_greedy",
        "_target_values",
    )  # from the rest: no part of a checkpoint

    def _setup_model(self) -> None:
        observation = self.env.observation
        self.replay_buffer_class = self.replay_buffer_class or StateReplayBuffer
        self.replay_buffer_kwargs = {"num_states": observation.num_states}
        super()._setup_model()
        self.policy.set_training_mode(False)  # SB3's networks know no difference; switching takes time
        self.descent = FlatOptimizer(self.policy.optimizer)
        self.inputs = StateInputs(self.policy, observation)
        self._q: Tensor | None = None  # of all states, with its graph, until the network changes
        self._greedy: IntArray | None = None  # (S,), likewise
        self._target_values: Float32Array | None = None  # (S,), until the target network changes

    def _excluded_save_params(self) -> list[str]:
        return [
            *super()._excluded_save_params(),
            *("replay_buffer_class", "replay_buffer_kwargs"),
            *self.derived,
        ]

    def q_values(self, network: QNetwork, states: IntArray | None = None) -> Tensor:
        """Q (U, A) of these states (U,) from a network, with its graph. None: of all states."""
        observations = self.inputs.observations(states, network.q_net)
        features = None
        if observations is not None:
            features = network.extract_features(observations, network.features_extractor)
        return self.inputs.latent(network.q_net, states, features)

    def outputs(self) -> tuple[Tensor]:
        """See `side_by_side.Tabulated`."""
        return (self.q_values(self.q_net),)

    def outputs_of_all(self, leaves: Leaves) -> tuple[Tensor]:
        """See `side_by_side.Tabulated`."""
        net, features = self.q_net, None
        observations = self.inputs.observations(None, net.q_net)
        if observations is not None:
            features = net.extract_features(observations, net.features_extractor)
        return (forward(net.q_net, leaves, features),)

    def collect_rollouts(
        self,
        env: VecEnv,
        callback: BaseCallback,
        train_freq: TrainFreq,
        replay_buffer: ReplayBuffer,
        action_noise: ActionNoise | None = None,
        learning_starts: int = 0,
        log_interval: int | None = None,
    ) -> RolloutReturn:
        """See SB3's `OffPolicyAlgorithm.collect_rollouts`."""
        assert isinstance(env, GridWorldVecEnv)
        assert isinstance(replay_buffer, StateReplayBuffer)
        steps, episodes = 0, 0
        callback.on_rollout_start()
        states = env.states
        while should_collect_more_steps(train_freq, steps, episodes):
            actions = self._act(states, learning_starts)
            done = env.step_states(actions)
            rewards, dones, infos = done.rewards, done.dones, infos_of(done, env.num_envs)
            self.num_timesteps += env.num_envs
            steps += 1
            callback.update_locals(locals())
            if not callback.on_step():
                return RolloutReturn(steps * env.num_envs, episodes, continue_training=False)
            cast(Any, self.ep_info_buffer).extend([info["episode"] for info in done.ended.values()])
            replay_buffer.store(states, actions, done)
            states = done.states
            self._update_current_progress_remaining(self.num_timesteps, self._total_timesteps)
            self._on_step()
            for _ in done.ended:
                episodes += 1
                self._episode_num += 1
                if log_interval is not None and self._episode_num % log_interval == 0:
                    self.dump_logs()
        self._last_obs = env.observation.rows(states)
        callback.on_rollout_end()
        return RolloutReturn(steps * env.num_envs, episodes, continue_training=True)

    def _act(self, states: IntArray, learning_starts: int) -> IntArray:
        """Uniformly random at first; then one coin decides for the whole batch, as in SB3."""
        if self.num_timesteps < learning_starts or np.random.rand() < self.exploration_rate:
            return self.action_space.np_random.integers(self.env.envs.mdp.num_actions, size=len(states))
        which, index = self.inputs.distinct(states)
        if which is None:
            if self._greedy is None:
                self._greedy = _argmax(self.q_of(None))
            return self._greedy[index]
        with torch.no_grad():
            return _argmax(self.q_of(which))[index]

    def q_of(self, states: IntArray | None) -> Tensor:
        """Q (U, A) of these states (U,), None for all: then one pass serves acting and the next update."""
        if states is not None:
            return self.q_values(self.q_net, states)
        if self._q is None:
            self._q = self.q_values(self.q_net)
        return self._q

    def _on_step(self) -> None:
        super()._on_step()
        if self._n_calls % max(self.target_update_interval // self.n_envs, 1) == 0:
            self._target_values = None

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        """See SB3's `DQN.train`."""
        self._update_learning_rate(self.policy.optimizer)
        member = _Member(self, chance(), gradient_steps, batch_size)
        meet(_train_together, member, (self.inputs.kind, gradient_steps, batch_size))

    def best_values(self) -> Float32Array:
        """max_a Q(s, a) of the target network, (S,)."""
        if self._target_values is None:
            with torch.no_grad():
                best = self.q_values(self.q_net_target).max(dim=1).values
            self._target_values = best.cpu().numpy()
        return self._target_values

    def was_updated(self, greedy: IntArray | None = None) -> None:
        """Forget what the network said before it was changed; `greedy` (S,) are its actions now, if known."""
        self._q, self._greedy = None, greedy


@dataclass
class _Member:
    """One of the models that are updated together."""

    model: TabulatedDQN
    chance: np.random.RandomState  # that its minibatches are drawn with
    gradient_steps: int
    batch_size: int
    losses: list[float] = field(default_factory=list)
    error: Exception | None = None


def _train_together(members: Sequence[_Member]) -> list[Exception | None]:
    return update_together(_train, members)


def _train(members: Sequence[_Member]) -> list[Exception | None]:
    """Make an update of each of P models of one kind; returns what is to be raised in each."""
    with SideBySide([member.model.descent for member in members]) as rows:
        update = Update([member.model for member in members], rows)
        for _ in range(members[0].gradient_steps):
            drawn = [each.model.replay_buffer.draw(each.batch_size, each.chance) for each in members]
            losses, finite = update.step(*(_stacked(arrays) for arrays in zip(*drawn, strict=True)))
            for member, loss, is_finite in zip(members, losses, finite, strict=True):
                member.losses.append(loss)
                member.error = member.error or (None if is_finite else not_finite())
            if not any(finite):
                break
        update.end()
    for member in members:
        if member.error is None:
            model = member.model
            model._n_updates += member.gradient_steps
            model.logger.record("train/n_updates", model._n_updates, exclude="tensorboard")
            model.logger.record("train/loss", np.mean(member.losses))
    return [member.error for member in members]


class Update:
    """Steps that P models make together, each on minibatches of its own.

    Args:
        models: of one kind.
        rows: their optimisers.
    """

    def __init__(self, models: Sequence[TabulatedDQN], rows: SideBySide) -> None:
        self._models, self._rows = models, rows
        self._best_values = _stacked([model.best_values() for model in models])
        self._gammas = np.array([[model.gamma] for model in models], dtype=np.float32)
        self._norms = [model.max_grad_norm for model in models]
        self._finite = np.ones(len(models), dtype=np.bool_)
        self._row = np.arange(len(models))[:, None]

    def step(
        self,
        states: IntArray,
        actions: IntArray,
        following: IntArray,
        rewards: Float32Array,
        ends: Float32Array,
    ) -> tuple[list[float], BoolArray]:
        """Make one step of each optimiser.

        Args:
            states: (P, B), and so all others; what `StateReplayBuffer.draw` returns.

        Returns:
            P, the Huber loss before the step; (P,), which gradients have been finite so far.
        """
        targets = rewards + (1 - ends) * self._gammas * self._best_values[self._row, following]
        return self.descend(states, actions, targets)

    def descend(
        self, states: IntArray, actions: IntArray, targets: Float32Array
    ) -> tuple[list[float], BoolArray]:
        """The same towards targets (P, B), float32, for the values of pairs (P, B)."""
        index, q = self._values(states)
        numbers = q.detach().cpu().numpy()
        num_actions, count = numbers.shape[-1], actions.shape[1]
        pair = (index + self._row * (numbers.size // num_actions // len(index))) * num_actions + actions
        error = numbers.ravel()[pair] - targets
        slope = np.maximum(np.minimum(error, 1), -1)
        gradient = np.bincount(pair.ravel(), slope.ravel(), numbers.size) / count
        going = np.flatnonzero(self._finite)
        self._finite[going] = self._rows.step([q], [gradient], self._norms, going.tolist())
        for model in self._models:
            model.was_updated()
        return [float(s @ (e - s / 2)) / count for s, e in zip(slope, error, strict=True)], self._finite

    def end(self) -> None:
        """Let the models know what their networks say now."""
        if len(self._models) > 1:
            with torch.no_grad():
                (q,) = self._models[0].outputs_of_all(self._rows.leaves)
            for model, greedy in zip(self._models, _argmax(q), strict=True):
                model.was_updated(greedy)

    def _values(self, states: IntArray) -> tuple[IntArray, Tensor]:
        """Q of all or some states; where in them each of `states` (P, B) is."""
        if len(self._models) > 1:
            return states, self._models[0].outputs_of_all(self._rows.leaves)[0]
        which, index = self._models[0].inputs.distinct(states[0])
        return index[None], self._models[0].q_of(which)


def _argmax(q: Tensor) -> IntArray:
    greedy: IntArray = q.detach().cpu().numpy().argmax(axis=-1)
    return greedy


def _stacked(arrays: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Arrays (...) of P models as one (P, ...)."""
    return arrays[0][None] if len(arrays) == 1 else np.stack(arrays)
