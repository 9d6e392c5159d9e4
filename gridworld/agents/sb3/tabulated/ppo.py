"""PPO with the network run once per state.

During a rollout the policy stands still: log-probabilities and values of all states are tables, and a step
is a few look-ups. In an update, a minibatch's loss depends on the network only through its outputs at the
states, and has its slopes there in closed form (`tabulated.ppo_loss`); from there they go back
through the network once. `tabulated.state_inputs` says why that is the gradient of the whole batch.
"""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.utils import explained_variance
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor

from gridworld.agents.sb3.tabulated.flat_optimizer import FlatOptimizer
from gridworld.agents.sb3.tabulated.ppo_loss import (
    Losses,
    Outputs,
    Weights,
    log_softmax,
    losses_and_slopes,
    sum_up,
)
from gridworld.agents.sb3.tabulated.state_inputs import StateInputs, infos_of
from gridworld.agents.sb3.vec_env import GridWorldVecEnv
from gridworld.world.mdp import BoolArray, IntArray

Float32Array = NDArray[np.float32]


class StateRolloutBuffer(RolloutBuffer):
    """SB3's rollout buffer with the state's number in place of an observation."""

    def __init__(self, buffer_size: int, observation_space: Any, *arguments: Any, **options: Any) -> None:
        super().__init__(buffer_size, spaces.Discrete(1), *arguments, **options)

    def compute_returns_and_advantage(self, last_values: Tensor, dones: BoolArray) -> None:
        """SB3's own recursion to the last bit, with everything that does not recur done at once."""
        going_on = 1.0 - np.concatenate([self.episode_starts[1:], dones[None].astype(np.float32)])
        following = np.concatenate([self.values[1:], last_values.numpy()[None]])
        self.advantages = self.rewards + self.gamma * following * going_on - self.values
        carry = self.gamma * self.gae_lambda * going_on
        for step in range(self.buffer_size - 2, -1, -1):
            self.advantages[step] += carry[step] * self.advantages[step + 1]
        self.returns = self.advantages + self.values


