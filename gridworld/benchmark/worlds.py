"""Gymnasium's own environments: compiling them, and training there beside SB3 with and without our batch."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import gymnasium as gym
import torch
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.env_util import make_vec_env as dummy_vec_env

from gridworld.agents.sb3.interop.make_vec_env import make_vec_env
from gridworld.agents.sb3.tabulated.dqn import TabulatedDQN
from gridworld.agents.sb3.tabulated.ppo import TabulatedPPO
from gridworld.benchmark.measure import Comparison, Workload
from gridworld.benchmark.training import DQN_BATCH, PPO_SMALL, learner
from gridworld.config.worlds import GymnasiumConfig

_WORLDS = [GymnasiumConfig(id=name) for name in ("FrozenLake-v1", "CliffWalking-v1", "Taxi-v4")]
# With 8 environments in place of 64: rollouts as large, and as many transitions an update.
_PPO_OF_8: dict[str, Any] = {**PPO_SMALL, "n_steps": 8 * PPO_SMALL["n_steps"]}
_DQN_OF_8: dict[str, Any] = {**DQN_BATCH, "train_freq": 8}


def comparisons(workload: Workload) -> Iterator[Comparison]:
    """Compiling each world, then PPO and DQN on each."""
    torch.set_num_threads(1)
    for world in _WORLDS:
        make = partial(gym.make, world.id)
        name = f"gymnasium.make({world.id!r})"
        yield Comparison(
            "compiling, seconds", world.id, partial(_seconds, world.compile), name, partial(_seconds, make)
        )
    for world in _WORLDS:
        mdp = world.compile()
        limit = world.step_limit(mdp)
        batch = partial(make_vec_env, n_envs=64, mdp=mdp, max_episode_steps=limit)
        usual = partial(dummy_vec_env, world.id, n_envs=8, env_kwargs={"max_episode_steps": limit})
        for fast, stock, settings, settings_of_8 in (
            (TabulatedPPO, PPO, PPO_SMALL, _PPO_OF_8),
            (TabulatedDQN, DQN, DQN_BATCH, _DQN_OF_8),
        ):
            ours = learner(fast, batch, workload.steps, **settings)
            for peer, theirs in (
                ("8 envs in DummyVecEnv", learner(stock, usual, workload.steps // 8, **settings_of_8)),
                ("same batch", learner(stock, batch, workload.steps, **settings)),
            ):
                yield Comparison(
                    "training, environment steps per second",
                    f"{stock.__name__}, {world.id}",
                    ours,
                    f"stock SB3, same settings, {peer}",
                    theirs,
                )


def _seconds(call: Callable[[], object]) -> float:
    started = time.perf_counter()
    call()
    return time.perf_counter() - started
