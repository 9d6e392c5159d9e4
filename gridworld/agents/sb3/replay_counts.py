"""A replay buffer for finite worlds: each transition once, with how often it was met.

So nothing is forgotten, in little memory. A minibatch is drawn by systematic sampling, see
`engine.replay.systematic_sample`: the mean is that of uniform sampling, the noise far smaller. It works in
any model of Stable-Baselines3 that replays single steps:

    DQN("MlpPolicy", env, replay_buffer_class=ReplayCounts)
"""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from gridworld.base.errors import InputError
from gridworld.base.serialization import State, fill
from gridworld.engine.replay import systematic_sample
from gridworld.world.mdp import IntArray

_ROOM = 256  # transitions, at first
_COLUMNS = ("observations", "next_observations", "actions", "rewards", "dones", "counts")


class ReplayCounts(ReplayBuffer):
    """SB3's replay buffer with counts of distinct transitions; their rewards count as a part of them.

    Its arguments are SB3's; `buffer_size` has no effect.
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        device: Any = "auto",
        n_envs: int = 1,
        **options: Any,
    ) -> None:
        if options.get("optimize_memory_usage"):
            raise InputError(
                "optimize_memory_usage=true: ReplayCounts stores each transition once; set it to false"
            )
        super().__init__(_ROOM, observation_space, action_space, device, 1, **options)
        self.counts: IntArray = np.zeros(self.buffer_size, dtype=np.int64)
        self._rows: dict[bytes, int] = {}

    def reset(self) -> None:
        super().reset()
        self.counts[:] = 0
        self._rows = {}

    def add(self, obs: Any, next_obs: Any, action: Any, reward: Any, done: Any, infos: Any) -> None:
        for index, info in enumerate(infos):
            if self.pos == self.buffer_size:
                self.buffer_size *= 2
                for name in _COLUMNS:
                    array = getattr(self, name)
                    setattr(self, name, np.concatenate([array, np.zeros_like(array)]))
            for name, number in zip(_COLUMNS, (obs, next_obs, action, reward), strict=False):
                getattr(self, name)[self.pos, 0] = number[index]
            truncated = self.handle_timeout_termination and info.get("TimeLimit.truncated", False)
            self.dones[self.pos, 0] = done[index] and not truncated
            row = self._rows.setdefault(self._key(self.pos), self.pos)
            self.pos = len(self._rows)
            self.counts[row] += 1

    def _key(self, row: int) -> bytes:
        return b"".join(getattr(self, name)[row].tobytes() for name in _COLUMNS[:-1])

    def get_state(self) -> State:
        return {name: getattr(self, name)[: self.pos] for name in _COLUMNS}

    def set_state(self, state: State) -> None:
        count = len(state["counts"])
        for name in _COLUMNS:
            now = getattr(self, name)
            column = np.zeros((max(count, self.buffer_size), *now.shape[1:]), dtype=now.dtype)
            fill(column[:count], state[name], name)
            setattr(self, name, column)
        self.pos, self.buffer_size = count, len(self.counts)
        self._rows = {self._key(row): row for row in range(count)}

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> ReplayBufferSamples:
        """See SB3's `ReplayBuffer.sample`; the transitions are in the order in which they were met first."""
        (times,) = systematic_sample(self.counts[: self.pos], batch_size, np.random.random_sample(1))
        return self._get_samples(np.repeat(np.arange(self.pos), times), env)

    def _get_samples(self, batch_inds: IntArray, env: VecNormalize | None = None) -> ReplayBufferSamples:
        data = (
            self._normalize_obs(self.observations[batch_inds, 0], env),
            self.actions[batch_inds, 0],
            self._normalize_obs(self.next_observations[batch_inds, 0], env),
            self.dones[batch_inds],
            self._normalize_reward(self.rewards[batch_inds], env),
        )
        return ReplayBufferSamples(*map(self.to_torch, data))
