"""PPO with the network run once per state.

During a rollout the policy stands still: log-probabilities and values of all states are tables, and a step
is a few look-ups. In an update, all samples of one (state, action) share one ratio
ρ = π_θ(a|s) / π_old(a|s). For an advantage A ≥ 0 the clipped surrogate is A · min(ρ, 1+ε), for A < 0 it is
A · max(ρ, 1-ε). So with A⁺ and A⁻ the sums of a minibatch's positive and negative advantages per pair, and
n_s the number of samples of a state, their returns' mean m_s and squared deviations from it d_s,

    surrogate = 1/B Σ_(s,a) [ A⁺ min(ρ, 1+ε) + A⁻ max(ρ, 1-ε) ]
    entropy   = 1/B Σ_s n_s H(π_θ(·|s))
    squares   = 1/B Σ_s [ n_s (V_θ(s) - m_s)² + d_s ]

which are the means over samples that SB3 takes, term by term; clipping the value's change keeps it a
function of the state. `gridworld.agents.sb3.tabulated` says why the gradient is the same too.
"""

from __future__ import annotations

from dataclasses import dataclass
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

from gridworld.agents.sb3.tabulated import Descent, StateInputs, infos_of
from gridworld.agents.sb3.vec_env import GridWorldVecEnv
from gridworld.mdp import NUM_ACTIONS, FloatArray, IntArray

Float32Array = NDArray[np.float32]

# What `losses` returns, under SB3's names.
_LOGGED = ("loss", "policy_gradient_loss", "value_loss", "entropy_loss", "approx_kl", "clip_fraction")
_KL = _LOGGED.index("approx_kl")


class StateRolloutBuffer(RolloutBuffer):
    """SB3's rollout buffer with the state's number in place of an observation."""

    def __init__(self, buffer_size: int, observation_space: Any, *arguments: Any, **options: Any) -> None:
        super().__init__(buffer_size, spaces.Discrete(1), *arguments, **options)


@dataclass(frozen=True, eq=False)
class Sums:
    """A minibatch, summed up. U states occur in it; everything is divided by the number of samples."""

    deviation: float  # of returns from their state's mean, squared
    positive: Tensor  # (U, A), sum of positive advantages
    negative: Tensor  # (U, A), sum of negative advantages
    pairs: Tensor  # (U, A), share of the samples
    states: Tensor  # (U,), share of the samples
    mean_return: Tensor  # (U,)


