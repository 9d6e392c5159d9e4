"""Without discount, and just below it, the optimum is the one that exact rational arithmetic finds.

The oracle is policy iteration in fractions, under a discount so near to 1 that what it takes off a value is
told from everything else by its size. Nothing of it is taken from the package.
"""

from fractions import Fraction

import numpy as np
import pytest
from helpers.oracle import MOVES, World, maps
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from gridworld import InputError
from gridworld.world.chain import Chain, one_hot_policy
from gridworld.world.evaluation import Evaluator
from gridworld.world.grid import compile_mdp
from gridworld.world.layout import load, parse
from gridworld.world.solver import value_iteration
from gridworld.world.sources.arrays import mdp_from_arrays

SLIPS = [Fraction(0), Fraction(1, 10), Fraction(1, 1000), Fraction(1, 10**7), Fraction(1)]
TINY = Fraction(1, 10**120)  # 1 - γ: a value V differs by V' TINY, an infinite loss is about -1 / TINY
SMALL, HUGE = Fraction(1, 10**60), Fraction(10**60)  # between these, V', V and infinity


class Exact:
    """A small world in fractions: its optimum, and the value of any deterministic policy."""

    def __init__(self, rows, slip, step, goal=1, trap=-1) -> None:
        rewards = {
            "step_reward": Fraction(step),
            "goal_reward": Fraction(goal),
            "trap_reward": Fraction(trap),
        }
        self.world = World(rows, slip=Fraction(slip), **rewards)
        self.ended = {cell: Fraction(0) for cell, tile in self.world.tile.items() if tile in "#GT"}
        self.cells = [cell for cell in self.world.cells if cell not in self.ended]
        self.policy = dict.fromkeys(self.cells, 0)
        while True:
            self.value = self.values(self.policy)
            self.q = {
                cell: [self.world.q(self.value, cell, a, 1 - TINY) for a in MOVES] for cell in self.cells
            }
            better = {cell: q.index(max(q)) for cell, q in self.q.items() if max(q) > q[self.policy[cell]]}
            if not better:
                break
            self.policy |= better
        self.scale = self.values(self.policy, abs)

    def values(self, policy, counted=lambda reward: reward):
        """Those of a policy by elimination, with rewards as they are `counted`."""
        rows = []
        for cell in self.cells:
            row = {other: Fraction(int(other == cell)) for other in self.cells}
            outcomes = self.world.outcomes(cell, policy[cell])
            for p, target, _, _ in outcomes:
                if target in row:
                    row[target] -= (1 - TINY) * p
            rows.append([*row.values(), sum(p * counted(reward) for p, _, reward, _ in outcomes)])
        for k, pivot in enumerate(rows):
            pivot[k:] = [x / pivot[k] for x in pivot[k:]]
            for row in rows:
                if row is not pivot and row[k]:
                    row[k:] = [x - row[k] * y for x, y in zip(row[k:], pivot[k:], strict=True)]
        return self.ended | {cell: row[-1] for cell, row in zip(self.cells, rows, strict=True)}

    def at_start(self, values) -> Fraction:
        return sum(values[cell] for cell in self.world.starts) / len(self.world.starts)

    def compiled(self):
        rewards = {key: float(value) for key, value in self.world.settings.items()}
        return compile_mdp(parse(self.world.text, "map"), **rewards)

    def assert_values(self, v) -> None:
        for cell in self.cells:
            exact, found = self.value[cell], float(v[self.world.state(cell)])
            if exact < -HUGE:
                assert found == -np.inf
            else:
                assert abs(Fraction(found) - exact) <= self.scale[cell] / 10**9 + SMALL


@settings(max_examples=60)
@given(maps(max_side=3), st.sampled_from(SLIPS), st.sampled_from([Fraction(0), Fraction(-1, 16)]))
def test_the_undiscounted_optimum_equals_exact_arithmetic(rows, slip, step):
    exact = Exact(rows, slip, step)
    solution = value_iteration(exact.compiled(), 1.0)
    exact.assert_values(solution.v)
    for cell in exact.cells:
        best = exact.value[cell]
        optimal = [best < -HUGE or best - q < SMALL * TINY for q in exact.q[cell]]
        assert solution.optimal[exact.world.state(cell)].tolist() == optimal