class TabulatedPPO(PPO):
    """SB3's PPO on a `GridWorldVecEnv`, whose files stock `PPO.load` opens."""

    env: GridWorldVecEnv
    policy: ActorCriticPolicy
    derived = ("descent", "inputs", "_old")  # from the rest: no part of a checkpoint

    def _setup_model(self) -> None:
        self.rollout_buffer_class = self.rollout_buffer_class or StateRolloutBuffer
        super()._setup_model()
        self.policy.set_training_mode(False)  # SB3's networks know no difference; switching takes time
        self.descent = FlatOptimizer(self.policy.optimizer)
        self.inputs = StateInputs(self.policy, self.env.observation)
        self._old: Outputs  # of all states, from the policy that collected the rollout

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "rollout_buffer_class", *self.derived]

    def outputs(self, states: IntArray | None = None) -> tuple[Tensor, Tensor]:
        """Logits (U, A) and values (U, 1) of these states (U,), with their graph. None: of all states."""
        policy, extractor = self.policy, self.policy.mlp_extractor
        nets = (extractor.policy_net, extractor.value_net)
        observations = self.inputs.observations(states, *nets)
        features: Any = None if observations is None else policy.extract_features(observations)
        actor, critic = features if isinstance(features, tuple) else (features, features)
        logits = policy.action_net(self.inputs.latent(nets[0], states, actor))
        values = policy.value_net(self.inputs.latent(nets[1], states, critic))
        return logits, values

    def collect_rollouts(
        self,
        env: VecEnv,
        callback: BaseCallback,
        rollout_buffer: RolloutBuffer,
        n_rollout_steps: int,
    ) -> bool:
        """See SB3's `OnPolicyAlgorithm.collect_rollouts`."""
        assert isinstance(env, GridWorldVecEnv)
        rollout_buffer.reset()
        callback.on_rollout_start()
        with torch.no_grad():
            self._old = log_prob, values = _tables(*self.outputs())
        thresholds = np.exp(log_prob).cumsum(axis=1).T[:-1].copy()  # (A - 1, S)
        draws = torch.rand(n_rollout_steps, env.num_envs).numpy()

        visited = np.empty((n_rollout_steps, env.num_envs), dtype=np.int64)
        taken = np.empty_like(visited)
        states = env.states
        for step in range(n_rollout_steps):
            beyond = draws[step] >= thresholds.take(states, axis=1)
            actions = np.add.reduce(beyond, axis=0, dtype=np.int64)
            done = env.step_states(actions)
            rewards, dones, infos = done.rewards, done.dones, infos_of(done, env.num_envs)
            self.num_timesteps += env.num_envs
            callback.update_locals(locals())
            if not callback.on_step():
                return False
            cast(Any, self.ep_info_buffer).extend([info["episode"] for info in done.ended.values()])
            if done.ended and done.truncated.any():
                rewards = rewards + self.gamma * done.truncated * values[done.last_states]
            visited[step], taken[step] = states, actions
            rollout_buffer.rewards[step] = rewards
            rollout_buffer.episode_starts[step] = self._last_episode_starts
            states, self._last_episode_starts = done.states, dones

        rollout_buffer.observations, rollout_buffer.actions = visited, taken
        rollout_buffer.values = values[visited]
        rollout_buffer.log_probs = log_prob[visited, taken]
        rollout_buffer.full = True
        self._last_obs = env.observation.rows(states)
        rollout_buffer.compute_returns_and_advantage(torch.as_tensor(values[states]), dones)
        callback.update_locals(locals())
        callback.on_rollout_end()
        return True

    def train(self) -> None:
        """See SB3's `PPO.train`."""
        self._update_learning_rate(self.policy.optimizer)
        clip_range, clip_range_vf = self._clip_ranges()
        buffer = self.rollout_buffer
        # Environment by environment, as SB3 lines samples up: the same seed draws the same minibatches.
        states, actions, advantages, returns = (
            table.swapaxes(0, 1).ravel()
            for table in (buffer.observations, buffer.actions, buffer.advantages, buffer.returns)
        )
        weights = Weights(clip_range, clip_range_vf, self.ent_coef, self.vf_coef)
        logged: list[Losses] = []
        goes_on, epoch = True, 0
        while goes_on and epoch < self.n_epochs:
            first = len(logged)
            for batch in _minibatches(len(states), self.batch_size):
                which, index = self.inputs.distinct(states[batch])
                weighed = self._normalized(advantages[batch])
                old = self._old if which is None else Outputs(*(table[which] for table in self._old))
                sums = sum_up(index, actions[batch], weighed, returns[batch], old.log_prob.shape)
                outputs = self.outputs(which)
                losses, *slopes = losses_and_slopes(_tables(*outputs), old, sums, weights)
                logged.append(losses)
                goes_on = self.target_kl is None or losses.approx_kl <= 1.5 * self.target_kl
                if not goes_on:
                    break
                self.descent.step(outputs, slopes, self.max_grad_norm)
            epoch += 1
        self._n_updates += epoch
        self._log(logged, first, weights)

    def _clip_ranges(self) -> tuple[float, float | None]:
        progress = self._current_progress_remaining
        clip_range, clip_range_vf = cast(Any, self.clip_range), cast(Any, self.clip_range_vf)
        return clip_range(progress), None if clip_range_vf is None else clip_range_vf(progress)

    def _normalized(self, advantages: Float32Array) -> Float32Array:
        if not self.normalize_advantage or len(advantages) < 2:
            return advantages
        normalized: Float32Array = (advantages - advantages.mean()) / (advantages.std(ddof=1) + 1e-8)
        return normalized

    def _log(self, logged: list[Losses], last_epoch: int, weights: Weights) -> None:
        """SB3 reports the divergence of the last epoch alone, and the loss of the last minibatch."""
        means = Losses(*np.mean(logged, axis=0).tolist())._asdict()
        means["approx_kl"] = float(np.mean([losses.approx_kl for losses in logged[last_epoch:]]))
        means["loss"] = logged[-1].loss
        for name, mean in means.items():
            self.logger.record(f"train/{name}", mean)
        buffer = self.rollout_buffer
        variance = explained_variance(buffer.values.flatten(), buffer.returns.flatten())
        self.logger.record("train/explained_variance", variance)
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("train/clip_range", weights.clip_range)
        if weights.clip_range_vf is not None:
            self.logger.record("train/clip_range_vf", weights.clip_range_vf)


def _tables(logits: Tensor, values: Tensor) -> Outputs:
    """The numbers alone, where the loss works on them."""
    return Outputs(log_softmax(logits.detach().cpu().numpy()), values.detach().cpu().numpy()[:, 0])


def _minibatches(count: int, batch_size: int) -> list[IntArray]:
    """All samples in random order, cut into batches; the draw is SB3's own."""
    order = np.random.permutation(count)
    return [order[start : start + batch_size] for start in range(0, count, batch_size)]
