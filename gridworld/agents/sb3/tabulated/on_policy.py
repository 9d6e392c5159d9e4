"""What the tabulated on-policy algorithms share: the network's tables, and collecting a rollout by them.

During a rollout the policy stands still: log-probabilities and values of all states are tables, and a step
is a few look-ups.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor

from gridworld.agents.sb3.tabulated.flat_optimizer import FlatOptimizer
from gridworld.agents.sb3.tabulated.losses.ppo import Outputs, Weights, column, log_softmax
from gridworld.agents.sb3.tabulated.side_by_side import SideBySide, agree, stacked
from gridworld.agents.sb3.tabulated.stacked_layers import Leaves, forward
from gridworld.agents.sb3.tabulated.state_buffers import Float32Array, StateRolloutBuffer
from gridworld.agents.sb3.tabulated.state_inputs import StateInputs, infos_of
from gridworld.agents.sb3.vec_env import GridWorldVecEnv, StateStep
from gridworld.envs.joint_rollout import Rollout, roll, shape_of
from gridworld.process.parallel.together import meet
from gridworld.world.mdp import FloatArray, IntArray


class TabulatedOnPolicy(OnPolicyAlgorithm):
    """An on-policy algorithm of SB3's kind on a `GridWorldVecEnv`; comes before SB3's class."""

    env: GridWorldVecEnv
    policy: ActorCriticPolicy
    derived: tuple[str, ...] = ("descent", "inputs", "old", "_last_obs")  # no part of a checkpoint
    learns_all_at_once = True  # whether `descent` steps on all of the network's weights

    def _setup_model(self) -> None:
        self.rollout_buffer_class = self.rollout_buffer_class or StateRolloutBuffer
        super()._setup_model()
        self.policy.set_training_mode(False)  # SB3's networks know no difference; switching takes time
        self.inputs = StateInputs(self.policy, self.env.observation)
        self.descent = self._make_descent()
        self.old: Outputs  # of all states, from the policy that collected the rollout

    def _make_descent(self) -> FlatOptimizer:
        return FlatOptimizer(self.policy.optimizer)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "rollout_buffer_class", *self.derived]

    def outputs(self, states: IntArray | None = None, leaves: Leaves | None = None) -> tuple[Tensor, Tensor]:
        """Run the network.

        Args:
            states: (U,), integers; None: all.
            leaves: the weights of P networks of this shape, to run these on all states instead.

        Returns:
            Logits (U, A) and values (U, 1), with their graph; with an axis P before them for `leaves`.
        """
        policy, extractor = self.policy, self.policy.mlp_extractor
        nets = (extractor.policy_net, extractor.value_net)
        names = ["features_extractor"]
        if not policy.share_features_extractor:
            names = ["pi_features_extractor", "vf_features_extractor"]
        extractors = [getattr(policy, name) for name in names]
        features = self.inputs.features(states, policy.extract_features, *nets, extractors=extractors)
        actor, critic = features if isinstance(features, tuple) else (features, features)
        if leaves:
            logits = forward([*nets[0], policy.action_net], leaves, actor)
            return logits, forward([*nets[1], policy.value_net], leaves, critic)
        logits = policy.action_net(self.inputs.latent(nets[0], states, actor))
        return logits, policy.value_net(self.inputs.latent(nets[1], states, critic))

    def outputs_of_all(self, leaves: Leaves | None = None) -> tuple[Tensor, Tensor]:
        """See `side_by_side.Tabulated`."""
        return self.outputs(None, leaves)

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
        request = _Request(self, torch.rand(n_rollout_steps, env.num_envs).numpy())
        meet(_roll_together, request, (shape_of(env.envs), n_rollout_steps))
        rolled, (log_prob, values) = request.rolled, self.old
        over = rolled.terminated | rolled.truncated
        began = np.atleast_2d(cast(Any, self._last_episode_starts))
        starts = np.concatenate([began, over])  # whether an episode starts, step by step
        is_read, noted = getattr(callback, "reads_locals", True), cast(Any, self.ep_info_buffer)
        reached = n_rollout_steps
        for step in range(n_rollout_steps):
            env.envs.passed(rolled, step + 1)
            self.num_timesteps += env.num_envs
            if is_read:
                env.envs.catch_up()
                actions, episodes = rolled.actions[step], env.episodes(*rolled.ended(step, step + 1))
                done = env.told(rolled.step(step), episodes)
                callback.update_locals({**locals(), **_told(done, env.num_envs)})
            if not callback.on_step():
                reached = step
                break
            if is_read:
                noted.extend(episodes)
        env.envs.catch_up()
        if not is_read:
            noted.extend(self._episodes(rolled, reached))
        self._last_episode_starts = dones = starts[reached]
        if reached < n_rollout_steps:
            return False

        states = rolled.final_states
        rollout_buffer.observations, rollout_buffer.actions = rolled.states, rolled.actions
        rollout_buffer.rewards[:] = self._rewards(rolled, values)
        rollout_buffer.episode_starts[:] = starts[:-1]
        rollout_buffer.values = values[rolled.states]
        rollout_buffer.log_probs = log_prob[rolled.states, rolled.actions]
        rollout_buffer.full = True
        self._last_obs = env.observation.rows(states[:0])  # SB3 asks only whether there was a reset
        rollout_buffer.compute_returns_and_advantage(torch.as_tensor(values[states]), dones)
        callback.update_locals(locals())
        callback.on_rollout_end()
        return True

    def _episodes(self, rolled: Rollout, steps: int) -> list[dict[str, Any]]:
        """Those that a rollout's first steps ended, as far as SB3 keeps them."""
        returns, lengths = rolled.ended(0, steps)
        last = slice(-self._stats_window_size, None)
        return self.env.episodes(returns[last], lengths[last])

    def _rewards(self, rolled: Rollout, values: Float32Array) -> FloatArray:
        """Rewards (n, E), with what the network expects after an episode that the step limit cut off."""
        cut = rolled.truncated & ~rolled.terminated
        rewards = rolled.rewards
        (steps,) = np.nonzero(cut.any(axis=1))
        if not len(steps):
            return rewards
        rewards[steps] += self.gamma * cut[steps] * values[rolled.last_states[steps]]
        return rewards

    def samples(self) -> tuple[IntArray, IntArray, Float32Array, Float32Array]:
        """States, actions, advantages and returns of the rollout's n samples, (n,) each.

        Environment by environment, as SB3 lines samples up: the same seed draws the same minibatches.
        """
        buffer = self.rollout_buffer
        states, actions, advantages, returns = (
            table.swapaxes(0, 1).ravel()
            for table in (buffer.observations, buffer.actions, buffer.advantages, buffer.returns)
        )
        return states, actions, advantages, returns

    def log_update(self, explained: float) -> None:
        """Log what SB3 logs of the rollout after an update; see `explained_variances`."""
        self.logger.record("train/explained_variance", explained)
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")


