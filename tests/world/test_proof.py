"""Proven bounds hold, and are narrow enough: against policy iteration in exact fractions."""

from fractions import Fraction
from typing import Any

import numpy as np
import pytest

import gridworld
from gridworld.training.verify import proven
from gridworld.world.chain import Chain, one_hot_policy
from gridworld.world.evaluation import Evaluator
from gridworld.world.mdp import Mdp
from gridworld.world.outcomes import Outcomes, mdp_from_outcomes
from gridworld.world.proof import at_most

WORLDS = 60


def world(numbers: np.random.Generator, size: int, scale: float = 1.0) -> Mdp:
    """A random world: a few outcomes each, some ends, and several starts."""
    actions, width = int(numbers.integers(1, 4)), int(numbers.integers(1, 4))
    shape = size, actions, width
    probability = numbers.random(shape) ** 3 + 1e-9
    probability /= probability.sum(axis=2, keepdims=True)
    reward = scale * np.round(numbers.normal(size=shape), int(numbers.integers(0, 16)))
    reward *= numbers.random(shape) < numbers.choice([0.1, 1.0])  # many are 0, and so are many ties
    following = numbers.integers(size, size=shape)
    ends = numbers.random(size) < 0.1
    ends[0] = False
    start = np.zeros(size)
    chosen = np.unique([0, *numbers.integers(size, size=2)])
    start[chosen] = numbers.random(len(chosen)) + 0.01
    start[ends] = 0
    start /= start.sum()
    following[ends] = np.flatnonzero(ends)[:, None, None]
    reward[ends] = 0
    tables = Outcomes(
        next_state=following, probability=probability, reward=reward, terminated=ends[following], start=start
    )
    return mdp_from_outcomes("random", tables)


def exactly(mdp: Mdp, gamma: float, greedy: Any) -> list[Fraction]:
    """V_π in fractions, by elimination over the live states."""
    live = [int(state) for state in np.flatnonzero(mdp.reachable & ~mdp.terminal)]
    place, discount = {state: number for number, state in enumerate(live)}, Fraction(gamma)
    table = []
    for state in live:
        action = greedy[state]
        parts = [Fraction(float(p)) for p in mdp.probability[state, action]]
        row = [Fraction(0)] * (len(live) + 1)
        row[place[state]] += 1
        for part, then, paid in zip(
            parts, mdp.next_state[state, action], mdp.reward[state, action], strict=True
        ):
            share = part / sum(parts)
            row[-1] += share * Fraction(float(paid))
            if int(then) in place:
                row[place[int(then)]] -= discount * share
        table.append(row)
    for number in range(len(live)):
        pivot = table[number][number]
        table[number] = [each / pivot for each in table[number]]
        for other in range(len(live)):
            if other != number and (factor := table[other][number]):
                table[other] = [a - factor * b for a, b in zip(table[other], table[number], strict=True)]
    values = [Fraction(0)] * mdp.num_states
    for state in live:
        values[state] = table[place[state]][-1]
    return values


def improved(mdp: Mdp, gamma: float, greedy: Any, values: list[Fraction]) -> Any:
    """The same actions, where none is better in fractions."""
    found = np.array(greedy)
    for state in np.flatnonzero(mdp.reachable & ~mdp.terminal):
        worths = []
        for action in range(mdp.num_actions):
            parts = [Fraction(float(p)) for p in mdp.probability[state, action]]
            paid = [Fraction(float(r)) for r in mdp.reward[state, action]]
            after = [values[int(then)] for then in mdp.next_state[state, action]]
            worths.append(
                sum(p * (r + Fraction(gamma) * v) for p, r, v in zip(parts, paid, after, strict=True))
                / sum(parts)
            )
        if worths[found[state]] < max(worths):
            found[state] = worths.index(max(worths))
    return found


def regret_of(mdp: Mdp, gamma: float, values: list[Fraction], best: list[Fraction]) -> Fraction:
    starts = mdp.start_states.tolist()
    shares = [Fraction(float(mdp.start[state])) for state in starts]
    return sum(p * (best[s] - values[s]) for p, s in zip(shares, starts, strict=True)) / sum(shares)


