"""Training: the tabulated engine beside stock SB3 on the same batch, and beside SB3 at its defaults."""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import gymnasium as gym
import torch
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.env_util import make_vec_env as dummy_vec_env
from stable_baselines3.common.vec_env import VecEnv

from gridworld.agents.sb3.interop.make_vec_env import make_vec_env
from gridworld.agents.sb3.settings.constructor_arguments import algorithm_and_arguments
from gridworld.agents.sb3.settings.schemas import SB3Config
from gridworld.agents.sb3.tabulated.dqn import TabulatedDQN
from gridworld.agents.sb3.tabulated.ppo import TabulatedPPO
from gridworld.benchmark import peers
from gridworld.benchmark.measure import Comparison, Workload
from gridworld.envs.observations import OneHotObservation

_TABLE = "training, environment steps per second"

PPO_SMALL: dict[str, Any] = {"n_steps": 128, "batch_size": 2048, "n_epochs": 4}  # with 64 environments
PPO_LARGE: dict[str, Any] = {"n_steps": 32, "batch_size": 8192, "n_epochs": 4}  # with 1024
DQN_BATCH: dict[str, Any] = {  # with 64 environments: one update of 512 per step of the batch
    "batch_size": 512,
    "train_freq": 1,
    "learning_starts": 512,
    "buffer_size": 100_000,
    "target_update_interval": 1280,
    "learning_rate": 3e-3,
}


def comparisons(workload: Workload) -> Iterator[Comparison]:
    """PPO and DQN on 5x6, the other tabulated algorithms there, then PPO and DQN on 200x200."""
    torch.set_num_threads(1)
    batch = partial(make_vec_env, n_envs=64)
    ppo, dqn = (
        learner(TabulatedPPO, batch, workload.steps, **PPO_SMALL),
        learner(TabulatedDQN, batch, workload.steps, **DQN_BATCH),
    )
    yield Comparison(
        _TABLE,
        "PPO, 64 envs x 128, batch 2048, 4 epochs",
        ppo,
        "stock SB3, same batch and settings",
        learner(PPO, batch, workload.steps, **PPO_SMALL),
    )
    yield Comparison(
        _TABLE, "the same", ppo, "stock SB3, defaults, 8 envs in DummyVecEnv", sb3_defaults(PPO, 8)
    )
    large = learner(TabulatedPPO, partial(make_vec_env, n_envs=1024), 4 * workload.steps, **PPO_LARGE)
    yield Comparison(
        _TABLE,
        "PPO, 1024 envs x 32, batch 8192, 4 epochs",
        large,
        "NAVIX's compiled PPO, 1024 x 32, Empty-5x5",
        None if peers.why_not("NAVIX") else peers.navix,
        peers.why_not("NAVIX"),
    )
    yield Comparison(
        _TABLE,
        "DQN, 64 envs, an update of 512 per step",
        dqn,
        "stock SB3, same batch and settings",
        learner(DQN, batch, workload.steps, **DQN_BATCH),
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
    for agent in ("a2c", *(("qrdqn", "trpo") if importlib.util.find_spec("sb3_contrib") else ())):
        yield Comparison(
            _TABLE,
            f"{agent}, shipped settings",
            _shipped(agent, "tabulated", workload.steps // 2),
            "stock SB3, same batch and settings",
            _shipped(agent, "stock", workload.steps // 4),
        )
    large_map = partial(make_vec_env, n_envs=64, num_rows=200, num_cols=200)
    for name, ours, algorithm, settings in (
        ("PPO", ppo, TabulatedPPO, PPO_SMALL),
        ("DQN", dqn, TabulatedDQN, DQN_BATCH),
    ):
        yield Comparison(
            _TABLE,
            f"{name}, 64 envs, on 200x200",
            learner(algorithm, large_map, workload.steps // 4, **settings),
            "the same on 5x6",
            ours,
        )


def _shipped(agent: str, engine: str, steps: int) -> Callable[[], float]:
    """Measures an agent as it is shipped, in one of the two loops."""
    from gridworld.config.composition.compose import compose
    from gridworld.config.composition.conf_folder import conf_folder

    config = compose(conf_folder(), [f"agent={agent}", f"agent.engine={engine}"])
    assert isinstance(config.agent, SB3Config)
    algorithm, settings = algorithm_and_arguments(config.agent)
    del settings["policy"]
    return learner(algorithm, partial(make_vec_env, n_envs=config.n_envs), steps, **settings)


def learner(
    algorithm: type[BaseAlgorithm], envs: Callable[[], VecEnv], steps: int, **settings: Any
) -> Callable[[], float]:
    """Measures `learn` on a batch; the first call makes both, and warms up the model."""
    made: list[BaseAlgorithm] = []

    def measure() -> float:
        if not made:
            batch = envs()
            made.append(_model(algorithm, batch, **settings))
            made[0].learn(batch.num_envs * settings.get("n_steps", 16))
        return _steps_per_second(made[0], steps)

    return measure


def sb3_defaults(algorithm: type[BaseAlgorithm], num_envs: int) -> Callable[[], float]:
    """Measures SB3's defaults on `make_vec_env`, over 2048 steps of each environment."""

    def measure() -> float:
        envs = dummy_vec_env(lambda: OneHotObservation(gym.make("GridWorld-v0")), n_envs=num_envs)
        return _steps_per_second(_model(algorithm, envs), 2048 * num_envs)

    return measure


def _model(algorithm: type[BaseAlgorithm], envs: Any, **settings: Any) -> BaseAlgorithm:
    return algorithm("MlpPolicy", envs, seed=0, device="cpu", **settings)


def _steps_per_second(model: BaseAlgorithm, steps: int) -> float:
    started = time.perf_counter()
    before = model.num_timesteps if model.num_timesteps else 0
    model.learn(steps, reset_num_timesteps=False)
    return (model.num_timesteps - before) / (time.perf_counter() - started)
