"""The worlds of the literature have its numbers; CliffWalking and FrozenLake are maps of ours, row by row."""

import gymnasium as gym
import numpy as np
import pytest
from helpers.support import configure

from gridworld import InputError
from gridworld.world.chain import Chain, one_hot_policy
from gridworld.world.evaluation import Evaluator
from gridworld.world.grid import compile_mdp
from gridworld.world.layout import parse
from gridworld.world.solver import value_iteration
from gridworld.world.sources.classics import combination_lock, deep_sea, random_walk, river_swim

UP, RIGHT, DOWN, LEFT = range(4)


def cliff(slip=0.0):
    return configure("env=cliff_walking", f"env.slip={slip}").env.compile()


def safe_way():
    """Up to the first row, along it, and down in the last column."""
    actions = np.full(48, UP)
    actions[:11], actions[11::12] = RIGHT, DOWN
    return one_hot_policy(actions, 4)


def merged(outcomes):
    """{(next state, reward, whether it is over): probability}"""
    found = {}
    for p, following, reward, over in outcomes:
        key = int(following), float(reward), bool(over)
        found[key] = found.get(key, 0.0) + float(p)
    return found


@pytest.mark.parametrize("slippery", [False, True])
@pytest.mark.parametrize(
    ("env", "env_id", "order", "settings"),
    [
        ("cliff_walking", "CliffWalking-v1", (UP, RIGHT, DOWN, LEFT), {}),
        ("frozen_lake_4x4", "FrozenLake-v1", (LEFT, DOWN, RIGHT, UP), {"map_name": "4x4"}),
        ("frozen_lake_8x8", "FrozenLake-v1", (LEFT, DOWN, RIGHT, UP), {"map_name": "8x8"}),
    ],
)
def test_every_row_of_gymnasiums_table(env, env_id, order, settings, slippery):
    table = gym.make(env_id, is_slippery=slippery, **settings).unwrapped.P
    rewards = [] if env == "cliff_walking" else ["env.trap_reward=0"]
    mdp = configure(f"env={env}", f"env.slip={2 / 3 if slippery else 0.0}", *rewards).env.compile()
    assert len(table) == mdp.num_states
    for state in np.flatnonzero(~mdp.terminal).tolist():  # nobody plays on where it is over
        for action, ours_of in enumerate(order):
            row = state, ours_of
            leads_to = mdp.next_state[row].tolist()
            ours = zip(mdp.probability[row], leads_to, mdp.reward[row], mdp.terminal[leads_to], strict=True)
            assert merged(ours) == pytest.approx(merged(table[state][action]))


def test_its_known_returns():
    evaluator = Evaluator(cliff(), 1.0, 1000)
    edge = evaluator.score(evaluator.optimal_policy())
    assert (evaluator.optimal_value, edge.value, edge.outcome.expected_length) == (-13, -13, 13)
    assert edge.certified
    safe = evaluator.score(safe_way())
    assert (safe.value, safe.outcome.goal, safe.regret) == (-17, 1, 4)
    assert not safe.certified
    falling = one_hot_policy(np.full(48, RIGHT), 4)
    outcome = evaluator.score(falling).outcome
    assert (outcome.timeout, outcome.trap, outcome.expected_return) == (1, 0, -100_000)
    assert evaluator.endless_states(falling) == [3 * 12]


def test_a_fall_may_be_the_way_to_an_end():
    mdp = compile_mdp(parse("..C.\n..CC\nS.G.", "island"), trap_reward=-2)
    assert mdp.layout.starts == ((2, 0),)
    actions = np.full(12, RIGHT)
    actions[3] = LEFT  # off the island, which is far from the start
    chain = Chain(mdp, one_hot_policy(actions, 4))
    assert chain.value(1)[[3, 8]].tolist() == [-1, 1]
    assert chain.endless_states().size == 0
    actions[8] = UP  # to the edge, off it, and again
    assert Chain(mdp, one_hot_policy(actions, 4)).endless_states().tolist() == [4, 5, 8]


def test_the_random_walk_has_the_values_of_example_6_2():
    values = Chain(random_walk(), np.full((7, 2), 0.5)).value(1.0)
    assert values[1:-1] == pytest.approx(np.arange(1, 6) / 6)
    longer = random_walk(19)
    assert Chain(longer, np.full((21, 2), 0.5)).value(1.0)[1:-1] == pytest.approx(np.arange(1, 20) / 20)
    assert longer.start_states.tolist() == [10]
    assert (longer.goal.nonzero()[0].tolist(), longer.trap.nonzero()[0].tolist()) == ([20], [0])


