"""Training: the engine compared with stock SB3 on the same batch, and with SB3 at its defaults."""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import gymnasium as gym
import torch
from benchmarks import peers
from benchmarks.measure import Comparison, Workload
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.env_util import make_vec_env as dummy_vec_env
from stable_baselines3.common.vec_env import VecEnv

from gridworld.agents import Learning, learn_together
from gridworld.envs.observations import OneHotObservation
from gridworld.training.setup import make_context
from gridworld.world.mdp import Mdp

_TABLE = "training, environment steps per second"

# SB3's defaults but for these.
PPO_SMALL = (
    *("agent=ppo_sb3_defaults", "n_envs=64", "agent.n_steps=128", "agent.batch_size=2048"),
    "agent.n_epochs=4",
)
PPO_LARGE = (
    *("agent=ppo_sb3_defaults", "n_envs=1024", "agent.n_steps=32", "agent.batch_size=8192"),
    "agent.n_epochs=4",
)
DQN_BATCH = (  # one update of 512 per step of the batch
    *("agent=dqn_sb3_defaults", "n_envs=64", "agent.batch_size=512", "agent.train_freq=1"),
    *("agent.learning_starts=512", "agent.buffer_size=100000", "agent.target_update_interval=1280"),
    "agent.learning_rate=3e-3",
)
STOCK = "agent.engine=stock"
LARGE_MAP = ("env.num_rows=200", "env.num_cols=200", "env.max_episode_steps=100")


def comparisons(workload: Workload) -> Iterator[Comparison]:
    """PPO and DQN on 5x6, the engine's other algorithms there, then PPO and DQN on 200x200."""
    torch.set_num_threads(1)
    ppo, dqn = (learner(words, workload.steps) for words in (PPO_SMALL, DQN_BATCH))
    yield Comparison(
        _TABLE,
        "PPO, 64 envs x 128, batch 2048, 4 epochs",
        ppo,
        "stock SB3, same batch and settings",
        learner((*PPO_SMALL, STOCK), workload.steps),
    )
    yield Comparison(
        _TABLE, "the same", ppo, "stock SB3, defaults, 8 envs in DummyVecEnv", sb3_defaults(PPO, 8)
    )
    yield Comparison(
        _TABLE,
        "PPO, 1024 envs x 32, batch 8192, 4 epochs",
        learner(PPO_LARGE, 4 * workload.steps),
        "NAVIX's compiled PPO, 1024 x 32, Empty-5x5",
        None if peers.why_not("NAVIX") else peers.navix,
        peers.why_not("NAVIX"),
    )
    yield Comparison(
        _TABLE,
        "DQN, 64 envs, an update of 512 per step",
        dqn,
        "stock SB3, same batch and settings",
        learner((*DQN_BATCH, STOCK), workload.steps),
    )
    yield Comparison(_TABLE, "the same", dqn, "stock SB3, defaults, one env", sb3_defaults(DQN, 1))
    for name, ours, num_envs in (("PPO", ppo, 8), ("DQN", dqn, 1)):
        yield Comparison(
            _TABLE,
            f"the same {name}",
            ours,
            f"SBX's {name}, defaults, {num_envs} envs in DummyVecEnv",
            None if peers.why_not("SBX") else partial(peers.sbx, name, num_envs),
            peers.why_not("SBX"),
        )
    for agent in ("a2c", *(("qrdqn",) if importlib.util.find_spec("sb3_contrib") else ())):
        yield Comparison(
            _TABLE,
            f"{agent}, shipped settings",
            learner((f"agent={agent}",), workload.steps // 2),
            "stock SB3, same batch and settings",
            learner((f"agent={agent}", STOCK), workload.steps // 4),
        )
    for name, words in (("PPO", PPO_SMALL), ("DQN", DQN_BATCH)):
        yield Comparison(
            _TABLE,
            f"{name}, 64 envs, on 200x200",
            learner((*words, *LARGE_MAP), workload.steps // 4),
            "stock SB3, same batch and settings",
            learner((*words, *LARGE_MAP, STOCK), workload.steps // 8),
        )


def learner(words: Sequence[str], steps: int, mdp: Mdp | None = None) -> Callable[[], float]:
    """Measures the training of an agent, by the words of its command line; `mdp` in place of its world."""
    return partial(steps_per_second, [(*words, f"total_timesteps={steps}", "tuned=none")], mdp)


def steps_per_second(commands: Sequence[Sequence[str]], mdp: Mdp | None = None) -> float:
    """Environment steps a second of agents that learn together, without evaluations."""
    from gridworld.config.compose import compose

    learnings, made = [], [0] * len(commands)
    for number, words in enumerate(commands):
        config = compose(words)
        world = mdp or config.env.compile()
        context = make_context(config, world)
        agent = config.agent.build(context)
        learnings.append(Learning(agent, config.total_timesteps, partial(_note, made, number)))
    started = time.perf_counter()
    errors = [error for error in learn_together(learnings) if error is not None]
    seconds = time.perf_counter() - started
    if errors:
        raise errors[0]
    return sum(made) / seconds


def _note(made: list[int], number: int, steps: int) -> int:
    made[number] = steps
    return 2**62  # the steps by which it is to be called again


def sb3_defaults(algorithm: type[BaseAlgorithm], num_envs: int) -> Callable[[], float]:
    """Measures SB3's defaults on `make_vec_env`, over 2048 steps of each environment."""

    def make() -> VecEnv:
        return dummy_vec_env(lambda: OneHotObservation(gym.make("GridWorld-v0")), n_envs=num_envs)

    return sb3_learner(algorithm, make, 2048 * num_envs)


def sb3_learner(
    algorithm: type[BaseAlgorithm], envs: Callable[[], VecEnv], steps: int, **settings: Any
) -> Callable[[], float]:
    """Measures SB3's own `learn` on environments."""

    def measure() -> float:
        model = algorithm("MlpPolicy", envs(), seed=0, device="cpu", **settings)
        started = time.perf_counter()
        model.learn(steps)
        return model.num_timesteps / (time.perf_counter() - started)

    return measure
