"""Measure how fast this is beside a named peer, in turn in the same run; only ratios are worth quoting."""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

from gridworld.env import GridWorldEnv
from gridworld.observations import VectorOneHotObservation
from gridworld.vector_env import GridWorldVectorEnv

Measure = Callable[[], float]  # environment steps per second, measured once


@dataclass(frozen=True)
class Comparison:
    """One row: ours against a peer."""

    name: str
    peer: str
    ours: Measure
    theirs: Measure


def main(arguments: Sequence[str]) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="benchmark.py", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a few seconds: fewer and shorter repetitions")
    quick = parser.parse_args(arguments).quick
    repetitions, seconds = (3, 0.1) if quick else (7, 0.5)
    print(f"environment steps per second, medians of {repetitions} repetitions of {seconds} s, one core")
    print(f"{'':<34}{'ours':>14}{'peer':>14}{'ratio':>9}  peer")
    for comparison in comparisons(seconds):
        ours, theirs, ratio = compare(comparison, repetitions)
        print(f"{comparison.name:<34}{ours:>14,.0f}{theirs:>14,.0f}{ratio:>8.1f}x  {comparison.peer}")


def compare(comparison: Comparison, repetitions: int) -> tuple[float, float, float]:
    """Medians of ours, of theirs, and of the ratio pair by pair: a machine's drift hits both alike."""
    pairs = [(comparison.ours(), comparison.theirs()) for _ in range(repetitions)]
    ours, theirs = (statistics.median(values) for values in zip(*pairs, strict=True))
    return ours, theirs, statistics.median(one / other for one, other in pairs)


def comparisons(seconds: float) -> list[Comparison]:
    """All rows."""
    lake = gym.make("FrozenLake-v1").unwrapped
    lakes = gym.vector.SyncVectorEnv([lambda: gym.make("FrozenLake-v1")] * 64)
    peer = "Gymnasium's FrozenLake-v1 in SyncVectorEnv(64)"
    rows = [
        Comparison(
            "stepping, one environment",
            "Gymnasium's FrozenLake-v1",
            lambda: step_one(GridWorldEnv(), seconds),
            lambda: step_one(lake, seconds),
        )
    ]
    rows += [
        Comparison(f"stepping, {size} environments", peer, *_batched(size, lakes, seconds))
        for size in (64, 1024, 16384)
    ]
    rows.append(
        Comparison(
            "stepping, 1024, one-hot rows", peer, *_batched(1024, lakes, seconds, VectorOneHotObservation)
        )
    )
    return rows


def _batched(
    size: int, lakes: Any, seconds: float, wrap: Callable[[Any], Any] = lambda envs: envs
) -> tuple[Measure, Measure]:
    return (
        lambda: step_batch(wrap(GridWorldVectorEnv(size)), seconds),
        lambda: step_batch(lakes, seconds),
    )


def step_one(env: Any, seconds: float) -> float:
    """Random actions, drawn beforehand, with a reset after each episode."""
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
    """Random actions, drawn beforehand; the batch resets itself."""
    actions = np.random.default_rng(0).integers(4, size=(32, envs.num_envs))
    envs.reset(seed=0)
    count, started = 0, time.perf_counter()
    while time.perf_counter() - started < seconds:
        for batch in actions:
            envs.step(batch)
        count += actions.size
    return count / (time.perf_counter() - started)