@settings(max_examples=40)
@example(["T.S.", "G.#."], 1e-14, 0.0, 1.0, -1e11)  # as likely moves change nothing, rounding hides the rest
@example(["..#", "..C", "CSG"], 1e-14, 0.0, 5.0, -1e9)
@example(["GC", ".S"], 1e-14, 0.0, 1e-6, -1e6)
@example(["ST.", "GS#"], 1e-9, 0.0, 1.0, -1e-6)
@example(["...C", "#GGT", "CS.C"], 1e-16, -1e-15, -1e5, -1e8)
@given(
    maps(max_side=3),
    st.sampled_from([1e-6, 1e-9, 1e-10, 1e-12, 1e-14]),
    st.sampled_from([0.0, 0.0, -1e-2, -1e-9, -1e-15]),
    st.sampled_from([1.0, 5.0, 1e-6, -1e5]),
    st.sampled_from([-1e-9, -1.0, -1e5, -1e9, -1e13]),
)
def test_outcomes_that_are_hardly_possible_decide_too(rows, slip, step, goal, trap):
    """Who has time waits for the one slip in a million million that leads past the trap."""
    exact = Exact(rows, slip, step, goal, trap)
    evaluator = Evaluator(exact.compiled(), 1.0, 10)
    exact.assert_values(evaluator.solution.v)
    assume(exact.at_start(exact.value) > -HUGE)
    marked = evaluator.solution.optimal.argmax(axis=1)
    hurried = value_iteration(compile_mdp(parse(exact.world.text, "map"), 0.0, -0.01), 0.99)
    for actions in (marked, hurried.optimal.argmax(axis=1), *((marked + turn) % 4 for turn in (1, 2, 3))):
        policy = {cell: int(actions[exact.world.state(cell)]) for cell in exact.cells}
        regret = exact.at_start(exact.value) - exact.at_start(exact.values(policy))
        told = evaluator.score(one_hot_policy(actions, 4))
        least = exact.at_start(exact.scale) / 10**6
        if not 0.999 < regret / (least or SMALL) < 1.001:
            assert told.certified == (regret <= least + SMALL)
    for cell in exact.cells:
        lost = [exact.value[cell] - q for q in exact.q[cell]]
        for action in np.flatnonzero(evaluator.solution.optimal[exact.world.state(cell)]):
            assert exact.value[cell] < -HUGE or lost[action] <= exact.scale[cell] / 10**12 + SMALL


@pytest.mark.parametrize("gamma", [0.99999, 1 - 1e-8, 1 - 1e-10, 1 - 1e-11, 1.0])
@pytest.mark.parametrize("layout", ["classic", "four_rooms", "maze", "frozen_lake_8x8"])
def test_the_optimum_moves_however_little_a_step_costs(gamma, layout):
    evaluator = Evaluator(compile_mdp(load(layout)), gamma, 1000)
    ordinary = Evaluator(compile_mdp(load(layout)), 0.99, 1000)
    assert evaluator.optimum.goal == 1
    assert evaluator.optimum.expected_length == ordinary.optimum.expected_length
    assert np.array_equal(evaluator.solution.optimal, ordinary.solution.optimal)
    assert evaluator.score(evaluator.optimal_policy()).certified


def test_discounts_just_below_one_are_told_from_each_other():
    """Patience pays where waiting costs less than the risk: exactly from where arithmetic says."""
    mdp = compile_mdp(load("classic"), slip=1e-6)
    values = [Evaluator(mdp, gamma, 100).optimal_value for gamma in (1 - 1e-8, 1 - 1e-10, 1 - 1e-11, 1.0)]
    assert values == sorted(values)
    for gamma, value in zip((1 - 1e-8, 1 - 1e-10, 1 - 1e-11), values[:-1], strict=True):
        assert value >= float(Fraction(gamma) ** 7) * (1 - 4e-6)  # that of hurrying


@settings(max_examples=50)
@given(st.data(), maps(), st.sampled_from([1e-3, 1e-9, 1e-14, 1e-40]), st.sampled_from([0.0, 0.1]))
def test_a_policy_that_nearly_never_ends_is_worth_no_more_than_what_there_is(data, rows, moving, slip):
    mdp = compile_mdp(parse("\n".join(rows), "map"), slip)
    still = data.draw(st.lists(st.integers(0, 3), min_size=mdp.num_states, max_size=mdp.num_states))
    policy = np.full((mdp.num_states, 4), moving)
    policy[np.arange(mdp.num_states), still] = 1 - 3 * moving
    value = Chain(mdp, policy).value(1.0)
    assert (value <= 1 + 1e-14).all()
    text = "".join(rows)
    if "C" not in text:  # a fall may come again and again
        assert (value >= -1 - 1e-14).all()
    if "T" not in text and "C" not in text:
        playing = ~(mdp.terminal | mdp.wall)
        reaches = np.array([World(rows).steps_to_goal(cell) is not None for cell in World(rows).cells])
        assert value[playing & reaches] == pytest.approx(1, abs=1e-12)


