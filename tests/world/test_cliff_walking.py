"""Gymnasium's CliffWalking (Sutton & Barto's example 6.6) and FrozenLake are maps of ours, row by row."""

import gymnasium as gym
import numpy as np
import pytest
from helpers.support import configure

from gridworld.world.chain import Chain, one_hot_policy
from gridworld.world.evaluation import Evaluator
from gridworld.world.grid import compile_mdp
from gridworld.world.layout import parse

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
