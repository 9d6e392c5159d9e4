"""Solving, and Gymnasium's own environments: compiling, and training with SB3 with and without our batch."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import gymnasium as gym
import torch
from benchmarks import peers
from benchmarks.measure import Comparison, Workload
from benchmarks.training import DQN_BATCH, PPO_LARGE, STOCK, learner, sb3_learner
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.env_util import make_vec_env as dummy_vec_env

from gridworld.config.worlds import GymnasiumConfig
from gridworld.envs.vector_env import GridWorldVectorEnv
from gridworld.world.solver import value_iteration

WORLDS = ("FrozenLake-v1", "CliffWalking-v1", "Taxi-v4")
ENVS = 1024
SIDES = (100, 300)
# Each transition is replayed 8 times, as by SB3's defaults. With 8 environments, rollouts are as large, and
# as many transitions lie between two updates.
DQN_LARGE = (*DQN_BATCH, f"n_envs={ENVS}", f"agent.batch_size={8 * ENVS}")
_PPO: dict[str, Any] = {"n_steps": 32 * ENVS // 8, "batch_size": 8192, "n_epochs": 4}
_DQN: dict[str, Any] = {
    "batch_size": 8 * ENVS,
    "train_freq": ENVS // 8,
    "learning_starts": 512,
    "buffer_size": 100_000,
    "target_update_interval": 1280,
    "learning_rate": 3e-3,
}
LEARNERS: tuple[tuple[type[BaseAlgorithm], tuple[str, ...], dict[str, Any]], ...] = (
    (PPO, PPO_LARGE, _PPO),
    (DQN, DQN_LARGE, _DQN),
)


def comparisons(workload: Workload) -> Iterator[Comparison]:
    """Solving slippery maps, compiling each world, then PPO and DQN on each."""
    torch.set_num_threads(1)
    for side in SIDES:
        mdp = GridWorldVectorEnv(1, num_rows=side, num_cols=side, slip=0.1).mdp
        yield Comparison(
            "solving, seconds",
            f"{side}x{side} cells, slip 0.1",
            partial(_seconds, partial(value_iteration, mdp, 0.99)),
            "mdpsolver, modified policy iteration",
            None if peers.why_not("MDPSOLVER") else partial(peers.mdpsolver, mdp),
            peers.why_not("MDPSOLVER"),
        )
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
        usual = partial(dummy_vec_env, world.id, n_envs=8, env_kwargs={"max_episode_steps": limit})
        for stock, words, of_8 in LEARNERS:
            words = (*words, f"env.max_episode_steps={limit}")
            for peer, theirs in (
                ("8 envs in DummyVecEnv", sb3_learner(stock, usual, workload.steps, **of_8)),
                ("same batch", learner((*words, STOCK), workload.steps, mdp)),
            ):
                yield Comparison(
                    "training, environment steps per second",
                    f"{stock.__name__}, {world.id}",
                    learner(words, 4 * workload.steps, mdp),
                    f"stock SB3, same settings, {peer}",
                    theirs,
                )


def _seconds(call: Callable[[], object]) -> float:
    started = time.perf_counter()
    call()
    return time.perf_counter() - started