def test_large_worlds_are_as_exact_as_small_ones_near_one(monkeypatch):
    mdp = compile_mdp(load("four_rooms"), slip=1e-3, trap_reward=-1.0)
    policy = np.full((mdp.num_states, 4), 1e-6)
    policy[:, 0] = 1 - 3e-6
    for gamma in (1 - 1e-7, 1.0):
        dense, optimum = Chain(mdp, policy).value(gamma), value_iteration(mdp, gamma)
        with monkeypatch.context() as patch:
            patch.setattr("gridworld.world.chain.DENSE_STATES", 0)
            assert Chain(mdp, policy).value(gamma) == pytest.approx(dense, rel=1e-9)
            sparse = value_iteration(mdp, gamma)
        assert sparse.v == pytest.approx(optimum.v, rel=1e-11)
        assert np.array_equal(sparse.optimal, optimum.optimal)


def test_a_large_world_that_rounding_makes_singular_has_its_values(monkeypatch):
    mdp = compile_mdp(parse("S..\n..G", "map"), slip=1e-16)
    policy = one_hot_policy(np.array([0, 2, 2, 1, 0, 1]), 4)  # comes to the goal by three slips
    monkeypatch.setattr("gridworld.world.chain.DENSE_STATES", 0)
    assert Chain(mdp, policy).value(1.0)[mdp.start_states] == pytest.approx([1.0], rel=1e-12)


@pytest.mark.parametrize(
    ("rows", "slip", "step", "goal", "trap", "best"),
    [
        ("...#\n.#..\n.SCG", 2**-24, 0.0, 1.0, -100.0, 1.0),  # wait until the world slips past the cliff
        (".#GS.\nGS.G.", 0.0, -1e-12, -5.0, -1.0, -5.000000000001),  # a step is nearly nothing beside the end
        (".GT.\nSG..", 0.0, -(2.0**-40), -8.0, -1.0, -8 - 2.0**-40),
        (".GT.\nSG..", 0.0, -1e-18, -8.0, -1.0, -8.0),  # and here nothing that a number could hold
        ("..TC\n..T.\nG.S.", 0.0, -1e-9, -5.0, -1e8, -5.000000002),
    ],
)
def test_what_hardly_shows_in_a_value_still_decides(rows, slip, step, goal, trap, best):
    evaluator = Evaluator(compile_mdp(parse(rows, "map"), slip, step, goal, trap), 1.0, 100)
    assert evaluator.optimal_value == pytest.approx(best, rel=1e-13)
    assert evaluator.score(evaluator.optimal_policy()).certified


@pytest.mark.parametrize("gamma", [1 - 1e-12, 1 - 2**-46, 1 - 2**-53])
def test_a_discount_that_rounding_hides_is_refused(gamma):
    with pytest.raises(InputError, match="so close to 1 that rounding hides"):
        value_iteration(compile_mdp(load("classic")), gamma)


@pytest.mark.parametrize("dense", [512, 0])
def test_a_way_to_rest_for_ever_is_worth_what_it_costs(dense, monkeypatch):
    """Waiting costs 1 a step and leads to rest with probability 1/2: it costs 2, not infinitely much."""
    monkeypatch.setattr("gridworld.world.chain.DENSE_STATES", dense)
    next_state = np.array([[[0, 1], [2, 2]], [[1, 1], [1, 1]], [[2, 2], [2, 2]]])
    ends = np.zeros((3, 2, 2), dtype=bool)
    ends[0, 1] = ends[2] = True
    tables = {
        "next_state": next_state,
        "probability": np.full((3, 2, 2), 0.5),
        "reward": np.array([[[-1.0, -1.0], [-5.0, -5.0]], *[[[0.0, 0.0], [0.0, 0.0]]] * 2]),
        "terminated": ends,
        "start": np.array([1.0, 0.0, 0.0]),
    }
    mdp = mdp_from_arrays("rest", tables, "rest")
    assert value_iteration(mdp, 1.0).v.tolist() == [-2.0, 0.0, 0.0]
