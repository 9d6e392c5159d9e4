"""Populations: a sweep's runs that train together, compared with one run alone."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Iterator
from functools import partial

import torch
from benchmarks import peers
from benchmarks.end_to_end import run, train
from benchmarks.measure import Comparison, Workload
from benchmarks.training import PPO_LARGE, steps_per_second

_LARGE_ENVS, _LARGE_ROLLOUTS = 1024, 16


def comparisons(workload: Workload) -> Iterator[Comparison]:
    """Whole commands, then training alone, at the shipped settings and with large batches."""
    torch.set_num_threads(1)
    seeds = workload.sweep_seeds
    for agent, count in (("ppo", seeds), ("dqn", seeds), ("a2c", seeds), ("ppo", 5 * seeds)):
        sweep = train("-m", f"agent={agent}", f"seed=range({count})")
        yield Comparison(
            "whole command with all pictures, seconds",
            f"train.py -m agent={agent} 'seed=range({count})'",
            partial(_seconds, sweep),
            f"train.py agent={agent}",
            partial(_seconds, train(f"agent={agent}")),
        )
        if count == seeds and agent != "a2c":
            yield Comparison(
                "whole command with all pictures, seconds",
                "the same",
                partial(_seconds, sweep),
                "run by run in one process, hydra.sweeper.population=1 hydra/launcher=basic",
                partial(_seconds, [*sweep, "hydra.sweeper.population=1", "hydra/launcher=basic"]),
            )
    for agent in ("ppo", "dqn", "a2c"):
        yield Comparison(
            "training alone, environment steps per second",
            f"{agent}, {seeds} seeds as one population",
            partial(_shipped, agent, seeds),
            "one seed",
            partial(_shipped, agent, 1),
        )
    cores = os.cpu_count() or 1
    each = max(1, seeds // cores)
    yield Comparison(
        "training alone, environment steps per second",
        f"ppo, {_LARGE_ENVS} envs x 32, {each * cores} seeds on {cores} cores",
        partial(_on_all_cores, cores, each),
        f"NAVIX's compiled PPO, {_LARGE_ENVS} x 32, vmap over as many seeds",
        None if peers.why_not("NAVIX") else partial(peers.navix, each * cores),
        peers.why_not("NAVIX"),
    )


def _seconds(command: list[str]) -> float:
    return run(command)[0]


def _shipped(agent: str, seeds: int) -> float:
    """Environment steps a second of so many seeds of an agent as it is shipped."""
    return steps_per_second([(f"agent={agent}", f"seed={seed}") for seed in range(seeds)])


def _on_all_cores(cores: int, seeds: int) -> float:
    """Environment steps a second of as many populations as there are cores."""
    context = multiprocessing.get_context("spawn")
    with context.Pool(cores) as pool:
        return sum(pool.map(_large, [seeds] * cores, chunksize=1))


def _large(seeds: int) -> float:
    torch.set_num_threads(1)
    steps = f"total_timesteps={_LARGE_ENVS * 32 * _LARGE_ROLLOUTS}"
    return steps_per_second([(*PPO_LARGE, steps, f"seed={seed}") for seed in range(seeds)])
