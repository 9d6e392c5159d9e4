"""The exact answers agree with brute force, with textbooks and with Gymnasium's own FrozenLake."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.oracle import MOVES, World, policies, worlds
from hypothesis import given
from hypothesis import strategies as st

from gridworld import InputError
from gridworld.world import chain, levels
from gridworld.world import solver as solve
from gridworld.world.chain import Chain, one_hot_policy
from gridworld.world.grid import compile_mdp
from gridworld.world.layout import Layout, load, parse

GAMMAS = st.sampled_from([0, 0.9, 0.99])
UNIFORM = np.full((30, 4), 0.25)


def made(text, **settings):
    return compile_mdp(parse(text, "map"), **settings)


def compiled(world):
    return made(world.text, **world.settings)


@given(worlds(), GAMMAS)
def test_the_optimum_equals_brute_force(world, gamma):
    solution, best = solve.value_iteration(compiled(world), gamma), world.optimal_values(gamma)
    q = [[world.q(best, cell, action, gamma) for action in MOVES] for cell in world.cells]
    assert solution.gamma == gamma
    assert solution.v == pytest.approx(np.array([best[cell] for cell in world.cells]), abs=1e-9)
    assert solution.q == pytest.approx(np.array(q), abs=1e-9)
    assert solution.optimal.any(axis=1).all()
    top = solution.q.max(axis=1, keepdims=True)
    assert np.array_equal(solution.optimal, solution.q >= top - 1e-9 * solution.scale[:, None])


@given(st.data(), worlds(), GAMMAS, st.integers(1, 12))
def test_a_policy_is_worth_what_brute_force_finds_in_large_worlds_too(data, world, gamma, max_steps):
    policy = data.draw(policies(world))
    slow = world.policy_values(policy, gamma)
    mdp, table = compiled(world), np.array([policy[cell] for cell in world.cells])
    solutions = []
    for dense, swept in ((chain.DENSE_STATES, levels.SWEPT_STATES), (0, levels.SWEPT_STATES), (0, 0)):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(chain, "DENSE_STATES", dense)
            patch.setattr(levels, "SWEPT_STATES", swept)
            exact, result = Chain(mdp, table).value(gamma), Chain(mdp, table).outcome(max_steps)
            solutions.append(solve.value_iteration(mdp, gamma))
        assert exact == pytest.approx(np.array([slow[cell] for cell in world.cells]), abs=1e-9)
        found = result.goal, result.trap, result.timeout, result.expected_return, result.expected_length
        assert found == pytest.approx(world.episode(policy, max_steps), abs=1e-12)
        assert sum(found[:3]) == pytest.approx(1, abs=1e-12)
    for other in solutions[1:]:
        assert solutions[0].q == pytest.approx(other.q, abs=1e-11)
        assert np.array_equal(solutions[0].optimal, other.optimal)


def test_the_textbook_world_of_russell_and_norvig():
    mdp = compile_mdp(load("aima_4x3"), slip=0.2, step_reward=-0.04)
    book = [0.812, 0.868, 0.918, 0.762, 0.660, 0.705, 0.655, 0.611, 0.388]
    solution = solve.value_iteration(mdp, 1)
    assert solution.v[~(mdp.terminal | mdp.wall)].round(3).tolist() == book
    up, right, left = [True, False, False, False], [False, True, False, False], [False, False, False, True]
    arrows = [right, right, right, up, up, up, left, left, left]
    assert solution.optimal[~(mdp.terminal | mdp.wall)].tolist() == arrows


def test_without_discount_a_positive_step_reward_has_no_optimum():
    mdp = made("S.G", step_reward=0.1)
    with pytest.raises(InputError, match=r"gamma=1 in map: an episode that never ends"):
        solve.value_iteration(mdp, 1)
    assert solve.value_iteration(mdp, 0.5).v[0] == pytest.approx(0.65)  # 0.1 + 0.5 * 1.1 beats waiting: 0.2


@pytest.mark.parametrize(("step_reward", "worth"), [(0.0, 0.0), (-0.1, -np.inf), (0.1, np.inf)])
def test_without_discount_a_policy_that_never_ends(step_reward, worth):
    mdp = made("S.G", step_reward=step_reward)
    back_and_forth = one_hot_policy(np.array([1, 3, 0]), 4)
    assert Chain(mdp, back_and_forth).value(1).tolist() == [worth, worth, 0]
    half = back_and_forth.copy()
    half[1] = [0, 0.5, 0, 0.5]  # ends surely, after a while: four steps in the mean from the start
    assert Chain(mdp, half).value(1)[0] == pytest.approx(1 + 4 * step_reward)


def test_without_discount_a_chance_of_never_ending_counts():
    ways = "..S#G\n....."  # left for ever, or down, to the right and up
    policy = one_hot_policy(np.array([0, 0, 0, 0, 0, 1, 1, 1, 1, 0]), 4)
    policy[2] = [0.5, 0, 0.5, 0]  # waits a while, then goes down
    assert Chain(made(ways), policy).value(1)[2] == pytest.approx(1)
    policy[2] = [0, 0, 0.5, 0.5]  # goes down or left
    assert Chain(made(ways), policy).value(1)[2] == pytest.approx(0.5)
    assert Chain(made(ways, step_reward=-1), policy).value(1)[2] == -np.inf
    assert Chain(made(ways), policy).endless_states().tolist() == [1]


@pytest.mark.parametrize(
    ("text", "slip", "gamma"),
    [
        ("T.SG", 1.0, 0.99),
        ("..#\n.T.\nTSG", 0.1, 0.9),
        ("..#..\n.GT.#\n.##TT\n.....\n..ST.\nTT.#.", 0.1, 0.999),
    ],
    ids=["line", "square", "rooms"],
)
def test_where_nothing_can_be_won_there_still_is_a_best_action(text, slip, gamma):
    solution = solve.value_iteration(made(text, slip=slip), gamma)
    world = World(text.split(), slip=slip)
    best = world.optimal_values(gamma, tolerance=1e-14)
    assert solution.v == pytest.approx([best[cell] for cell in world.cells], abs=1e-9)
    assert solution.optimal.any(axis=1).all()


def test_endless_states_of_a_cycle():
    def endless(actions, **settings):
        return Chain(made("S..\n...\n..G", **settings), one_hot_policy(actions, 4)).endless_states().tolist()

    cycle = {0: 1, 1: 1, 2: 2, 5: 3, 4: 0}  # right twice, down, left, up and round again
    actions = np.array([cycle.get(state, 1) for state in range(9)])
    assert endless(actions) == [1, 2, 4, 5]
    actions[5] = 2
    assert endless(actions) == []
    assert endless(np.full(9, 0)) == [0]
    assert Chain(made("S..\n...\n..G"), np.full((9, 4), 0.25)).endless_states().size == 0
    assert endless(np.full(9, 0), slip=0.1) == [0, 1, 2]  # "up" never leaves the first row
    assert endless(np.full(9, 1), slip=0.1) == []  # "right" slips down in the end


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="this system tells no peak by itself")
def test_a_world_of_200_by_200_cells_fits_into_a_gigabyte():
    # The peak of the process itself: `ru_maxrss` includes that of the one that started it.
    code = (
        "from pathlib import Path; from gridworld.world.layout import Layout;"
        "from gridworld.world.grid import compile_mdp;"
        "from gridworld.world.solver import value_iteration;"
        "world = compile_mdp(Layout('open', 200, 200, starts=((0, 0),), goals=((199, 199),)));"
        "print(value_iteration(world, 0.99).v[0].item(), value_iteration(world, 0.5).v[0].item(),"
        "Path('/proc/self/status').read_text().split('VmHWM:')[1].split()[0])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    far, very_far, kilobytes = map(float, done.stdout.split())
    assert far == pytest.approx(0.99**397, rel=1e-9)
    assert very_far == pytest.approx(0.5**397, rel=1e-9)
    assert kilobytes < 2**20


@pytest.mark.slow
def test_many_states_are_solved_in_the_farthest_cell_too():
    side, slip = 401, 0.1
    mdp = compile_mdp(Layout("open", side, side, starts=((0, 0),), goals=((side // 2, side - 1),)), slip=slip)
    solution = solve.value_iteration(mdp, 0.99)
    q = np.zeros((side * side, 4))  # Bellman's equation, from the tables
    for outcome in range(mdp.probability.shape[2]):
        there = solution.v[mdp.next_state[:, :, outcome]]
        q += mdp.probability[:, :, outcome] * (mdp.reward[:, :, outcome] + 0.99 * there)
    q[mdp.terminal] = 0
    assert q.max(axis=1) == pytest.approx(solution.v, rel=1e-12, abs=0)
    assert 0 < solution.v[0] < 1e-2
    above, below = (solution.v.reshape(side, side)[half] for half in (slice(201), slice(200, side)))
    assert above[::-1] == pytest.approx(below, rel=1e-9)  # mirrored at the goal's row


@pytest.mark.parametrize(("slip", "walls"), [(0.0, 0), (0.1, 0), (0.5, 0.2)])
def test_sweeps_and_factors_find_the_same_optimum(monkeypatch, slip, walls):
    rng, size = np.random.default_rng(0), 60
    rows = np.where(rng.random((size, size)) < walls, "#", ".")
    rows[0, 0], rows[40, 50], rows[41, 50], rows[10, 20] = "S", "G", "T", "G"
    mdp = made("\n".join(map("".join, rows)), slip=slip)
    factored = solve.value_iteration(mdp, 0.99)
    monkeypatch.setattr(levels, "SWEPT_STATES", 0)
    swept = solve.value_iteration(mdp, 0.99)
    assert swept.v == pytest.approx(factored.v, rel=1e-9, abs=0)
    assert swept.scale == pytest.approx(factored.scale, rel=1e-8, abs=0)
    assert np.array_equal(swept.optimal, factored.optimal)


def test_where_sweeps_do_not_come_to_an_end_factors_are_taken_or_the_world_is_refused(monkeypatch):
    mdp = made("\n".join(["S" + "." * 29, *["." * 30] * 28, "." * 29 + "G"]), slip=0.5)
    expected = solve.value_iteration(mdp, 0.99)
    monkeypatch.setattr(levels, "SWEPT_STATES", 0)
    monkeypatch.setattr(levels, "MOST_SWEEPS", 3)
    assert solve.value_iteration(mdp, 0.99).v == pytest.approx(expected.v, rel=1e-11)
    monkeypatch.setattr(chain, "_MOST_FACTORED", 800)
    with pytest.raises(InputError, match=r"map: 899 states are too many for gamma=0.99; more than 800 need"):
        solve.value_iteration(mdp, 0.99)


@pytest.mark.parametrize("gamma", [-0.1, 1.1, float("nan"), float("inf"), True, "0.9", None, [0.9], 1j])
def test_a_gamma_is_a_number_from_0_to_1(gamma):
    mdp = compile_mdp(load("classic"))
    with pytest.raises(InputError, match="gamma="):
        solve.value_iteration(mdp, gamma)
    with pytest.raises(InputError, match="gamma="):
        Chain(mdp, UNIFORM).value(gamma)


@pytest.mark.parametrize("row", [[1, 0.5, -0.5, 0], [0.5, 0.5, 0.5, 0], 0, np.nan, [np.inf, 0, 0, 0]])
def test_what_is_no_policy_is_refused(row):
    mdp, broken = compile_mdp(load("classic")), UNIFORM.copy()
    broken[7] = row
    wrong = {r"shape \(29, 4\)": UNIFORM[:29], r"shape \(30, 3\)": UNIFORM[:, :3], r"shape \(\)": 0.25}
    for mistake, policy in (wrong | {"row 7": broken}).items():
        with pytest.raises(InputError, match=mistake):
            Chain(mdp, policy)


@pytest.mark.slow
def test_a_value_may_fade_to_nothing_on_the_way() -> None:
    """The smallest float times 0.9 is itself again: no policy should be improved for its sake."""
    best = solve.value_iteration(compile_mdp(parse("S" + "." * 7600 + "G", "corridor")), 0.9)
    distance = 7600 - np.arange(4600, 7601)
    assert best.v[4600:7601] == pytest.approx(0.9**distance, rel=1e-9)
    assert best.v[0] == 0
    assert best.optimal[0].all()
    assert best.optimal[4600:7601].sum() == 3001  # to the right, and nothing else
