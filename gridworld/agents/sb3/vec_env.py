"""The native batch as SB3 expects a batch: its `VecEnv` interface over a `GridWorldVectorEnv`."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env.base_vec_env import VecEnv, VecEnvIndices, VecEnvObs, VecEnvStepReturn

from gridworld.errors import InputError
from gridworld.observations import ObservationTable
from gridworld.vector_env import GridWorldVectorEnv


class GridWorldVecEnv(VecEnv):
    """Observations looked up in a table, episodes reported in `infos` as SB3's Monitor would.

    At an episode's end, its info has `terminal_observation`, `TimeLimit.truncated` and
    `episode` = {"r": return, "l": length, "t": seconds since the start}; the other infos are empty.
    The batch must reset in the same step, which is how SB3 sees episodes.
    """

    def __init__(self, envs: GridWorldVectorEnv, observation: ObservationTable) -> None:
        if envs.metadata["autoreset_mode"] is not AutoresetMode.SAME_STEP:
            raise InputError("SB3 needs environments made with autoreset_mode='SameStep'")
        self.envs = envs
        self.observation = observation
        self._started = time.time()
        self._returns = np.zeros(envs.num_envs)
        self._lengths = np.zeros(envs.num_envs, dtype=np.int64)
        super().__init__(envs.num_envs, observation.space, envs.single_action_space)

    def reset(self) -> VecEnvObs:
        """Start all episodes; a seed given by `seed()` before is used once."""
        states, _ = self.envs.reset(seed=self._seeds[0])
        self._returns[:] = 0.0
        self._lengths[:] = 0
        self._reset_seeds()
        self._reset_options()
        return self.observation.rows(states)

    def step_async(self, actions: NDArray[Any]) -> None:
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        states, rewards, terminated, truncated, ended = self.envs.step(self._actions)
        self._returns += rewards
        self._lengths += 1
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        dones = terminated | truncated
        if ended:
            over = np.flatnonzero(dones)
            elapsed = round(time.time() - self._started, 6)
            last = self.observation.rows(ended["final_obs"][over])
            for index, observation in zip(over.tolist(), last, strict=True):
                infos[index] = {
                    "terminal_observation": observation,
                    "TimeLimit.truncated": bool(truncated[index] and not terminated[index]),
                    "episode": {
                        "r": float(self._returns[index]),
                        "l": int(self._lengths[index]),
                        "t": elapsed,
                    },
                }
            self._returns[over] = 0.0
            self._lengths[over] = 0
        return self.observation.rows(states), rewards.astype(np.float32), dones, infos

    def close(self) -> None:
        self.envs.close()

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        frames = self.envs.render()
        return [None] * self.num_envs if frames is None else list(frames)

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        return [getattr(self.envs, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        if len(list(self._get_indices(indices))) != self.num_envs:
            raise InputError(f"{attr_name}: the batch has one set of attributes; set it for all environments")
        setattr(self.envs, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        raise InputError(f"{method_name}: the environments of a native batch have no methods of their own")

    def env_is_wrapped(self, wrapper_class: type[Any], indices: VecEnvIndices = None) -> list[bool]:
        """True for Monitor, whose `episode` entries are written here."""
        return [wrapper_class is Monitor] * len(list(self._get_indices(indices)))
