"""Without discount, and just below it, the optimum is the one that exact rational arithmetic finds.

The oracle tries every deterministic policy of a tiny map and solves for its total reward and its slope, the
sum of t E[r_t], in fractions. Nothing of it is taken from the package.
"""

import itertools
from fractions import Fraction

import numpy as np
import pytest
from helpers.oracle import MOVES, World, maps
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from gridworld import InputError
from gridworld.world.exact.evaluation import Evaluator
from gridworld.world.exact.markov_chain import Chain, one_hot_policy
from gridworld.world.exact.solver import value_iteration
from gridworld.world.grid import compile_mdp
from gridworld.world.layout import load, parse
from gridworld.world.mdp import Mdp

SLIPS = [Fraction(0), Fraction(1, 10), Fraction(1, 1000), Fraction(1, 10**7), Fraction(1)]
INFINITE = Fraction(10**9)


class Exact:
    """A tiny world in fractions: the total reward and the slope of every deterministic policy."""

    def __init__(self, rows: list[str], slip: Fraction, step: Fraction) -> None:
        self.world = World(
            rows, slip=slip, step_reward=step, goal_reward=Fraction(1), trap_reward=Fraction(-1)
        )
        self.cells = [
            cell for cell in self.world.cells if not self.world.ends(cell) and self.world.tile[cell] != "#"
        ]

    def policies(self):
        return (
            dict(zip(self.cells, row, strict=True))
            for row in itertools.product(MOVES, repeat=len(self.cells))
        )

    def evaluate(self, policy) -> tuple[list[Fraction], list[Fraction] | None]:
        """(total reward, slope) of each playing cell; infinite losses are -INFINITE, with no slope."""
        ahead = {cell: self.world.outcomes(cell, policy[cell]) for cell in self.cells}
        reached = {cell: self._reached(cell, ahead) for cell in self.cells}
        recurrent = {c for c in self.cells if all(c in reached.get(other, ()) for other in reached[c])}
        paying = {c for c in recurrent if any(r for other in reached[c] for _, _, r, _ in ahead[other])}
        lost = {cell for cell in self.cells if paying & reached[cell]}  # no reward on the way is positive
        playing = [cell for cell in self.cells if cell not in recurrent | lost]
        total = self._sums(playing, ahead, {c: sum(p * r for p, _, r, _ in ahead[c]) for c in playing})
        slope = self._sums(
            playing,
            ahead,
            {c: sum(p * total.get(t, Fraction(0)) for p, t, _, _ in ahead[c]) for c in playing},
        )
        values = [-INFINITE if cell in lost else total.get(cell, Fraction(0)) for cell in self.cells]
        return values, None if lost else [slope.get(cell, Fraction(0)) for cell in self.cells]

    @staticmethod
    def _reached(cell, ahead) -> set:
        """The cell and all that may follow it, the ends too."""
        found, queue = {cell}, [cell]
        for each in queue:
            new = {target for _, target, _, _ in ahead.get(each, ())} - found
            found |= new
            queue += new
        return found

    @staticmethod
    def _sums(cells, ahead, right):
        """x = right + P x in fractions, by elimination."""
        rows = []
        for cell in cells:
            row = {other: Fraction(int(other == cell)) for other in cells}
            for p, target, _, _ in ahead[cell]:
                if target in row:
                    row[target] -= p
            rows.append([*row.values(), right[cell]])
        for k in range(len(rows)):
            pivot = next(i for i in range(k, len(rows)) if rows[i][k])
            rows[k], rows[pivot] = rows[pivot], rows[k]
            rows[k] = [x / rows[k][k] for x in rows[k]]
            for i in range(len(rows)):
                if i != k and rows[i][k]:
                    rows[i] = [x - rows[i][k] * y for x, y in zip(rows[i], rows[k], strict=True)]
        return {cell: row[-1] for cell, row in zip(cells, rows, strict=True)}


def compiled(exact: Exact) -> Mdp:
    rewards = {key: float(value) for key, value in exact.world.settings.items()}
    return compile_mdp(parse(exact.world.text, "map"), **rewards)


@settings(max_examples=60)
@given(maps(max_side=3), st.sampled_from(SLIPS), st.sampled_from([Fraction(0), Fraction(-1, 16)]))
def test_the_undiscounted_optimum_equals_exact_arithmetic(rows, slip, step):
    exact = Exact(rows, slip, step)
    assume(1 <= len(exact.cells) <= 4)
    found = [(policy, *exact.evaluate(policy)) for policy in exact.policies()]
    best = [max(column) for column in zip(*(total for _, total, _ in found), strict=True)]
    solution = value_iteration(compiled(exact), 1.0)
    states = [exact.world.state(cell) for cell in exact.cells]
    told = np.where(np.isneginf(solution.v[states]), float(-INFINITE), solution.v[states])
    assert told == pytest.approx(np.array([float(value) for value in best]), rel=1e-9, abs=1e-12)

    if -INFINITE in best:
        return
    sooner = [slope for _, total, slope in found if total == best and slope is not None]
    least = [min(column) for column in zip(*sooner, strict=True)]
    for policy, total, slope in found:
        taken = all(solution.optimal[s, policy[c]] for s, c in zip(states, exact.cells, strict=True))
        assert taken == (total == best and slope == least), (policy, total, slope)


def test_who_has_time_takes_no_risk():
    """With a tiny slip, the way past the traps is safe for whoever waits where it can do no harm."""
    for slip in (1e-3, 1e-4, 1e-6, 1e-8):
        mdp = compile_mdp(load("classic"), slip=slip)
        evaluator = Evaluator(mdp, 1.0, 100)
        assert evaluator.optimal_value == pytest.approx(1, abs=1e-12)
        shortest = one_hot_policy(
            value_iteration(compile_mdp(load("classic")), 0.99).optimal.argmax(axis=1), 4
        )
        assert evaluator.score(shortest).value < 1 - slip / 2
        assert evaluator.score(shortest).certified == (evaluator.score(shortest).regret <= 1e-6)
    assert not Evaluator(compile_mdp(load("classic"), slip=1e-4), 1.0, 100).score(shortest).certified


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
            patch.setattr("gridworld.world.exact.markov_chain.DENSE_STATES", 0)
            assert Chain(mdp, policy).value(gamma) == pytest.approx(dense, rel=1e-9)
            sparse = value_iteration(mdp, gamma)
        assert sparse.v == pytest.approx(optimum.v, rel=1e-11)
        assert np.array_equal(sparse.optimal, optimum.optimal)


def test_where_nobody_can_go_on_for_ever_a_positive_step_reward_has_an_optimum():
    forced = compile_mdp(parse("SG", "map"), slip=0.0, step_reward=0.5)
    with pytest.raises(InputError, match="may grow without end"):
        value_iteration(forced, 1.0)  # a bump into the border earns too
    ended = compile_mdp(parse("TSG", "map"), slip=1.0, step_reward=0.5)
    with pytest.raises(InputError, match="may grow without end"):
        value_iteration(ended, 1.0)  # so does right or left, which slips up or down


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
    with pytest.raises(InputError, match="so near to 1 that rounding hides"):
        value_iteration(compile_mdp(load("classic")), gamma)
