"""SB3's buffers with a state's number in place of an observation."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.buffers import ReplayBuffer, RolloutBuffer
from torch import Tensor

from gridworld.agents.sb3.replay_counts import ReplayCounts, systematic_sample
from gridworld.agents.sb3.tabulated.state_inputs import smallest_integer
from gridworld.agents.sb3.vec_env import StateStep
from gridworld.storage.serialization import State, StateError, fill
from gridworld.world.mdp import BoolArray, FloatArray, IntArray

Float32Array = NDArray[np.float32]


class StateRolloutBuffer(RolloutBuffer):
    """SB3's rollout buffer with the state's number in place of an observation."""

    def __init__(self, buffer_size: int, observation_space: Any, *arguments: Any, **options: Any) -> None:
        super().__init__(buffer_size, spaces.Discrete(1), *arguments, **options)

    def compute_returns_and_advantage(self, last_values: Tensor, dones: BoolArray) -> None:
        """SB3's own recursion, with everything that does not recur done at once."""
        going_on = 1.0 - np.concatenate([self.episode_starts[1:], dones[None].astype(np.float32)])
        following = np.concatenate([self.values[1:], last_values.numpy()[None]])
        self.advantages = advantages = self.rewards + self.gamma * following * going_on - self.values
        carry = self.gamma * self.gae_lambda * going_on
        for step in range(self.buffer_size - 2, -1, -1):
            advantages[step] += carry[step] * advantages[step + 1]
        self.returns = advantages + self.values


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

    def width(self, batch_size: int) -> int:
        """How many transitions stand in what `draw` returns of a minibatch."""
        return batch_size

    def draw(
        self, count: int, batch_size: int, chance: np.random.RandomState
    ) -> tuple[IntArray, IntArray, IntArray, Float32Array, Float32Array]:
        """Draw n minibatches of B transitions; drawn from numpy's global generator, they are SB3's own.

        Returns:
            (n, B) each: states (int64), actions (uint8), next states (int64), rewards and ends (float32);
            time-outs are no ends.
        """
        # Of each minibatch in turn the steps, then the environments, as SB3 draws them.
        bounds = np.array([[self.buffer_size if self.full else self.pos], [self.n_envs]])
        drawn = chance.randint(0, bounds, size=(count, 2, batch_size))
        which = drawn[:, 0] * self.n_envs + drawn[:, 1]
        ends = self.dones.take(which) * (1 - self.timeouts.take(which))
        states, following = self.observations.take(which), self.next_observations.take(which)
        rewards = self.rewards.take(which)
        return states.astype(np.int64), self.actions.take(which), following.astype(np.int64), rewards, ends


class StateReplayCounts(ReplayCounts):
    """`ReplayCounts` with states in place of observations.

    Attributes:
        counts: (R,), how often each transition was met, in the order of their states and actions.
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: Any,
        action_space: spaces.Discrete,
        *arguments: Any,
        num_states: int,
        **options: Any,
    ) -> None:
        super().__init__(buffer_size, spaces.Discrete(1), action_space, *arguments, **options)
        self._num_states, self._num_actions = num_states, int(action_space.n)
        self.reset()

    def reset(self) -> None:
        """See `ReplayCounts.reset`."""
        super().reset()
        self._set(np.empty(0, dtype=np.complex128), np.empty(0, dtype=np.int64))

    def store(self, states: IntArray, actions: IntArray, step: StateStep) -> None:
        """Add one step of every environment, from `states` (num_envs,) with `actions` (num_envs,)."""
        ends = step.dones & ~step.truncated
        numbers = ((states * self._num_actions + actions) * self._num_states + step.last_states) * 2 + ends
        # Complex numbers are sorted by their real parts, and then by the others.
        met = numbers + 1j * step.rewards.astype(np.float32)
        rows = np.searchsorted(self._met, met)
        if not len(self._met) or not np.array_equal(self._met.take(rows, mode="clip"), met):
            all_of_them = np.union1d(self._met, met)
            counts: IntArray = np.zeros(len(all_of_them), dtype=np.int64)
            counts[np.searchsorted(all_of_them, self._met)] = self.counts
            self._set(all_of_them, counts)
            rows = np.searchsorted(self._met, met)
        self.counts += np.bincount(rows, minlength=len(self.counts))
        self.pos += len(rows)

    def _set(self, met: NDArray[np.complex128], counts: IntArray) -> None:
        self._met, self.counts = met, counts
        numbers = met.real.astype(np.int64)
        pairs, following = np.divmod(numbers // 2, self._num_states)
        states, actions = np.divmod(pairs, self._num_actions)
        rewards, ends = met.imag.astype(np.float32), (numbers % 2).astype(np.float32)
        self._transitions = states, actions, following, rewards, ends

    def width(self, batch_size: int) -> int:
        """See `StateReplayBuffer.width`; R."""
        return len(self.counts)

    def draw(
        self, count: int, batch_size: int, chance: np.random.RandomState
    ) -> tuple[IntArray, IntArray, IntArray, Float32Array, Float32Array, FloatArray]:
        """Draw n minibatches.

        Returns:
            (n, R) each, all transitions: states, actions, next states (int64), rewards and ends (float32),
            and what part of a minibatch each makes up (float64). Time-outs are no ends.
        """
        times = systematic_sample(self.counts, batch_size, chance.random_sample(count))
        states, actions, following, rewards, ends = (
            np.broadcast_to(column, times.shape) for column in self._transitions
        )
        return states, actions, following, rewards, ends, times / batch_size

    def get_state(self) -> State:
        """See `ReplayCounts.get_state`."""
        return {"transitions": self._met.real, "rewards": self._met.imag, "counts": self.counts}

    def set_state(self, state: State) -> None:
        """See `ReplayCounts.set_state`."""
        count = len(state["counts"])
        met, counts = np.empty(count, dtype=np.complex128), np.empty(count, dtype=np.int64)
        for name, column in (("transitions", met.real), ("rewards", met.imag), ("counts", counts)):
            fill(column, state[name], name)
        most = self._num_states * self._num_actions * self._num_states * 2
        is_sorted = np.isfinite(met).all() and np.array_equal(np.unique(met), met)
        if not (is_sorted and (met.real >= 0).all() and (met.real < most).all() and (counts > 0).all()):
            raise StateError("transitions must be numbers of this world's, ascending, with their counts")
        self._set(met, counts)
        self.pos = int(self.counts.sum())