@dataclass
class _Request:
    """A rollout that a model asks for, see `envs.joint_rollout.roll`."""

    model: TabulatedOnPolicy
    draws: NDArray[np.float32]
    rolled: Rollout = field(init=False)


def _roll_together(requests: Sequence[_Request]) -> list[Exception | None]:
    models = [each.model for each in requests]
    kinds: dict[Hashable, list[TabulatedOnPolicy]] = {}
    for model in models:
        kinds.setdefault(model.inputs.kind if model.learns_all_at_once else id(model), []).append(model)
    for same in kinds.values():
        _set_tables(same)
    thresholds = [np.exp(model.old.log_prob).cumsum(axis=1).T[:-1] for model in models]  # (A - 1, S)
    draws = np.stack([each.draws for each in requests])
    rollouts = roll([model.env.envs for model in models], thresholds, draws)
    for request, rolled in zip(requests, rollouts, strict=True):
        request.rolled = rolled
    return [None] * len(requests)


def _set_tables(models: Sequence[TabulatedOnPolicy]) -> None:
    """Run the networks of models of one kind, for their next rollouts."""
    together = len(models) > 1 and agree(models)
    with torch.no_grad():
        if not together:
            for model in models:
                model.old = tables(*model.outputs())
            return
        _, leaves = stacked([model.descent for model in models])
        found = tables(*models[0].outputs_of_all(leaves))
    for model, *own in zip(models, *found, strict=True):
        model.old = Outputs(*own)


