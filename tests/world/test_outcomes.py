"""A world made of outcomes that end episodes is worth what a plain walk that keeps the flags says."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gridworld import InputError
from gridworld.world.chain import Chain
from gridworld.world.outcomes import Outcomes, mdp_from_outcomes

HORIZON = 7


@st.composite
def outcomes(draw):
    n, a, k = draw(st.integers(1, 5)), draw(st.integers(1, 3)), draw(st.integers(1, 3))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    weights = rng.integers(0, 4, (n, a, k)) + 1e-9 * (np.arange(k) == 0)
    weights[weights.sum(axis=2) < 1] = np.eye(k)[-1]
    starts = rng.integers(0, 2, n)
    starts[rng.integers(n)] += 1
    shape = (n, a, k)
    return Outcomes(
        next_state=rng.integers(n, size=shape),
        probability=weights / weights.sum(axis=2, keepdims=True),
        reward=rng.integers(-2, 3, shape).astype(float),
        terminated=rng.random(shape) < draw(st.sampled_from([0.0, 0.3, 1.0])),
        start=starts / starts.sum(),
        success=rng.random(shape) < 0.5 if draw(st.booleans()) else None,
    )


def rows(table, policy, state):
    for action, chosen in enumerate(policy[state]):
        for k, p in enumerate(table.probability[state, action]):
            if chosen * p > 0:
                at = state, action, k
                yield chosen * p, int(table.next_state[at]), float(table.reward[at]), at


def successes(table):
    if table.success is not None:
        return table.success
    seen, ends, frontier = set(), [], list(np.flatnonzero(table.start))
    while frontier:
        state = int(frontier.pop())
        if state in seen:
            continue
        seen.add(state)
        for at in np.ndindex(table.probability[state].shape):
            where = (state, *at)
            if table.probability[where] > 0 and table.terminated[where]:
                ends.append(table.reward[where])
            elif table.probability[where] > 0:
                frontier.append(table.next_state[where])
    return table.reward == max(ends, default=0)


def walked(table, policy):
    """(probabilities of success, failure and time-out, return, length) of an episode, by its flags."""
    at, good = dict(enumerate(table.start)), successes(table)
    totals = np.zeros(5)
    for _ in range(HORIZON):
        following = {}
        for state, mass in at.items():
            for p, target, reward, where in rows(table, policy, state):
                totals[3:] += mass * p * reward, mass * p
                if table.terminated[where]:
                    totals[0 if good[where] else 1] += mass * p
                else:
                    following[target] = following.get(target, 0) + mass * p
        at = following
    totals[2] = sum(at.values())
    return totals


def valued(table, policy, gamma=0.8):
    values = np.zeros(len(table.start))
    for _ in range(120):
        values = np.array(
            [
                sum(
                    p * (reward + gamma * (0 if table.terminated[where] else values[target]))
                    for p, target, reward, where in rows(table, policy, state)
                )
                for state in range(len(values))
            ]
        )
    return values


@given(outcomes(), st.integers(0, 2**32))
def test_a_world_is_worth_what_a_walk_with_flags_is(table, seed):
    policy = np.random.default_rng(seed).dirichlet(np.ones(table.next_state.shape[1]), len(table.start))
    mdp = mdp_from_outcomes("random", table)
    own = policy[mdp.number]
    chain = Chain(mdp, own)
    found = chain.outcome(HORIZON)
    of_ends = found.goal, found.trap, found.timeout, found.expected_return, found.expected_length
    assert np.allclose(of_ends, walked(table, policy), atol=1e-9)
    assert np.isclose(mdp.start @ chain.value(0.8), table.start @ valued(table, policy), atol=1e-9)


@given(outcomes())
def test_a_state_in_which_an_episode_goes_on_keeps_its_rows(table):
    mdp = mdp_from_outcomes("random", table)
    for state in np.flatnonzero(~mdp.terminal):
        possible = table.probability[state] > 0
        assert np.array_equal(mdp.probability[state], table.probability[state])
        assert np.array_equal(mdp.reward[state][possible], table.reward[state][possible])
        assert np.array_equal(mdp.number[mdp.next_state[state]][possible], table.next_state[state][possible])
        ends = mdp.terminal[mdp.next_state[state]]
        assert (ends | ~table.terminated[state])[possible].all()
    assert not (mdp.start[mdp.terminal] > 0).any()


def two_states(**changed):
    table = {
        "next_state": np.array([[[0], [1]], [[0], [1]]]),
        "probability": np.ones((2, 2, 1)),
        "reward": np.zeros((2, 2, 1)),
        "terminated": np.zeros((2, 2, 1), dtype=np.bool_),
        "start": np.array([1.0, 0.0]),
    }
    return Outcomes(**{**table, **changed})


def test_worlds_that_are_too_large_are_refused_with_what_they_would_take():
    many = np.broadcast_to(np.int64(0), (600_000, 2, 1))
    with pytest.raises(InputError, match="600,000 states and 2 actions are too many"):
        mdp_from_outcomes("big", two_states(next_state=many, **as_large(many)))
    wide = np.broadcast_to(np.int64(0), (100_000, 100, 20))
    with pytest.raises(InputError, match=r"would take [\d.]+ GiB of memory; at most 4 GiB"):
        mdp_from_outcomes("wide", two_states(next_state=wide, **as_large(wide)))


def as_large(table):
    zeros = {name: np.broadcast_to(0.0, table.shape) for name in ("probability", "reward")}
    return {**zeros, "terminated": np.broadcast_to(False, table.shape), "start": np.zeros(len(table))}
