"""Exact scores agree with played episodes and with the oracle; certificates mean what they say."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracle import maps

from gridworld.chain import one_hot_policy
from gridworld.evaluation import Judge, play_episode
from gridworld.layout import load, parse, shipped_layouts
from gridworld.mdp import compile_mdp

CLASSIC = Judge(compile_mdp(load("classic")), 0.99, 100)


@pytest.mark.parametrize(
    ("layout", "settings"),
    [
        ("classic", {}),
        ("frozen_lake_4x4", {"slip": 2 / 3, "trap_reward": 0.0}),
        ("aima_4x3", {"slip": 0.2, "step_reward": -0.04}),
        ("cliff", {"step_reward": -1.0, "goal_reward": 0.0, "trap_reward": -99.0}),
    ],
)
def test_sampled_episodes_agree_with_the_exact_scores(layout: str, settings: dict) -> None:
    judge = Judge(compile_mdp(load(layout), **settings), 0.99, 60)
    policy = np.random.default_rng(1).dirichlet(np.ones(4), size=judge.mdp.num_states)
    exact = judge.score(policy)
    sampled = judge.sample(policy, 20_000, seed=2)
    for estimate, truth in (
        (sampled.goal, exact.outcome.goal),
        (sampled.trap, exact.outcome.trap),
        (sampled.timeout, exact.outcome.timeout),
        (sampled.length, exact.outcome.expected_length),
        (sampled.episode_return, exact.outcome.expected_return),
    ):
        half_width = (estimate.high - estimate.low) / 2
        assert abs(estimate.mean - truth) <= 2.5 * half_width


def test_only_shortest_safe_ways_are_certified() -> None:
    best = CLASSIC.score(CLASSIC.optimal_policy())
    assert best.certified
    assert best.regret == pytest.approx(0, abs=1e-12)
    detour = np.argmax(CLASSIC.optimal_policy(), axis=1)
    detour[[0, 6, 7]] = 2, 1, 0  # down, right and up again: two steps more
    score = CLASSIC.score(one_hot_policy(detour))
    assert score.outcome.goal == 1
    assert score.outcome.expected_length == 10
    assert not score.certified
    assert score.regret == pytest.approx(0.99**7 - 0.99**9)


def test_a_certificate_is_relative_on_far_goals() -> None:
    judge = Judge(compile_mdp(parse("S" + "." * 2000 + "G", "corridor")), 0.99, 5000)
    right = one_hot_policy(np.full(2002, 1))
    assert judge.optimal_value == pytest.approx(0.99**2000, rel=1e-9)
    assert judge.score(right).certified
    still = one_hot_policy(np.zeros(2002, dtype=int))
    assert judge.score(still).regret < 1e-6  # a tiny value, yet
    assert not judge.score(still).certified


def test_circles_are_found_without_being_walked() -> None:
    actions = np.zeros(30, dtype=int)
    actions[0], actions[1], actions[7], actions[6] = 1, 2, 3, 0  # round the first square
    policy = one_hot_policy(actions)
    assert CLASSIC.endless_cells(policy) == [(0, 0), (0, 1), (1, 0), (1, 1)]
    assert CLASSIC.score(policy).outcome.timeout == 1
    assert len(play_episode(CLASSIC.mdp, policy, 100, seed=0)) == 101


def test_an_episode_is_the_policys_own_walk() -> None:
    states = play_episode(CLASSIC.mdp, CLASSIC.optimal_policy(), 100, seed=0)
    assert states[0] == 0
    assert states[-1] == 16
    assert len(states) == 9
    uniform = np.full((30, 4), 0.25)
    walks = [play_episode(CLASSIC.mdp, uniform, 100, seed).tolist() for seed in (0, 0, 1)]
    assert walks[0] == walks[1] != walks[2]


def test_shares_have_intervals_even_without_a_hit() -> None:
    best = CLASSIC.sample(CLASSIC.optimal_policy(), 100, seed=0)
    assert (best.goal.mean, best.goal.high) == pytest.approx((1, 1))
    assert best.goal.low == pytest.approx(0.963, abs=1e-3)  # Wilson: 1 / (1 + 1.96² / 100)
    assert (best.trap.mean, best.trap.low) == pytest.approx((0, 0))
    assert best.trap.high == pytest.approx(0.037, abs=1e-3)


@pytest.mark.parametrize("layout", shipped_layouts())
@pytest.mark.parametrize("gamma", [0.9, 1.0])
@pytest.mark.parametrize("slip", [0.0, 0.5, 1.0])
def test_the_optimal_policy_earns_its_own_certificate(layout: str, gamma: float, slip: float) -> None:
    for step_reward in (0.0, -0.1):
        judge = Judge(compile_mdp(load(layout), slip, step_reward), gamma, 200)
        assert judge.solution.optimal.any(axis=1).all()
        assert judge.score(judge.optimal_policy()).certified
        if slip == 0 and step_reward == 0:
            assert judge.optimum.goal == 1  # it gets there, and does not put it off for ever


@given(world=maps(), slip=st.sampled_from([0.0, 0.1, 0.5, 1.0]), step=st.sampled_from([0.0, -0.07, -0.25]))
def test_undiscounted_optima_end_and_certify(world: list[str], slip: float, step: float) -> None:
    mdp = compile_mdp(parse("\n".join(world), "random"), slip, step, 0.8, -0.19)
    judge = Judge(mdp, 1.0, 100)
    assert judge.score(judge.optimal_policy()).certified
