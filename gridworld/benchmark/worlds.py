"""Gymnasium's own environments: compiling them, and training there beside SB3 with and without our batch."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import gymnasium as gym
import torch
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.env_util import make_vec_env as dummy_vec_env

from gridworld.agents.sb3.interop.make_vec_env import make_vec_env
from gridworld.agents.sb3.tabulated.dqn import TabulatedDQN
from gridworld.agents.sb3.tabulated.ppo import TabulatedPPO
from gridworld.benchmark.measure import Comparison, Workload
from gridworld.benchmark.training import DQN_BATCH, PPO_LARGE, learner
from gridworld.config.worlds import GymnasiumConfig

WORLDS = ("FrozenLake-v1", "CliffWalking-v1", "Taxi-v4")
ENVS = 1024
# Each transition is replayed 8 times, as by SB3's defaults. With 8 environments, rollouts are as large, and
# as many transitions lie between two updates.
DQN_LARGE: dict[str, Any] = {**DQN_BATCH, "batch_size": 8 * ENVS}
LEARNERS: tuple[tuple[type[BaseAlgorithm], type[BaseAlgorithm], dict[str, Any], str], ...] = (
    (TabulatedPPO, PPO, PPO_LARGE, "n_steps"),
    (TabulatedDQN, DQN, DQN_LARGE, "train_freq"),
)


def comparisons(workload: Workload) -> Iterator[Comparison]:
    """Compiling each world, then PPO and DQN on each."""
    torch.set_num_threads(1)
    worlds = [GymnasiumConfig(id=name) for name in WORLDS]
    for world in worlds:
        yield Comparison(
            "compiling, seconds",
            world.id,
            partial(_seconds, world.compile),
            f"gymnasium.make({world.id!r})",
            partial(_seconds, partial(gym.make, world.id)),
        )
    for world in worlds:
        mdp = world.compile()
        limit = world.step_limit(mdp)
        batch = partial(make_vec_env, n_envs=ENVS, mdp=mdp, max_episode_steps=limit)
        usual = partial(dummy_vec_env, world.id, n_envs=8, env_kwargs={"max_episode_steps": limit})
        for fast, stock, settings, per_env in LEARNERS:
            ours = learner(fast, batch, 4 * workload.steps, **settings)
            of_8 = {**settings, per_env: settings[per_env] * ENVS // 8}
            for peer, theirs in (
                ("8 envs in DummyVecEnv", learner(stock, usual, workload.steps, **of_8)),
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
