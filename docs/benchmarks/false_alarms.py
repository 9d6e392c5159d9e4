"""How rarely a right implementation fails a probe: a bound from how far it stays from each threshold.

A trial shows which share of the way to its threshold an algorithm came: 1 or more has failed. With mean m
and variance v of this share over classes and seeds, Cantelli's inequality bounds the chance p of a failure by
v / (v + (1 - m)²), whatever its distribution. A probe fails with two failures of three, so with a probability
of at most 3 p².

`python docs/benchmarks/false_alarms.py 10` takes ten seeds of each class, a minute each, in the loop that
gives the same as the library's own and is faster.
"""

import dataclasses
import itertools
import sys
from unittest.mock import patch

import numpy as np

from gridworld.checking import probes as expect
from gridworld.checking.probes import PROBES, Probe, Trained
from gridworld.checking.training import settings, subject, train
from gridworld.world.solver import solved

CLASSES = (
    *(f"stable_baselines3.{name}" for name in ("DQN", "PPO", "A2C")),
    *(f"sb3_contrib.{name}" for name in ("QRDQN", "TRPO")),
)
_FIRST_SEED = 1000


def cantelli(shares: np.ndarray) -> float:
    """The bound on the chance that a share is 1 or more."""
    mean, variance = float(shares.mean()), float(shares.var(ddof=1))
    return 1.0 if mean >= 1 else variance / (variance + (1 - mean) ** 2)


def of_choice(trained: Trained) -> float:
    """Of a Q: how much of the exact gap is gone; of a policy: how much of the way from 1 to 1/2."""
    best, last = solved(trained.mdp, trained.gamma), trained.last
    live = np.flatnonzero(trained.mdp.reachable & ~trained.mdp.terminal & ~best.optimal.all(axis=1))
    table = last.sampled if last.q is None else last.q

    def gap(values: np.ndarray) -> np.ndarray:
        right = np.where(best.optimal, values, -np.inf).max(axis=1)
        return np.asarray((right - np.where(best.optimal, -np.inf, values).max(axis=1))[live])

    return float((1 - gap(table) / (1.0 if last.q is None else gap(best.q))).max(initial=0.0))


def share(probe: Probe, trained: Trained) -> float:
    """How far a trial came on the way to the threshold: by what all tolerances may be multiplied at least."""
    low, high = 0.0, 2.0
    for _ in range(12):
        middle = (low + high) / 2
        tolerances = {
            "TOLERANCE": middle * expect.TOLERANCE,
            "PROBABILITY": middle * expect.PROBABILITY,
            "LEAST_BEST": 1 - middle * (1 - expect.LEAST_BEST),
        }
        with patch.multiple(expect, **tolerances):
            try:
                probe.holds(trained)
                high = middle
            except expect.UnmetError:
                low = middle
    chooses = probe.holds in (expect.optimal, expect.optimal_with_values)
    return max(high, of_choice(trained)) if chooses else high


def shares(name: str, seeds: range) -> dict[str, np.ndarray]:
    """Those of a class on all probes, (seeds,) each."""
    found: dict[str, list[float]] = {}
    for _, group in itertools.groupby(PROBES, lambda probe: probe.training):
        probes = list(group)
        chosen = settings(subject(name), probes[0], {})
        if chosen is None:
            continue
        config = dataclasses.replace(chosen[0], engine="tabulated")
        for seed in seeds:
            trained = train(
                config, probes[0].world, probes[0].gamma, chosen[1].num_envs, chosen[1].steps, seed
            )
            for probe in probes:
                found.setdefault(probe.name, []).append(share(probe, probe.asked(trained)))
    return {name: np.array(each) for name, each in found.items()}


def main(trials: int) -> None:
    """Print how far right classes stay from every threshold; fails where one comes too near."""
    found: dict[str, list[float]] = {}
    for name in CLASSES:
        for probe, each in shares(name, range(_FIRST_SEED, _FIRST_SEED + trials)).items():
            print(f"{name} {probe}: {each.round(3).tolist()}", flush=True)
            found.setdefault(probe, []).extend(each)
    chances = {probe: cantelli(np.array(each)) for probe, each in found.items()}
    for probe, chance in chances.items():
        print(f"{probe}: {len(found[probe])} trials, largest {max(found[probe]):.2f}, p at most {chance:.2g}")
    total = sum(3 * chance**2 for chance in chances.values())
    print(f"a whole check fails with a probability of at most {total:.2g}")
    sys.exit(max(map(max, found.values())) >= 1 or total >= 0.05)


if __name__ == "__main__":
    main(int(sys.argv[1]))
