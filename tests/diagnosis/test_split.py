"""The regret's shares of the states: against a second computation by loops, and what they add up to."""

import numpy as np
import pytest
from helpers.oracle import MOVES, World, maps
from hypothesis import given
from hypothesis import strategies as st

from gridworld.diagnosis.evidence import split_regret
from gridworld.world.chain import one_hot_policy
from gridworld.world.evaluation import Evaluator
from gridworld.world.grid import compile_mdp
from gridworld.world.layout import parse

_SETTINGS = st.fixed_dictionaries(
    {
        "slip": st.sampled_from([0.0, 0.1, 0.5]),
        "step_reward": st.sampled_from([0.0, -0.1, -1.0]),
        "trap_reward": st.sampled_from([-1.0, 0.0]),
    }
)


def _policy(num_states: int, seed: int, greedy: bool) -> np.ndarray:
    random = np.random.default_rng(seed)
    if greedy:
        return one_hot_policy(random.integers(4, size=num_states), 4)
    return random.dirichlet(np.ones(4), size=num_states)


@given(maps(), _SETTINGS, st.integers(0, 99), st.booleans(), st.sampled_from([0.0, 0.5, 0.9]))
def test_every_share_is_that_of_the_oracle(rows, settings, seed, greedy, gamma) -> None:
    world = World(rows, **settings)
    evaluator = Evaluator(compile_mdp(parse("\n".join(rows), "map"), **settings), gamma, 50)
    policy = _policy(evaluator.mdp.num_states, seed, greedy)
    split = split_regret(evaluator, policy)
    best = world.optimal_values(gamma)
    chance, weight = {cell: (cell in world.starts) / len(world.starts) for cell in world.cells}, 1.0
    cost = dict.fromkeys(world.cells, 0.0)
    while weight > 1e-13:  # step by step, discounted
        following = dict.fromkeys(world.cells, 0.0)
        for cell in world.cells:
            for action in MOVES if chance[cell] else ():
                share = chance[cell] * policy[world.state(cell)][action]
                cost[cell] += weight * share * (best[cell] - world.q(best, cell, action, gamma))
                for probability, target, _, _ in world.outcomes(cell, action):
                    following[target] += share * probability
        chance, weight = following, weight * gamma
    for cell in world.cells:
        assert split.cost[world.state(cell)] == pytest.approx(cost[cell], abs=1e-9)


@given(maps(), _SETTINGS, st.integers(0, 99), st.booleans(), st.sampled_from([0.5, 0.99, 0.9999, 1.0]))
def test_the_shares_add_up_to_the_regret(rows, settings, seed, greedy, gamma) -> None:
    evaluator = Evaluator(compile_mdp(parse("\n".join(rows), "map"), **settings), gamma, 50)
    policy = _policy(evaluator.mdp.num_states, seed, greedy)
    split = split_regret(evaluator, policy)
    regret, scale = evaluator.score(policy).regret, max(1.0, float(evaluator.solution.scale.max()))
    if np.isfinite(regret):
        assert split.cost.sum() == pytest.approx(regret, abs=1e-9 * scale)
        assert (split.cost >= -1e-9 * scale).all()
    else:
        assert split.cost.sum() == regret
    if gamma < 1:  # else it may cost something to go in circles by optimal actions
        assert np.abs(split.cost[~split.wrong]).max() <= 1e-7 * scale


def test_without_a_discount_an_endless_walk_costs_where_it_stops() -> None:
    evaluator = Evaluator(compile_mdp(parse("S.G", "map")), 1.0, 50)
    left = one_hot_policy(np.full(3, 3), 4)
    assert split_regret(evaluator, left).cost.tolist() == [1.0, 0.0, 0.0]
