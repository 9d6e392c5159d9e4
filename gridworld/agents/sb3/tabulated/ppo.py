"""PPO with the network run once per state.

During a rollout the policy stands still: log-probabilities and values of all states are tables, and a step
is a few look-ups. In an update, a minibatch's loss depends on the network only through its outputs at the
states, and has its slopes there in closed form (`tabulated.ppo_loss`); from there they go back
through the network once. `tabulated.state_inputs` says why that is the gradient of the whole batch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
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

from gridworld.agents.sb3.tabulated.flat_optimizer import FlatOptimizer, not_finite
from gridworld.agents.sb3.tabulated.ppo_loss import (
    Losses,
    Outputs,
    Weights,
    log_softmax,
    losses_and_slopes,
    sum_up,
)
from gridworld.agents.sb3.tabulated.side_by_side import Leaves, SideBySide, forward, update_together
from gridworld.agents.sb3.tabulated.state_inputs import StateInputs, infos_of
from gridworld.agents.sb3.vec_env import GridWorldVecEnv
from gridworld.process.together import chance, meet
from gridworld.world.mdp import BoolArray, FloatArray, IntArray

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
    derived = ("descent", "inputs", "old")  # from the rest: no part of a checkpoint

    def _setup_model(self) -> None:
        self.rollout_buffer_class = self.rollout_buffer_class or StateRolloutBuffer
        super()._setup_model()
        self.policy.set_training_mode(False)  # SB3's networks know no difference; switching takes time
        self.descent = FlatOptimizer(self.policy.optimizer)
        self.inputs = StateInputs(self.policy, self.env.observation)
        self.old: tuple[Float32Array, Float32Array]  # log π (S, A) and values (S,) that the rollout is from

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

    def outputs_of_all(self, leaves: Leaves) -> tuple[Tensor, Tensor]:
        """Logits (P, S, A) and values (P, S, 1) of all states from P policies of this shape."""
        policy, extractor = self.policy, self.policy.mlp_extractor
        nets = (extractor.policy_net, extractor.value_net)
        observations = self.inputs.observations(None, *nets)
        features: Any = None if observations is None else policy.extract_features(observations)
        actor, critic = features if isinstance(features, tuple) else (features, features)
        logits = forward([*nets[0], policy.action_net], leaves, actor)
        return logits, forward([*nets[1], policy.value_net], leaves, critic)

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
            tables = _tables(*self.outputs())
        self.old = log_prob, values = tables.log_prob[0], tables.values[0]
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
        buffer = self.rollout_buffer
        shape = (buffer.buffer_size, buffer.n_envs, self.batch_size, self.n_epochs, self.normalize_advantage)
        meet(_train_together, _Run(self, chance()), (self.inputs.kind, shape, self.clip_range_vf is None))

    def clip_ranges(self) -> tuple[float, float | None]:
        """Of the ratio and, if it is clipped, of the value, at this time of training."""
        progress = self._current_progress_remaining
        clip_range, clip_range_vf = cast(Any, self.clip_range), cast(Any, self.clip_range_vf)
        return clip_range(progress), None if clip_range_vf is None else clip_range_vf(progress)

    def log_update(self, epochs: int, logged: list[Losses], last_epoch: list[Losses]) -> None:
        """Log an update's losses; SB3 has the divergence of the last epoch and the last minibatch's loss."""
        self._n_updates += epochs
        means = Losses(*np.mean(logged, axis=0).tolist())._asdict()
        means["approx_kl"] = float(np.mean([losses.approx_kl for losses in last_epoch]))
        means["loss"] = logged[-1].loss
        for name, mean in means.items():
            self.logger.record(f"train/{name}", mean)
        buffer = self.rollout_buffer
        variance = explained_variance(buffer.values.flatten(), buffer.returns.flatten())
        self.logger.record("train/explained_variance", variance)
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
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
        for _ in range(runs[0].model.n_epochs):
            update.make_epoch()
    for run in runs:
        if run.error is None:
            run.model.log_update(run.epochs, run.logged, run.logged[run.last_epoch :])
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
        self._inputs = self._models[0].inputs
        self._going = np.arange(len(runs))  # those that have not ended their epochs
        self._all_going = True
        # Environment by environment, as SB3 lines samples up: the same seed draws the same minibatches.
        buffers = [model.rollout_buffer for model in self._models]
        states, actions, self._advantages, self._returns = (
            np.stack([getattr(buffer, name).swapaxes(0, 1).ravel() for buffer in buffers])
            for name in ("observations", "actions", "advantages", "returns")
        )
        self._old = Outputs(*map(np.stack, zip(*(model.old for model in self._models), strict=True)))
        runs_with, num_states, num_actions = self._old.log_prob.shape
        self._states = states + num_states * np.arange(runs_with)[:, None]
        self._pairs = self._states * num_actions + actions
        self._weights = _weights(self._models)
        self._norms = [model.max_grad_norm for model in self._models]

    def make_epoch(self) -> None:
        """Make the steps of an epoch; the order of samples is SB3's own draw."""
        going = self._going
        for run in going:
            self._runs[run].last_epoch = len(self._runs[run].logged)
            self._runs[run].epochs += 1
        count, size = self._states.shape[1], self._models[0].batch_size
        order = np.zeros((len(self._runs), count), dtype=np.int64)
        for run in going:
            order[run] = self._runs[run].chance.permutation(count)
        for start in range(0, count, size):
            if len(self._going):
                self._make_step(order[self._going, start : start + size])

    def _make_step(self, batch: IntArray) -> None:
        """Make a step on the samples (R, B) of those R runs that go on."""
        flat = batch + self._going[:, None] * self._states.shape[1]
        states, pairs = self._states.take(flat), self._pairs.take(flat)
        advantages, returns = self._advantages.take(flat), self._returns.take(flat)
        if self._models[0].normalize_advantage and batch.shape[1] > 1:
            advantages = _normalized(advantages)
        old, which = self._old, None
        if len(self._models) == 1:
            which, index = self._inputs.distinct(states[0])
            if which is not None:
                actions = pairs - states * old.log_prob.shape[2]
                old = Outputs(*(table[:, which] for table in old))
                states = index[None]
                pairs = states * old.log_prob.shape[2] + actions
        sums = sum_up(states, pairs, advantages, returns, old.log_prob.shape)
        outputs = self._outputs(which)
        new, weights = _tables(*outputs), self._weights
        if not self._all_going:
            new, old, sums, weights = (each.of(self._going) for each in (new, old, sums, weights))
        losses, *slopes = losses_and_slopes(new, old, sums, weights)
        goes_on = [self._takes(run, found) for run, found in zip(self._going, losses, strict=True)]
        slopes = [slope[goes_on] if not all(goes_on) else slope for slope in slopes]
        self._end(goes_on)
        if len(self._going):
            whole = [self._of_all(slope) for slope in slopes]
            finite = self._rows.step(outputs, whole, self._norms, self._going.tolist())
            for run, is_finite in zip(self._going, finite, strict=True):
                self._runs[run].error = None if is_finite else not_finite()
            self._end(finite)

    def _outputs(self, which: IntArray | None) -> tuple[Tensor, Tensor]:
        if len(self._models) == 1:
            return self._models[0].outputs(which)
        return self._models[0].outputs_of_all(self._rows.leaves)

    def _takes(self, run: int, losses: Losses) -> bool:
        """Note a step's losses; returns whether the step is to be made."""
        self._runs[run].logged.append(losses)
        target_kl = self._models[run].target_kl
        return target_kl is None or losses.approx_kl <= 1.5 * target_kl

    def _end(self, goes_on: list[bool]) -> None:
        if not all(goes_on):
            self._going, self._all_going = self._going[goes_on], False

    def _of_all(self, slopes: FloatArray) -> FloatArray:
        """Slopes of those that go on, and 0 for the others."""
        if self._all_going:
            return slopes
        whole = np.zeros((len(self._runs), *slopes.shape[1:]))
        whole[self._going] = slopes
        return whole


def _weights(models: Sequence[TabulatedPPO]) -> Weights:
    clip_ranges, clip_ranges_vf = zip(*(model.clip_ranges() for model in models), strict=True)
    vf = None if clip_ranges_vf[0] is None else _column(clip_ranges_vf)
    coefficients = ([getattr(model, name) for model in models] for name in ("ent_coef", "vf_coef"))
    return Weights(_column(clip_ranges), vf, *map(_column, coefficients))


def _column(numbers: Sequence[float]) -> FloatArray:
    return np.array(numbers, dtype=np.float64).reshape(-1, 1, 1)


def _normalized(advantages: Float32Array) -> Float32Array:
    mean, deviation = advantages.mean(axis=1, keepdims=True), advantages.std(axis=1, ddof=1, keepdims=True)
    normalized: Float32Array = (advantages - mean) / (deviation + 1e-8)
    return normalized


def _tables(logits: Tensor, values: Tensor) -> Outputs:
    """The numbers alone, where the loss works on them; of P models, or of one."""
    log_prob, numbers = log_softmax(logits.detach().cpu().numpy()), values.detach().cpu().numpy()[..., 0]
    return Outputs(log_prob, numbers) if logits.dim() == 3 else Outputs(log_prob[None], numbers[None])