def _told(done: StateStep, num_envs: int) -> dict[str, Any]:
    """A step's variables of SB3's own loop, which callbacks read."""
    return {"rewards": done.rewards, "dones": done.dones, "infos": infos_of(done, num_envs)}


class Rollouts:
    """The rollouts of R models of one kind that are updated together, as one batch.

    Args:
        models: with rollouts of one size, of n samples.
        rows: their optimisers.

    Attributes:
        num_states: S.
        num_actions: A.
        states: (R, n), run · S + state of each sample.
        pairs: (R, n), states · A + action.
        advantages: (R, n), float32.
        returns: (R, n), float32.
    """

    def __init__(self, models: Sequence[TabulatedOnPolicy], rows: SideBySide) -> None:
        self._models, self._rows = models, rows
        states, actions, self.advantages, self.returns = (
            np.stack(arrays) for arrays in zip(*(model.samples() for model in models), strict=True)
        )
        self.num_states, self.num_actions = models[0].old.log_prob.shape
        self.states = states + self.num_states * np.arange(len(models))[:, None]
        self.pairs = self.states * self.num_actions + actions

    def outputs(self, which: IntArray | None) -> tuple[Tensor, Tensor]:
        """Logits and values of all states, (R, S, ...); of a single model, (U, ...) of the states `which`."""
        return self._models[0].outputs(which, self._rows.leaves)

    def distinct(self, states: IntArray, pairs: IntArray) -> tuple[IntArray | None, IntArray, IntArray]:
        """Find the states to run the network on.

        Args:
            states: (R, B), of some samples.
            pairs: (R, B).

        Returns:
            (U,), those states of a single model, None for all; `states` and `pairs` numbered by them.
        """
        if len(self._models) > 1:
            return None, states, pairs
        which, index = self._models[0].inputs.distinct(states[0])
        return which, index[None], pairs if which is None else (index - states) * self.num_actions + pairs


def tables(logits: Tensor, values: Tensor) -> Outputs:
    """The numbers alone of logits (..., U, A) and values (..., U, 1), where a loss works on them."""
    return Outputs(log_softmax(logits.detach().cpu().numpy()), values.detach().cpu().numpy()[..., 0])


def tables_of_runs(logits: Tensor, values: Tensor) -> Outputs:
    """The same with an axis of runs, also where there is one run and no such axis."""
    found = tables(logits, values)
    return found if logits.dim() == 3 else Outputs(found.log_prob[None], found.values[None])


def normalized(advantages: Float32Array) -> Float32Array:
    """Advantages (..., B) with mean 0 and standard deviation 1, as SB3 scales them."""
    mean = advantages.mean(axis=-1, keepdims=True)
    scaled: Float32Array = (advantages - mean) / (advantages.std(axis=-1, ddof=1, keepdims=True) + 1e-8)
    return scaled


def explained_variances(models: Sequence[TabulatedOnPolicy]) -> list[float]:
    """The share of the variance of each rollout's returns that the values explain, as SB3 logs it."""
    tables = [(model.rollout_buffer.values.ravel(), model.rollout_buffer.returns.ravel()) for model in models]
    values, returns = (np.stack(arrays) for arrays in zip(*tables, strict=True))
    unexplained, total = (returns - values).var(axis=1), returns.var(axis=1)
    total[total == 0] = np.nan
    shares: list[float] = (1 - unexplained / total).tolist()
    return shares


def weights_of(
    models: Sequence[Any], clip_ranges: Sequence[float], clip_ranges_vf: Sequence[float] | None = None
) -> Weights:
    """The settings that the losses of these models depend on, with the clip ranges of now."""
    coefficients = ([getattr(model, name) for model in models] for name in ("ent_coef", "vf_coef"))
    clipped = None if clip_ranges_vf is None else column(clip_ranges_vf)
    return Weights(column(clip_ranges), clipped, *map(column, coefficients))
