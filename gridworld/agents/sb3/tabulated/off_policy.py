"""What the tabulated off-policy algorithms share: acting, storing and targets, by tables of the networks.

Greedy actions and targets are look-ups in tables, refreshed only when a network has changed.
"""

from __future__ import annotations

import math
from typing import Any, cast

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import RolloutReturn, TrainFreq
from stable_baselines3.common.utils import should_collect_more_steps
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor

from gridworld.agents.sb3.tabulated.flat_optimizer import FlatOptimizer
from gridworld.agents.sb3.tabulated.state_inputs import StateInputs, infos_of, smallest_integer
from gridworld.agents.sb3.vec_env import GridWorldVecEnv, StateStep
from gridworld.world.mdp import FloatArray, IntArray

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

    def draw(self, batch_size: int) -> tuple[IntArray, IntArray, IntArray, Float32Array, Float32Array]:
        """Draw a minibatch of B transitions; the random numbers are SB3's own.

        Returns:
            (B,) each: states (int64), actions (uint8), next states (int64), rewards and ends (float32);
            time-outs are no ends.
        """
        steps = np.random.randint(0, self.buffer_size if self.full else self.pos, size=batch_size)
        which = steps * self.n_envs + np.random.randint(0, high=self.n_envs, size=batch_size)
        ends = self.dones.take(which) * (1 - self.timeouts.take(which))
        states, following = self.observations.take(which), self.next_observations.take(which)
        rewards = self.rewards.take(which)
        return states.astype(np.int64), self.actions.take(which), following.astype(np.int64), rewards, ends


class TabulatedOffPolicy(OffPolicyAlgorithm):
    """An off-policy algorithm of SB3's kind on a `GridWorldVecEnv`; comes before SB3's class."""

    env: GridWorldVecEnv
    replay_buffer: StateReplayBuffer
    derived = ("descent", "inputs", "_online", "_target_values")  # from the rest: no part of a checkpoint
    # Of the online network here and, with "_target", of the target network; and of the layers in either.
    network: str
    exploration_rate: float
    max_grad_norm: Any  # a number, or None where it is not clipped
    target_update_interval: int
    _n_calls: int

    def _setup_model(self) -> None:
        observation = self.env.observation
        self.replay_buffer_class = self.replay_buffer_class or StateReplayBuffer
        self.replay_buffer_kwargs = {"num_states": observation.num_states}
        super()._setup_model()
        self.policy.set_training_mode(False)  # SB3's networks know no difference; switching takes time
        self.descent = FlatOptimizer(self.policy.optimizer)
        self.inputs = StateInputs(self.policy, observation)
        self._online: Tensor | None = None  # of all states, with its graph, until the network changes
        self._target_values: Float32Array | None = None  # (..., S), until the target network changes

    def _excluded_save_params(self) -> list[str]:
        return [
            *super()._excluded_save_params(),
            *("replay_buffer_class", "replay_buffer_kwargs"),
            *self.derived,
        ]

    def outputs(self, network: Any, states: IntArray | None = None) -> Tensor:
        """Run one of the two networks.

        Args:
            network: the online or the target network.
            states: (U,), integers; None: all.

        Returns:
            (U, ...), with its graph.
        """
        layers = getattr(network, self.network)
        observations = self.inputs.observations(states, layers)
        features = None
        if observations is not None:
            features = network.extract_features(observations, network.features_extractor)
        return self.inputs.latent(layers, states, features)

    def q_values(self, states: IntArray | None = None) -> Tensor:
        """Q (U, A) of these states (U,), with its graph. None: of all states."""
        return self.q_of(self.outputs(getattr(self, self.network), states))

    @staticmethod
    def q_of(outputs: Tensor) -> Tensor:
        """Q (U, A) of a network's outputs."""
        return outputs

    def online(self, which: IntArray | None) -> Tensor:
        """Run the online network on the states of `StateInputs.distinct`; on all, once until it changes."""
        if which is not None:
            return self.outputs(getattr(self, self.network), which)
        if self._online is None:
            self._online = self.outputs(getattr(self, self.network))
        return self._online

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
        with torch.set_grad_enabled(which is None):
            q = self.q_of(self.online(which).detach())
        greedy: IntArray = q.cpu().numpy().argmax(axis=1)
        return greedy[index]

    def _on_step(self) -> None:
        super()._on_step()
        if self._n_calls % max(self.target_update_interval // self.n_envs, 1) == 0:
            self._target_values = None

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        """See SB3's `DQN.train`."""
        self._update_learning_rate(self.policy.optimizer)
        losses = []
        for _ in range(gradient_steps):
            states, actions, following, rewards, ends = self.replay_buffer.draw(batch_size)
            discounts = (1 - ends) * np.float32(self.gamma)
            targets = rewards + discounts * self._best_values(following)
            losses.append(self.descend(states, actions, targets))
        self._n_updates += gradient_steps
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("train/loss", np.mean(losses))

    def descend(self, states: IntArray, actions: IntArray, targets: Float32Array) -> float:
        """Make one step of the optimiser on a minibatch of B transitions.

        Args:
            states: (B,), integers.
            actions: (B,), integers.
            targets: (..., B), float32, of the outputs for these actions.

        Returns:
            The loss before the step.
        """
        which, index = self.inputs.distinct(states)
        outputs = self.online(which)
        loss, slopes = self.loss_and_slopes(outputs.detach().cpu().numpy(), index, actions, targets)
        most = math.inf if self.max_grad_norm is None else self.max_grad_norm
        self.descent.step([outputs], [slopes], most)
        self._online = None
        return loss

    @staticmethod
    def loss_and_slopes(
        outputs: Float32Array, index: IntArray, actions: IntArray, targets: Float32Array
    ) -> tuple[float, FloatArray]:
        """Compute a minibatch's loss and its slopes at the network's outputs.

        Args:
            outputs: (U, ...).
            index: (B,), which of the U states each transition begins in.
            actions: (B,), integers.
            targets: (..., B), float32.

        Returns:
            The loss; the slopes, as many as there are outputs, in their order.
        """
        raise NotImplementedError

    def _best_values(self, states: IntArray) -> Float32Array:
        """What the target network says of the best action in states (B,), (..., B)."""
        if self._target_values is None:
            with torch.no_grad():
                outputs = self.outputs(getattr(self, f"{self.network}_target"))
            self._target_values = np.ascontiguousarray(self.of_best_action(outputs.cpu()))
        return self._target_values.take(states, axis=-1)

    @staticmethod
    def of_best_action(outputs: Tensor) -> Tensor:
        """What a target network's outputs (U, ...) say of each state's best action, (..., U)."""
        return outputs.max(dim=1).values