@pytest.mark.parametrize("seed", range(WORLDS))
def test_bounds_hold_and_what_is_optimal_is_certified(seed: int) -> None:
    numbers = np.random.default_rng(seed)
    scale = float(numbers.choice([1.0, 1.0, 1e12, 1e-80]))
    mdp = world(numbers, int(numbers.integers(2, 13)), scale)
    gamma = float(numbers.choice([0.5, 0.9, 0.99, 1 - 1e-6, 1 - 1e-9]))
    evaluator = Evaluator(mdp, gamma, 100)
    greedy = evaluator.solution.optimal.argmax(axis=1)
    best = exactly(mdp, gamma, greedy)
    while not np.array_equal(better := improved(mdp, gamma, greedy, best), greedy):
        greedy, best = better, exactly(mdp, gamma, better)
    score = evaluator.score(one_hot_policy(greedy, mdp.num_actions))
    assert score.certified
    if gamma < 1 - 1e-8 or score.proven_regret is not None:
        assert score.proven_regret is not None
        assert proven(evaluator, greedy).is_optimal
    for _ in range(3):
        other = greedy.copy()
        state = int(numbers.integers(mdp.num_states))
        other[state] = numbers.integers(mdp.num_actions)
        exact = regret_of(mdp, gamma, exactly(mdp, gamma, other), best)
        bounds = evaluator.bounds
        assert bounds is not None
        chain = Chain(mdp, one_hot_policy(other, mdp.num_actions))
        assert bounds.regret(chain.policy, chain.value(gamma)) >= exact
        assert proven(evaluator, other).regret >= exact
        for s, value in enumerate(best):
            if mdp.reachable[s] and not mdp.terminal[s]:
                assert bounds.upper[s] >= value
        if exact == 0:
            assert evaluator.score(one_hot_policy(other, mdp.num_actions)).certified


def test_a_world_that_is_worth_nothing_is_proven() -> None:
    """Waiting pays nothing, and moving costs 1 and ends."""
    rows = {
        0: {0: [(1.0, 0, 0.0, False)], 1: [(1.0, 1, -1.0, True)]},
        1: {action: [(1.0, 1, 0.0, True)] for action in range(2)},
    }
    evaluator = Evaluator(gridworld.compile_mdp(rows, [1.0, 0.0]), 0.99, 100)
    assert evaluator.optimal_value == 0
    score = evaluator.score(evaluator.optimal_policy())
    assert score.certified
    assert score.proven_regret is not None
    assert score.proven_regret <= 2.3e-16


def test_a_far_start_is_proven_by_what_is_near_to_it() -> None:
    """The goal pays 1 after 300 steps, of which hardly anything is left; a great reward lies elsewhere."""
    size = 300
    rows = {s: {0: [(1.0, s + 1, 0.0, False)], 1: [(1.0, s, 0.0, False)]} for s in range(size)}
    rows[size] = {0: [(1.0, size + 1, 1.0, True)], 1: [(1.0, size, 0.0, False)]}
    rows[size + 1] = {action: [(1.0, size + 1, 0.0, True)] for action in range(2)}
    mdp = gridworld.compile_mdp(rows, [1.0] + [0.0] * (size + 1))
    evaluator = Evaluator(mdp, 0.9, 1000)
    score = evaluator.score(evaluator.optimal_policy())
    assert evaluator.optimal_value == pytest.approx(0.9**size, rel=1e-12)
    assert score.certified
    assert score.proven_regret is not None
    assert score.proven_regret < 1e-6 * evaluator.optimal_value


def test_what_never_ends_is_not_proven_by_the_inequalities_alone() -> None:
    """Without a discount a loop that pays nothing satisfies both."""
    classic = Evaluator(gridworld.compile_env("classic"), 1.0, 100)
    assert proven(classic, classic.solution.optimal.argmax(axis=1)).is_optimal
    cliff = Evaluator(gridworld.compile_env("cliff_walking"), 1.0, 100)
    assert proven(cliff, cliff.solution.optimal.argmax(axis=1)).is_optimal
    assert cliff.score(cliff.optimal_policy()).proven_regret is None
    standing = np.zeros(30, np.int64)
    assert proven(classic, standing).regret >= 1.0


@pytest.mark.parametrize("name", ["aima_4x3", "deep_sea"])
def test_without_a_discount_bounds_leave_room_for_the_rounding_of_each_step(name: str) -> None:
    evaluator = Evaluator(gridworld.compile_env(name), 1.0, 100)
    found = proven(evaluator, evaluator.solution.optimal.argmax(axis=1))
    assert found.is_optimal
    assert found.is_exact
    assert 0 < found.regret < 1e-12


