"""Stepping alone, with random actions drawn beforehand."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from benchmarks import peers
from benchmarks.measure import Comparison, Workload

from gridworld.envs.env import GridWorldEnv
from gridworld.envs.observations import VectorOneHotObservation
from gridworld.envs.vector_env import GridWorldVectorEnv

_TABLE = "stepping, environment steps per second"
_PEER = "Gymnasium's FrozenLake-v1"


def comparisons(workload: Workload) -> Iterator[Comparison]:
    """The single environment and batches, of states and of one-hot rows, compared with FrozenLakes."""
    lake: Any = gym.make("FrozenLake-v1").unwrapped
    lakes = gym.vector.SyncVectorEnv([lambda: gym.make("FrozenLake-v1")] * 64)

    def theirs() -> float:
        return step_batch(lakes, workload.seconds)

    def ours(size: int, wrap: Callable[[Any], Any], **arguments: Any) -> Callable[[], float]:
        return lambda: step_batch(wrap(GridWorldVectorEnv(size, **arguments)), workload.seconds)

    yield Comparison(
        _TABLE,
        "one environment",
        lambda: step_one(GridWorldEnv(), workload.seconds),
        _PEER,
        lambda: step_one(lake, workload.seconds),
    )
    for size in (64, 1024, 16384):
        for observation, wrap in (("states", _as_it_is), ("one-hot", VectorOneHotObservation)):
            yield Comparison(
                _TABLE,
                f"{size} environments, {observation}",
                ours(size, wrap),
                f"{_PEER}, SyncVectorEnv(64)",
                theirs,
            )
        yield Comparison(
            _TABLE,
            f"{size} environments, states",
            ours(size, _as_it_is),
            f"EnvPool's FrozenLake-v1, {size}, two threads",
            None if peers.why_not("ENVPOOL") else partial(peers.envpool, size, workload.seconds),
            peers.why_not("ENVPOOL"),
        )
    yield Comparison(
        _TABLE,
        "1024 environments, states, 200x200",
        ours(1024, _as_it_is, num_rows=200, num_cols=200),
        "the same on 5x6",
        ours(1024, _as_it_is),
    )


def step_one(env: Any, seconds: float) -> float:
    """Steps per second, with a reset after each episode."""
    actions = np.random.default_rng(0).integers(4, size=4096).tolist()
    env.reset(seed=0)
    count, started = 0, time.perf_counter()
    while time.perf_counter() - started < seconds:
        for action in actions:
            _, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                env.reset()
        count += len(actions)
    return count / (time.perf_counter() - started)


def step_batch(envs: Any, seconds: float) -> float:
    """Steps per second of all environments together; the batch resets itself."""
    actions = np.random.default_rng(0).integers(4, size=(32, envs.num_envs))
    envs.reset(seed=0)
    count, started = 0, time.perf_counter()
    while time.perf_counter() - started < seconds:
        for batch in actions:
            envs.step(batch)
        count += actions.size
    return count / (time.perf_counter() - started)


def _as_it_is(envs: Any) -> Any:
    return envs