def river_by_hand(length, gamma, sweeps):
    """Value iteration over the figure's arrows, and the gain of the best policy, per step."""
    v = [0.0] * length
    for _ in range(sweeps):
        old, v = v, []
        for s in range(length):
            left = (0.005 if s == 0 else 0.0) + gamma * old[max(s - 1, 0)]
            if s == 0:
                right = gamma * (0.4 * old[0] + 0.6 * old[1])
            elif s == length - 1:
                right = 1.0 + gamma * (0.6 * old[s] + 0.4 * old[s - 1])
            else:
                right = gamma * (0.35 * old[s + 1] + 0.6 * old[s] + 0.05 * old[s - 1])
            v.append(max(left, right))
    return v, v[0] - old[0]


def test_river_swim_has_the_value_of_a_naive_solver():
    mdp = river_swim()
    assert (mdp.num_states, mdp.max_episode_steps, mdp.terminal.any()) == (6, 20, False)
    assert value_iteration(mdp, 0.95).v == pytest.approx(river_by_hand(6, 0.95, 1000)[0])
    always_right = np.tile([0.0, 1.0], (6, 1))
    gain = river_by_hand(6, 1.0, 2000)[1]  # the average reward of the optimum
    assert Chain(mdp, always_right).outcome(4001).expected_return - Chain(mdp, always_right).outcome(
        4000
    ).expected_return == pytest.approx(gain)
    assert river_swim(12).max_episode_steps == 40


@pytest.mark.parametrize("seed", [None, 7])
def test_deep_sea_is_worth_99_hundredths(seed):
    mdp = deep_sea(10, seed)
    judge = Evaluator(mdp, 1.0, mdp.max_episode_steps)
    assert judge.optimal_value == pytest.approx(0.99)
    assert (judge.optimum.goal, judge.optimum.expected_length) == (pytest.approx(1), pytest.approx(10))
    uniform = Chain(mdp, np.full((mdp.num_states, 2), 0.5)).outcome(10)
    assert uniform.goal == pytest.approx(2**-10)
    assert uniform.trap == pytest.approx(1 - 2**-10)


def test_the_actions_of_deep_sea_are_drawn_as_bsuite_draws_them():
    size, seed = 5, 3
    right = np.random.RandomState(seed).binomial(1, 0.5, [size, size])
    mdp = deep_sea(size, seed)
    assert mdp.action_names == ("0", "1")
    for row in range(size - 1):
        for col in range(size):
            leads = mdp.next_state[row * size + col, :, 0] - (row + 1) * size
            assert leads[right[row, col]] == min(col + 1, size - 1)
            assert leads[1 - right[row, col]] == max(col - 1, 0)


@pytest.mark.parametrize("seed", [None, 1])
def test_a_combination_lock_opens_by_one_combination(seed):
    mdp = combination_lock(6, 3, seed)
    judge = Evaluator(mdp, 0.99, mdp.max_episode_steps)
    assert judge.optimal_value == pytest.approx(0.99**5)
    assert judge.solution.optimal[:6].sum(axis=1).tolist() == [1] * 6
    assert (judge.solution.optimal[:6, -1].all()) == (seed is None)
    wrong = ~judge.solution.optimal[:6]
    assert (mdp.next_state[:6, :, 0][wrong] == 0).all()
    assert (mdp.name, mdp.max_episode_steps) == ("combination lock 6", 60)


def test_every_state_that_is_seen_has_a_place():
    for mdp in (river_swim(), combination_lock(), random_walk()):
        assert mdp.places.tolist() == [[0, 0, col] for col in range(mdp.num_states)]
    sea = deep_sea(4)
    assert sea.places[:16].tolist() == [[0, row, col] for row in range(4) for col in range(4)]
    assert sea.places[16:].tolist() == [[-1, -1, -1]] * 2
    assert sea.number[16:].tolist() == [16, 16]


@pytest.mark.parametrize(
    ("builder", "arguments", "told"),
    [
        (river_swim, {"length": 1}, "length=1: must be a whole number from 2"),
        (deep_sea, {"size": True}, "size=True"),
        (deep_sea, {"size": 501}, "size=501: must be a whole number from 2 to 500"),
        (deep_sea, {"seed": -1}, "seed=-1"),
        (combination_lock, {"length": 0}, "length=0"),
        (combination_lock, {"num_actions": 1}, "num_actions=1"),
        (random_walk, {"length": 4}, "length=4: must be odd"),
        (random_walk, {"length": "5"}, "length=5: must be a whole number"),
    ],
)
def test_other_arguments_are_refused(builder, arguments, told):
    with pytest.raises(InputError, match=f"^{told}"):
        builder(**arguments)
