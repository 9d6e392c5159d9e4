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
from gridworld.checking.probes import PROBES, Probe
from gridworld.checking.settings import settings, subject
from gridworld.checking.training import Trained, train
from gridworld.world.chain import Chain
from gridworld.world.solver import backup, solved

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


def of_values(trained: Trained, exact: np.ndarray, where: np.ndarray, found: np.ndarray) -> float:
    tolerance = expect.TOLERANCE * max(np.abs(exact[where]).max(), np.abs(trained.mdp.reward).max())
    return float(np.abs(found - exact)[where].max() / tolerance)


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
    """How far a trial came on the way to the threshold of a probe."""
    mdp, last = trained.mdp, trained.last
    live = mdp.reachable & ~mdp.terminal
    if probe.holds is expect.all_layers_learn:
        return float(bool(trained.frozen))
    if probe.holds is expect.acts_as_learnt:
        right = trained.late[solved(mdp, trained.gamma).optimal].sum() / trained.late.sum()
        return float((1 - right) / (1 - expect.LEAST_BEST))
    if probe.holds is expect.acts_at_random:
        shares = trained.visits[live] / trained.visits[live].sum(axis=1, keepdims=True)
        return float(np.abs(shares - 1 / mdp.num_actions).max() / expect.PROBABILITY)
    if probe.holds is expect.soft_optimal:
        return float(np.abs(last.sampled[live] - [[0.75, 0.25], [0.25, 0.75]]).max() / expect.PROBABILITY)
    if probe.holds is expect.first_backup:
        assert trained.first.q is not None
        exact = backup(mdp, np.where(mdp.terminal, 0.0, trained.first.q.max(axis=1)), trained.gamma)
        return of_values(trained, exact, live, last.q)
    choice = 0.0 if probe.holds is expect.values else of_choice(trained)
    if probe.holds is expect.optimal:
        return choice
    if last.q is not None:
        return max(choice, of_values(trained, solved(mdp, trained.gamma).q, live, last.q))
    often = live & (trained.late.sum(axis=1) >= expect._VISITED * trained.late.sum())
    exact = Chain(mdp, last.sampled).value(trained.gamma)
    return max(choice, of_values(trained, exact, often, last.values))


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
                config, probes[0].world(), probes[0].gamma, chosen[1].num_envs, chosen[1].steps, seed
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
