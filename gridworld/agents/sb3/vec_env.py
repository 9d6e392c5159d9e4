"""The native batch as SB3 expects a batch: its `VecEnv` interface over a `GridWorldVectorEnv`."""

from __future__ import annotations

import time
from collections.abc import Sequence
from os import PathLike
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env.base_vec_env import VecEnv, VecEnvIndices, VecEnvObs, VecEnvStepReturn

from gridworld.base.errors import InputError
from gridworld.base.serialization import independent_generator
from gridworld.config.compose import named_world
from gridworld.envs.inspection import world_of
from gridworld.envs.observations import IMAGE_CELL_SIZE, ObservationTable, make_observation
from gridworld.envs.vector_env import GridWorldVectorEnv, StateArray
from gridworld.world.layout import CLASSIC, Layout
from gridworld.world.mdp import Mdp, taken

_OF_A_BATCH = {"max_episode_steps", "stratified", "render_mode"}  # arguments that no world has
_MASKS = "action_masks"  # asked for by agents that respect them; here nothing is ever forbidden


class GridWorldVecEnv(VecEnv):
    """Observations looked up in a table; infos at an episode's end as of SB3's Monitor and DummyVecEnv.

    Args:
        envs: the batch. It must reset in the same step, which is how SB3 sees episodes.
        observation: the table.
        reward_scale: rewards are multiplied by it; the reported episodes' returns are not.
    """

    def __init__(
        self, envs: GridWorldVectorEnv, observation: ObservationTable, reward_scale: float = 1.0
    ) -> None:
        if envs.metadata["autoreset_mode"] is not AutoresetMode.SAME_STEP:
            raise InputError("SB3 needs environments made with autoreset_mode='SameStep'")
        self.envs = envs
        self.observation = observation
        self._reward_scale = reward_scale
        self._started = time.time()
        super().__init__(envs.num_envs, observation.space, envs.single_action_space)

    @property
    def states(self) -> StateArray:
        return self.envs.states

    def reset(self) -> VecEnvObs:
        """Start all episodes; a seed given by `seed()` before is used once.

        SB3 seeds the action space, from which DQN explores, with the same number as the environments. These
        take an independent generator instead, so that slips and starts do not depend on the actions.
        """
        if self._seeds[0] is not None:
            self.envs.np_random = independent_generator(self._seeds[0])
        states, _ = self.envs.reset()
        self._reset_seeds()
        self._reset_options()
        return self.observation.rows(states)

    def step_async(self, actions: NDArray[Any]) -> None:
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        step = self.envs.advance(self._actions)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        last, elapsed = self.observation.rows(step.reached[step.which]), round(time.time() - self._started, 6)
        shown = [taken(last, at) for at in range(len(step.which))]
        of_each = zip(step.which.tolist(), shown, step.returns.tolist(), step.lengths.tolist(), strict=True)
        for index, observation, episode_return, length in of_each:
            infos[index] = {
                "terminal_observation": observation,
                "TimeLimit.truncated": bool(step.truncated[index] and not step.terminated[index]),
                "episode": {"r": episode_return, "l": length, "t": elapsed},
            }
        rewards = (step.rewards * self._reward_scale).astype(np.float32)
        return self.observation.rows(step.states), rewards, step.terminated | step.truncated, infos

    def close(self) -> None:
        self.envs.close()

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        frames = self.envs.render()
        return [None] * self.num_envs if frames is None else list(frames)

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        return [getattr(self.envs, attr_name)] * len(list(self._get_indices(indices)))

    def has_attr(self, attr_name: str) -> bool:
        return attr_name == _MASKS or super().has_attr(attr_name)

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        if len(list(self._get_indices(indices))) != self.num_envs:
            raise InputError(
                f"{attr_name}: the environments of a native batch share their attributes; set it for all"
            )
        setattr(self.envs, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        if method_name == _MASKS:
            allowed = np.ones(self.envs.mdp.num_actions, dtype=np.bool_)
            return [allowed] * len(list(self._get_indices(indices)))
        raise InputError(f"{method_name}: the environments of a native batch have no individual methods")

    def env_is_wrapped(self, wrapper_class: type[Any], indices: VecEnvIndices = None) -> list[bool]:
        """True for Monitor, whose `episode` entries the infos have."""
        return [wrapper_class is Monitor] * len(list(self._get_indices(indices)))


def make_vec_env(
    env: Any = None,
    n_envs: int = 64,
    observation: str = "one_hot",
    seed: int | None = 0,
    cell_size: int = IMAGE_CELL_SIZE,
    **world: Any,
) -> GridWorldVecEnv:
    """Make a batch of GridWorlds for a model of SB3: one native batch, not `n_envs` environments.

    Args:
        env: what `env=NAME` means on a command line (`classic`, `cliff`, `taxi_v4`, ...) or an id of
            Gymnasium; a compiled world; a map, its file or a `Layout` (`layout=NAME` is the bare map); or an
            environment, a class or a function that makes one, which is compiled. None: `classic`.
        n_envs: how many environments step together.
        observation: `one_hot`, `coordinates`, `image` (for CnnPolicy), `own` or `none` (the state's number).
        seed: of the starts and slips, unless the model has a seed, which SB3 gives to its environments; None:
            another one at every call.
        cell_size: pixels a cell, of the images.
        world: settings of the world in place of its own (`slip`, `step_reward`, ...), and other arguments of
            `GridWorldVectorEnv`: `max_episode_steps`, `stratified`, `render_mode`.

    Returns:
        An SB3 `VecEnv`, which reports episodes as SB3's `Monitor` does.

    Raises:
        InputError: an argument that makes no world or no batch.

    Example:
        >>> from stable_baselines3 import PPO
        >>> model = PPO("MlpPolicy", make_vec_env("four_rooms", n_envs=8, slip=0.1))
    """
    if described := {"layout", "mdp"} & set(world):
        if env is not None:
            named = [f"env={str(env)[:50]}", *(f"{key}={str(world[key])[:50]}" for key in sorted(described))]
            raise InputError(f"{', '.join(named)}: are {len(named)} worlds; name one of them")
    else:
        env = CLASSIC if env is None else env
        if isinstance(env, str):
            settings = {name: world.pop(name) for name in set(world) - _OF_A_BATCH}
            world["mdp"] = named_world(env, **settings)
        elif isinstance(env, Layout | PathLike):
            world["layout"] = env
        else:
            world["mdp"] = env if isinstance(env, Mdp) else world_of(env)
    if isinstance(mdp := world.get("mdp"), Mdp):
        world.setdefault("max_episode_steps", mdp.default_step_limit)
    envs = GridWorldVectorEnv(n_envs, autoreset_mode=AutoresetMode.SAME_STEP, **world)
    batch = GridWorldVecEnv(envs, make_observation(envs.mdp, observation, cell_size))
    batch.seed(seed)
    return batch