def test_a_bound_is_rounded_up() -> None:
    assert [at_most(each) for each in (1.71e-13, 2.0, 0.0, 99.4, 5e-324)] == [
        *("1.8e-13", "2", "0", "1.0e+2", "5.0e-324")
    ]


HIDDEN, RARE = 6e-14, (1e-9, 2.5e-9)  # a better action that no float shows at this discount
HARD = {
    0: {a: [(1 - p, a, -1.0, False), (p, 2, -1.0, False)] for a, p in enumerate(RARE)},
    1: {a: [(1 - RARE[1], 1, -1.0, False), (RARE[1], 2, -1.0, False)] for a in (0, 1)},
    2: {a: [(1 - HIDDEN, 2, -1.0, False), (HIDDEN, 3, -1.0, True)] for a in (0, 1)},
    3: {a: [(1.0, 3, 0.0, True)] for a in (0, 1)},
}


@pytest.mark.parametrize("gamma", [1 - 1e-8, 1 - 1e-9, 1 - 1e-10, 1 - 1e-11])
def test_what_a_bound_denies_is_not_certified(gamma: float) -> None:
    mdp = gridworld.compile_mdp(HARD, [1.0, 0.0, 0.0, 0.0])
    evaluator = Evaluator(mdp, gamma, 100)
    for actions in ([0] * mdp.num_states, [1] * mdp.num_states):
        score = evaluator.score(one_hot_policy(np.array(actions), 2))
        proven_regret = np.inf if score.proven_regret is None else score.proven_regret
        assert not score.certified or proven_regret <= evaluator.tolerance


def test_without_a_discount_floats_that_cancel_certify_nothing() -> None:
    ways: dict[int, dict[int, list[tuple[float, int, float, bool]]]] = {
        0: {0: [(1.0, 5, 1.0, True)], 1: [(1.0, 1, -8.0, False)]}
    }
    for state, reward in ((1, -4.0), (2, 9.0), (3, -1e17), (4, 1e17)):
        ways[state] = {a: [(1.0, state + 1, reward, state == 4)] for a in (0, 1)}
    ways[5] = {a: [(1.0, 5, 0.0, True)] for a in (0, 1)}
    evaluator = Evaluator(gridworld.compile_mdp(ways, [1.0, *[0.0] * 5]), 1.0, 100)
    worse = one_hot_policy(np.ones(evaluator.mdp.num_states, dtype=int), 2)
    assert not evaluator.score(worse).certified


def test_what_is_far_from_a_pit_is_scored_without_its_rounding() -> None:
    """A linear system's error is beside its largest value, which no start may come to."""
    pit = {0: [(0.7, 2, -1e9, False), (0.3, 2, 0.0, False)]}
    back = {0: [(0.7, 0, -1e9, False), (0.3, 1, 0.0, False)]}
    rows = {
        0: pit | {1: pit[0]},
        2: back | {1: back[0]},
        3: {a: [(1.0, 4, -1e-7, True)] for a in (0, 1)},
        1: {0: [(0.7, 1, 0.0, False), (0.3, 1, 0.0, False)], 1: [(1.0, 0, -1.0, False)]},
        4: {a: [(1.0, 4, 0.0, True)] for a in (0, 1)},
    }
    mdp = gridworld.compile_mdp(rows, [0.0, 0.5, 0.0, 0.5, 0.0])
    score = Evaluator(mdp, 0.99, 100).score(one_hot_policy(np.zeros(mdp.num_states, dtype=int), 2))
    assert score.certified
    assert score.value == pytest.approx(-5e-8, rel=1e-12)


def test_a_bound_of_what_underflows_is_not_0() -> None:
    rows = {
        0: {0: [(1.0, 1, 0.0, True)], 1: [(1e-300, 1, 1e-100, True), (1.0, 1, 0.0, True)]},
        1: {a: [(1.0, 1, 0.0, True)] for a in (0, 1)},
    }
    mdp = gridworld.compile_mdp(rows, [1.0, 0.0])
    first = np.zeros(mdp.num_states, dtype=int)
    proven_regret = Evaluator(mdp, 0.99, 100).score(one_hot_policy(first, 2)).proven_regret
    assert proven_regret is not None
    assert Fraction(proven_regret) >= Fraction(1e-300) * Fraction(1e-100)
