"""Worlds of one's own: an environment's as exact tables, and tables as a batch of environments."""

from __future__ import annotations

from typing import Any

from gridworld.envs.inspection import world_of
from gridworld.envs.vector_env import GridWorldVectorEnv
from gridworld.errors import InputError
from gridworld.world.grid import GridMdp
from gridworld.world.mdp import Mdp


def compile_env(env: Any) -> Mdp:
    """Compile an environment into the tables of its world. The environment is left as it is.

    Args:
        env: an environment of Gymnasium with a transition table (`P` and `initial_state_distrib`: FrozenLake,
            CliffWalking, Taxi and their like), a GridWorld, or a batch of them, of Gymnasium or SB3. Wrappers
            that transform rewards or actions by a function are compiled into the tables.

    Returns:
        The world, with the environment's step limit as `max_episode_steps`; a GridWorld's own world.

    Raises:
        InputError: no table; an environment whose steps are not those of its table; or a wrapper that may
            change the task in an unknown way.

    Example:
        >>> import gymnasium
        >>> mdp = compile_env(gymnasium.make("FrozenLake-v1"))
        >>> mdp.name, mdp.num_states, mdp.action_names, mdp.max_episode_steps
        ('FrozenLake-v1', 16, ('left', 'down', 'right', 'up'), 100)
    """
    return world_of(env)


def make_vec(mdp: Mdp, num_envs: int = 1, **kwargs: Any) -> GridWorldVectorEnv:
    """Make a batch of environments on one world, as Gymnasium's `make_vec` does for an id.

    An observation is a state. The source's own observation of it is `mdp.number[state]`, which is the same
    but for further ends, see `gridworld.world.outcomes`.

    Args:
        mdp: the world.
        num_envs: how many.
        kwargs: further arguments of `GridWorldVectorEnv`. Without `max_episode_steps`, the step limit is the
            world's own, or none; of a map, 100.

    Raises:
        InputError: no world, or arguments that make no batch.

    Example:
        >>> import gymnasium
        >>> env = make_vec(compile_env(gymnasium.make("Taxi-v4")), num_envs=1000)
        >>> states, _ = env.reset(seed=0)
        >>> states, rewards, terminated, truncated, infos = env.step(env.action_space.sample())
    """
    if not isinstance(mdp, Mdp):
        raise InputError(f"mdp={str(mdp)[:50]}: must be a compiled world, as `compile_env` makes one")
    if not isinstance(mdp, GridMdp):
        kwargs.setdefault("max_episode_steps", mdp.max_episode_steps)
    return GridWorldVectorEnv(num_envs, mdp=mdp, **kwargs)
