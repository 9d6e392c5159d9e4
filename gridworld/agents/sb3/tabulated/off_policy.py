"""What the tabulated off-policy algorithms share: acting, storing and targets, by tables of the networks.

Greedy actions and targets are look-ups in tables, refreshed only when a network has changed.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import RolloutReturn, TrainFreq
from stable_baselines3.common.utils import should_collect_more_steps
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor

from gridworld.agents.sb3.replay_counts import ReplayCounts
from gridworld.agents.sb3.tabulated.flat_optimizer import FlatOptimizer, not_finite
from gridworld.agents.sb3.tabulated.side_by_side import SideBySide, update_together
from gridworld.agents.sb3.tabulated.stacked_layers import Leaves, forward
from gridworld.agents.sb3.tabulated.state_buffers import Float32Array, StateReplayBuffer, StateReplayCounts
from gridworld.agents.sb3.tabulated.state_inputs import StateInputs, infos_of
from gridworld.agents.sb3.vec_env import GridWorldVecEnv
from gridworld.process.parallel.together import chance, meet
from gridworld.world.mdp import FloatArray, IntArray

_DRAWN_AT_ONCE = 2**13  # transitions of a model
_BUFFERS: dict[Any, type[ReplayBuffer]] = {None: StateReplayBuffer, ReplayCounts: StateReplayCounts}


class TabulatedOffPolicy(OffPolicyAlgorithm):
    """An off-policy algorithm of SB3's kind on a `GridWorldVecEnv`; comes before SB3's class."""

    env: GridWorldVecEnv
    replay_buffer: StateReplayBuffer | StateReplayCounts
    # From the rest: no part of a checkpoint.
    derived = ("descent", "inputs", "_online", "_greedy", "_target_values", "_last_obs")
    # Of the online network here and, with "_target", of the target network; and of the layers in either.
    network: str
    exploration_rate: float
    max_grad_norm: Any  # a number, or None where it is not clipped
    target_update_interval: int
    _n_calls: int

    def _setup_model(self) -> None:
        observation = self.env.observation
        self.replay_buffer_class = _BUFFERS.get(self.replay_buffer_class, self.replay_buffer_class)
        self.replay_buffer_kwargs = {"num_states": observation.num_states}
        super()._setup_model()
        self.policy.set_training_mode(False)  # SB3's networks know no difference; switching takes time
        self.descent = FlatOptimizer(self.policy.optimizer)
        self.inputs = StateInputs(self.policy, observation)
        self._online: Tensor | None = None  # of all states, with its graph, until the network changes
        self._greedy: IntArray | None = None  # (S,), likewise
        self._target_values: Float32Array | None = None  # (..., S), until the target network changes

    def _excluded_save_params(self) -> list[str]:
        return [
            *super()._excluded_save_params(),
            *("replay_buffer_class", "replay_buffer_kwargs"),
            *self.derived,
        ]

    def outputs(self, network: Any, states: IntArray | None = None, leaves: Leaves | None = None) -> Tensor:
        """Run one of the two networks.

        Args:
            network: the online or the target network.
            states: (U,), integers; None: all.
            leaves: the weights of P networks of this shape, to run these on all states instead.

        Returns:
            (U, ...), with its graph; (P, S, ...) for `leaves`.
        """
        layers = getattr(network, self.network)
        extract = functools.partial(network.extract_features, features_extractor=network.features_extractor)
        features = self.inputs.features(states, extract, layers, extractors=[network.features_extractor])
        return forward(layers, leaves, features) if leaves else self.inputs.latent(layers, states, features)

    def outputs_of_all(self, leaves: Leaves | None = None) -> tuple[Tensor]:
        """See `side_by_side.Tabulated`."""
        return (self.outputs(getattr(self, self.network), None, leaves),)

    def q_values(self, states: IntArray | None = None) -> Tensor:
        """Q (U, A) of these states (U,), with its graph. None: of all states."""
        return self.q_of(self.outputs(getattr(self, self.network), states))

    @staticmethod
    def q_of(outputs: Tensor) -> Tensor:
        """Q (..., U, A) of a network's outputs (..., U, ...)."""
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
        assert isinstance(replay_buffer, StateReplayBuffer | StateReplayCounts)
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
        self._last_obs = env.observation.rows(states[:0])  # SB3 asks only whether there was a reset
        callback.on_rollout_end()
        return RolloutReturn(steps * env.num_envs, episodes, continue_training=True)

    def _act(self, states: IntArray, learning_starts: int) -> IntArray:
        """Uniformly random at first; then one coin decides for the whole batch, as in SB3."""
        if self.num_timesteps < learning_starts or np.random.rand() < self.exploration_rate:
            return self.action_space.np_random.integers(self.env.envs.mdp.num_actions, size=len(states))
        which, index = self.inputs.distinct(states)
        if which is None:
            if self._greedy is None:
                self._greedy = self.greedy_of(self.online(None))
            return self._greedy[index]
        with torch.no_grad():
            return self.greedy_of(self.online(which))[index]

    def greedy_of(self, outputs: Tensor) -> IntArray:
        """The greedy actions (..., U) by a network's outputs."""
        greedy: IntArray = self.q_of(outputs.detach()).cpu().numpy().argmax(axis=-1)
        return greedy

    def was_updated(self, greedy: IntArray | None = None) -> None:
        """Forget what the network said before it was changed; `greedy` (S,) are its actions now, if known."""
        self._online, self._greedy = None, greedy

    def _on_step(self) -> None:
        super()._on_step()
        if self._n_calls % max(self.target_update_interval // self.n_envs, 1) == 0:
            self._target_values = None

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        """See SB3's `DQN.train`."""
        self._update_learning_rate(self.policy.optimizer)
        member = _Member(self, chance(), gradient_steps, batch_size)
        key = self.inputs.kind, type(self.replay_buffer), gradient_steps, batch_size
        meet(_train_together, member, key)

    @staticmethod
    def losses_and_slopes(
        outputs: Float32Array,
        index: IntArray,
        actions: IntArray,
        targets: Float32Array,
        shares: FloatArray | None = None,
    ) -> tuple[list[float], FloatArray]:
        """Compute the losses of P minibatches and their slopes at the networks' outputs.

        Args:
            outputs: (P, U, ...).
            index: (P, B), which of the U states each transition begins in.
            actions: (P, B), integers.
            targets: (P, ..., B), float32.
            shares: (P, B), what part of its minibatch each transition makes up; None: all the same.

        Returns:
            P, the losses; the slopes, as many as there are outputs, in their order.
        """
        raise NotImplementedError

    def best_values(self) -> Float32Array:
        """What the target network says of the best action in each state, (..., S)."""
        if self._target_values is None:
            with torch.no_grad():
                outputs = self.outputs(getattr(self, f"{self.network}_target"))
            self._target_values = np.ascontiguousarray(self.of_best_action(outputs.cpu()))
        return self._target_values

    @staticmethod
    def of_best_action(outputs: Tensor) -> Tensor:
        """What a target network's outputs (U, ...) say of each state's best action, (..., U)."""
        return outputs.max(dim=1).values


@dataclass(frozen=True)
class _Member:
    """One of the models that are updated together."""

    model: TabulatedOffPolicy
    chance: np.random.RandomState  # that its minibatches are drawn with
    gradient_steps: int
    batch_size: int

    def draw(self, count: int) -> tuple[NDArray[Any], ...]:
        """Draw n minibatches (n, B) for `Update.minibatches`, (n, ...) each."""
        model = self.model
        drawn = model.replay_buffer.draw(count, self.batch_size, self.chance)
        states, actions, following, rewards, ends, *shares = drawn
        best = model.best_values().take(following, axis=-1)
        return states, actions, rewards, ends, np.moveaxis(best, -2, 0), *shares


def _train_together(members: Sequence[_Member]) -> list[Exception | None]:
    return update_together(_train, members)


def _train(members: Sequence[_Member]) -> list[Exception | None]:
    """Make an update of each of P models of one kind; returns what is to be raised in each."""
    steps = members[0].gradient_steps
    widest = max(member.model.replay_buffer.width(member.batch_size) for member in members)
    at_once = max(1, _DRAWN_AT_ONCE // widest)
    losses, finite = [], [True] * len(members)
    with SideBySide([member.model.descent for member in members]) as rows:
        update = Update([member.model for member in members], rows)
        for first in range(0, steps, at_once):
            drawn = [member.draw(min(at_once, steps - first)) for member in members]
            together = [_stacked(arrays) for arrays in zip(*drawn, strict=True)]
            for batch in update.minibatches(*together):
                if any(finite):
                    found, finite = update.descend(*batch)
                    losses.append(found)
        update.end()
    for member, own, is_finite in zip(members, zip(*losses, strict=True), finite, strict=True):
        if is_finite:
            model = member.model
            model._n_updates += steps
            model.logger.record("train/n_updates", model._n_updates, exclude="tensorboard")
            model.logger.record("train/loss", np.mean(own))
    return [None if is_finite else not_finite() for is_finite in finite]


def _stacked(arrays: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """(n, P, ..., B), of minibatches (n, ..., B) of P models; shorter ones end in transitions of no share."""
    first = arrays[0]
    longest = max(array.shape[-1] for array in arrays)
    stacked = np.zeros((first.shape[0], len(arrays), *first.shape[1:-1], longest), dtype=first.dtype)
    for model, array in enumerate(arrays):
        stacked[:, model, ..., : array.shape[-1]] = array
    return stacked


class Update:
    """Steps that P models make together, each on minibatches of its own.

    Args:
        models: of one kind.
        rows: their optimisers.
    """

    def __init__(self, models: Sequence[TabulatedOffPolicy], rows: SideBySide) -> None:
        self._models, self._rows = models, rows
        self._gammas = np.array([[model.gamma] for model in models], dtype=np.float32)
        norms = [model.max_grad_norm for model in models]
        self._norms = [math.inf if norm is None else norm for norm in norms]
        self._finite = np.ones(len(models), dtype=np.bool_)

    def minibatches(
        self,
        states: IntArray,
        actions: IntArray,
        rewards: Float32Array,
        ends: Float32Array,
        best: Float32Array,
        *shares: FloatArray,
    ) -> Iterator[tuple[Any, ...]]:
        """The states, actions and targets of n minibatches of each model, for `descend`.

        Args:
            states: (n, P, B), and so all others.
            best: (n, P, ..., B), what the target network says of the best action in the next state.
            shares: (n, P, B), of what counts transitions.
        """
        shape = (*rewards.shape[:2], *(1,) * (best.ndim - 3), -1)
        discounts = (1 - ends) * self._gammas
        targets = rewards.reshape(shape) + discounts.reshape(shape) * best
        return zip(states, actions, targets, *shares, strict=True)

    def descend(
        self, states: IntArray, actions: IntArray, targets: Float32Array, shares: FloatArray | None = None
    ) -> tuple[list[float], list[bool]]:
        """Make one step of each optimiser.

        Args:
            states: (P, B), integers.
            actions: (P, B), likewise.
            targets: (P, ..., B), float32, of the outputs for these actions.
            shares: see `TabulatedOffPolicy.losses_and_slopes`.

        Returns:
            P, the losses before the step; P, which gradients have been finite so far.
        """
        index, outputs = self._outputs(states)
        numbers = outputs.detach().cpu().numpy()
        if len(self._models) == 1:
            numbers = numbers[None]
        losses, slopes = self._models[0].losses_and_slopes(numbers, index, actions, targets, shares)
        going = np.flatnonzero(self._finite)
        self._finite[going] = self._rows.step([outputs], [slopes], self._norms, going.tolist())
        for model in self._models:
            model.was_updated()
        return losses, self._finite.tolist()

    def end(self) -> None:
        """Let the models know what their networks say now."""
        if len(self._models) > 1:
            with torch.no_grad():
                (outputs,) = self._models[0].outputs_of_all(self._rows.leaves)
            for model, greedy in zip(self._models, self._models[0].greedy_of(outputs), strict=True):
                model.was_updated(greedy)

    def _outputs(self, states: IntArray) -> tuple[IntArray, Tensor]:
        """The online networks' outputs for all or some states; where in them each of `states` (P, B) is."""
        if len(self._models) > 1:
            return states, self._models[0].outputs_of_all(self._rows.leaves)[0]
        which, index = self._models[0].inputs.distinct(states[0])
        return index[None], self._models[0].online(which)