class TabulatedPPO(PPO):
    """SB3's PPO on a `GridWorldVecEnv`, whose files stock `PPO.load` opens."""

    env: GridWorldVecEnv
    policy: ActorCriticPolicy

    def _setup_model(self) -> None:
        self.rollout_buffer_class = StateRolloutBuffer
        super()._setup_model()
        self.policy.set_training_mode(False)  # SB3's networks know no difference; switching takes time
        self.descent = Descent(self.policy.optimizer)
        self.inputs = StateInputs(self.policy, self.env.observation)
        self._old_log_prob: Float32Array = np.empty(0, dtype=np.float32)  # (S, A), of this rollout's policy
        self._old_values: Float32Array = np.empty(0, dtype=np.float32)  # (S,)

    def _excluded_save_params(self) -> list[str]:
        ours = ["rollout_buffer_class", "descent", "inputs", "_old_log_prob", "_old_values"]
        return [*super()._excluded_save_params(), *ours]

    def tables(self, states: IntArray | None = None) -> tuple[Tensor, Tensor]:
        """log π (U, A) and V (U,) of these states (None: all), with their graph."""
        policy, extractor = self.policy, self.policy.mlp_extractor
        nets = (extractor.policy_net, extractor.value_net)
        observations = self.inputs.observations(states, *nets)
        features: Any = None if observations is None else policy.extract_features(observations)
        actor, critic = features if isinstance(features, tuple) else (features, features)
        logits = policy.action_net(self.inputs.latent(nets[0], states, actor))
        values = policy.value_net(self.inputs.latent(nets[1], states, critic))
        return torch.log_softmax(logits, dim=1), values[:, 0]

    def collect_rollouts(
        self,
        env: VecEnv,
        callback: BaseCallback,
        rollout_buffer: RolloutBuffer,
        n_rollout_steps: int,
    ) -> bool:
        assert isinstance(env, GridWorldVecEnv)
        rollout_buffer.reset()
        callback.on_rollout_start()
        with torch.no_grad():
            log_prob, values = (table.cpu().numpy() for table in self.tables())
        self._old_log_prob, self._old_values = log_prob, values
        thresholds = np.exp(log_prob).cumsum(axis=1).T[:-1].copy()  # (A - 1, S)
        draws = torch.rand(n_rollout_steps, env.num_envs).numpy()

        visited = np.empty((n_rollout_steps, env.num_envs), dtype=np.int64)
        taken = np.empty_like(visited)
        states = env.states
        for step in range(n_rollout_steps):
            actions = np.zeros(env.num_envs, dtype=np.int64)
            for threshold in thresholds:
                actions += draws[step] >= threshold[states]
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
        self._update_learning_rate(self.policy.optimizer)
        clip_range, clip_range_vf = self._clip_ranges()
        buffer = self.rollout_buffer
        # Environment by environment, as SB3 lines samples up: the same seed draws the same minibatches.
        states, actions, advantages, returns = (
            table.swapaxes(0, 1).ravel()
            for table in (buffer.observations, buffer.actions, buffer.advantages, buffer.returns)
        )
        logged: list[Tensor] = []
        goes_on, epoch = True, 0
        while goes_on and epoch < self.n_epochs:
            first = len(logged)
            for batch in _minibatches(len(states), self.batch_size):
                which, index = self.inputs.distinct(states[batch])
                sums = self._sum_up(which, index, actions[batch], advantages[batch], returns[batch])
                losses = self.losses(which, sums, clip_range, clip_range_vf)
                logged.append(torch.stack(losses).detach())
                goes_on = self.target_kl is None or logged[-1][_KL].item() <= 1.5 * self.target_kl
                if not goes_on:
                    break
                self.descent.step(losses[0], None, self.max_grad_norm)
            epoch += 1
        self._n_updates += epoch
        self._log(torch.stack(logged), first, clip_range, clip_range_vf)

    def _clip_ranges(self) -> tuple[float, float | None]:
        progress = self._current_progress_remaining
        clip_range, clip_range_vf = cast(Any, self.clip_range), cast(Any, self.clip_range_vf)
        return clip_range(progress), None if clip_range_vf is None else clip_range_vf(progress)

    def losses(
        self, states: IntArray | None, sums: Sums, clip_range: float, clip_range_vf: float | None
    ) -> tuple[Tensor, ...]:
        """The minibatch's numbers that SB3 logs; the first is the one to descend."""
        log_prob, values = self.tables(states)
        rows = slice(None) if states is None else states
        old_log_prob = torch.as_tensor(self._old_log_prob[rows], device=self.device)
        log_ratio = log_prob - old_log_prob
        ratio = log_ratio.exp()
        gained = sums.positive * ratio.clamp(max=1 + clip_range)
        lost = sums.negative * ratio.clamp(min=1 - clip_range)
        policy_loss = -(gained + lost).sum()
        entropy_loss = (sums.states * (log_prob.exp() * log_prob).sum(dim=1)).sum()
        if clip_range_vf is not None:
            old_values = torch.as_tensor(self._old_values[rows], device=self.device)
            values = old_values + (values - old_values).clamp(-clip_range_vf, clip_range_vf)
        value_loss = (sums.states * (values - sums.mean_return).square()).sum() + sums.deviation
        loss = policy_loss + self.ent_coef * entropy_loss + self.vf_coef * value_loss
        with torch.no_grad():
            divergence = (sums.pairs * (ratio - 1 - log_ratio)).sum()
            clipped = (sums.pairs * ((ratio - 1).abs() > clip_range)).sum()
        return loss, policy_loss, value_loss, entropy_loss, divergence, clipped

    def _sum_up(
        self,
        which: IntArray | None,
        index: IntArray,
        actions: IntArray,
        advantages: Float32Array,
        returns: Float32Array,
    ) -> Sums:
        count = len(index)
        if self.normalize_advantage and count > 1:
            advantages = (advantages - advantages.mean()) / (advantages.std(ddof=1) + 1e-8)
        size = self.inputs.num_states if which is None else len(which)
        num_actions = NUM_ACTIONS
        pair = index * num_actions + actions

        def per_pair(weights: FloatArray | Float32Array | None) -> FloatArray:
            return np.bincount(pair, weights, size * num_actions).reshape(size, num_actions) / count

        pairs = per_pair(None)
        positive = per_pair(np.maximum(advantages, 0))
        negative = per_pair(np.minimum(advantages, 0))
        states = pairs.sum(axis=1)
        mean_return = np.bincount(index, returns, size) / np.maximum(states * count, 1)
        deviation = float(np.square(returns - mean_return[index]).mean())
        tensors = [
            torch.as_tensor(table.astype(np.float32), device=self.device)
            for table in (positive, negative, pairs, states, mean_return)
        ]
        return Sums(deviation, *tensors)

    def _log(self, logged: Tensor, last_epoch: int, clip_range: float, clip_range_vf: float | None) -> None:
        """`logged` (updates, 6) are the losses; SB3 reports the divergence of the last epoch alone."""
        means = dict(zip(_LOGGED, logged.mean(dim=0).tolist(), strict=True))
        means |= {"approx_kl": logged[last_epoch:, _KL].mean().item(), "loss": logged[-1, 0].item()}
        for name, mean in means.items():
            self.logger.record(f"train/{name}", mean)
        buffer = self.rollout_buffer
        variance = explained_variance(buffer.values.flatten(), buffer.returns.flatten())
        self.logger.record("train/explained_variance", variance)
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("train/clip_range", clip_range)
        if clip_range_vf is not None:
            self.logger.record("train/clip_range_vf", clip_range_vf)


def _minibatches(count: int, batch_size: int) -> list[IntArray]:
    """All samples in random order, cut into batches; the draw is SB3's own."""
    order = np.random.permutation(count)
    return [order[start : start + batch_size] for start in range(0, count, batch_size)]
