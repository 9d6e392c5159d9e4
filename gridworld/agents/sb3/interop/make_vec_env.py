"""The native batch for programs that use SB3 by themselves."""

from __future__ import annotations

import inspect
from os import PathLike
from typing import Any

from gymnasium.vector import AutoresetMode

from gridworld.agents.sb3.vec_env import GridWorldVecEnv
from gridworld.envs.observations import IMAGE_CELL_SIZE, make_observation
from gridworld.envs.vector_env import GridWorldVectorEnv
from gridworld.errors import InputError
from gridworld.world.layout import CLASSIC, Layout

_NOT_OF_THE_WORLD = ("self", "num_envs", "layout", "autoreset_mode", "cell_size")
_WORLD = [
    name
    for name in inspect.signature(GridWorldVectorEnv.__init__).parameters
    if name not in _NOT_OF_THE_WORLD
]


def make_vec_env(
    layout: str | PathLike[str] | Layout = CLASSIC,
    n_envs: int = 64,
    observation: str = "one_hot",
    seed: int | None = 0,
    cell_size: int = IMAGE_CELL_SIZE,
    **world: Any,
) -> GridWorldVecEnv:
    """Make a batch of GridWorlds for a model of SB3: one native batch, not `n_envs` environments.

    Args:
        layout: the name of a map, its file, or a `Layout`.
        n_envs: how many environments step together.
        observation: `one_hot`, `coordinates`, `image` (for CnnPolicy), `own` or `none` (the state's number).
        seed: of the starts and slips, unless the model has a seed, which SB3 gives to its environments; None:
            another one at every call.
        cell_size: pixels a cell, of the images.
        world: other arguments of `GridWorldVectorEnv`: `slip`, `step_reward`, `goal_reward`, `trap_reward`,
            `max_episode_steps`, `num_rows`, `num_cols`, `mdp`, `render_mode`, `stratified`.

    Returns:
        An SB3 `VecEnv`, which reports episodes as SB3's `Monitor` does.

    Raises:
        InputError: an argument that makes no world or no batch.

    Example:
        >>> from stable_baselines3 import PPO
        >>> model = PPO("MlpPolicy", make_vec_env("four_rooms", n_envs=8, slip=0.1))
    """
    for name in world:
        if name not in _WORLD:
            raise InputError(
                f"{name}={world[name]!r}: is no argument of a world; there are {', '.join(_WORLD)}"
            )
    envs = GridWorldVectorEnv(n_envs, layout=layout, autoreset_mode=AutoresetMode.SAME_STEP, **world)
    batch = GridWorldVecEnv(envs, make_observation(envs.mdp, observation, cell_size))
    batch.seed(seed)
    return batch
