"""How seldom a right implementation fails a probe: a bound from how far it stays from each threshold.

A trial tells which share of the way to its threshold an algorithm came: 1 or more has failed. With mean m
and variance v of this share over classes and seeds, Cantelli's inequality bounds the chance p of a failure by
v / (v + (1 - m)²), whatever its distribution. A probe fails with two failures of three, so with a probability
of at most 3 p².

`GRIDWORLD_TRIALS=10 python -m pytest -s -n 0 tests/checking/test_false_alarms.py` takes ten seeds of each
class, in the loop that gives the same as the library's own and is faster.
"""

import dataclasses
import itertools
import os

import numpy as np
import pytest

from gridworld.checking import probes as expect
from gridworld.checking.probes import PROBES, Probe, Trained
from gridworld.checking.training import settings, subject, train
from gridworld.world.solver import solved

TRIALS = int(os.environ.get("GRIDWORLD_TRIALS", "0"))
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
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(expect, "TOLERANCE", middle * expect.TOLERANCE)
            patch.setattr(expect, "PROBABILITY", middle * expect.PROBABILITY)
            patch.setattr(expect, "LEAST_BEST", 1 - middle * (1 - expect.LEAST_BEST))
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
                found.setdefault(probe.name, []).append(share(probe, trained))
    return {name: np.array(each) for name, each in found.items()}


def test_the_bound_is_cantellis() -> None:
    assert cantelli(np.array([0.2, 0.4])) == pytest.approx(0.02 / (0.02 + 0.49))
    assert cantelli(np.array([1.5, 0.9])) == 1.0
    assert cantelli(np.zeros(3)) == 0.0


@pytest.mark.skipif(not TRIALS, reason="takes a minute for each seed")
def test_right_classes_stay_far_from_every_threshold() -> None:
    found: dict[str, list[float]] = {}
    for name in CLASSES:
        for probe, trials in shares(name, range(_FIRST_SEED, _FIRST_SEED + TRIALS)).items():
            print(f"{name} {probe}: {trials.round(3).tolist()}", flush=True)
            found.setdefault(probe, []).extend(trials)
    chances = {probe: cantelli(np.array(trials)) for probe, trials in found.items()}
    for probe, chance in chances.items():
        print(f"{probe}: {len(found[probe])} trials, largest {max(found[probe]):.2f}, p at most {chance:.2g}")
    total = sum(3 * chance**2 for chance in chances.values())
    print(f"a whole check fails with a probability of at most {total:.2g}")
    assert max(map(max, found.values())) < 1
    assert total < 0.05
