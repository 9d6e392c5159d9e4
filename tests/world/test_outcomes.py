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
    """All that may happen in a state: (probability, next state, reward, where in the table)."""
    for action, k in np.ndindex(table.probability[state].shape):
        at = state, action, k
        if (p := policy[state, action] * table.probability[at]) > 0:
            yield p, int(table.next_state[at]), float(table.reward[at]), at


def successes(table):
    if table.success is not None:
        return table.success
    policy = np.ones(table.next_state.shape[:2])
    seen, ends, frontier = set(), [0], list(np.flatnonzero(table.start))
    while frontier:
        state = int(frontier.pop())
        if state not in seen:
            seen.add(state)
            found = list(rows(table, policy, state))
            ends += [reward for _, _, reward, at in found if table.terminated[at]]
            frontier += [target for _, target, _, at in found if not table.terminated[at]]
    return table.reward == max(ends[1:], default=0)


def walked(table, policy):
    """(probabilities of success, failure and time-out, return, length) of an episode, by its flags."""
    masses, good = dict(enumerate(table.start)), successes(table)
    totals = np.zeros(5)
    for _ in range(HORIZON):
        following = {}
        for state, mass in masses.items():
            for p, target, reward, at in rows(table, policy, state):
                totals[3:] += mass * p * reward, mass * p
                if table.terminated[at]:
                    totals[0 if good[at] else 1] += mass * p
                else:
                    following[target] = following.get(target, 0) + mass * p
        masses = following
    totals[2] = sum(masses.values())
    return totals


def valued(table, policy, gamma=0.8):
    values = np.zeros(len(table.start))
    known = [list(rows(table, policy, state)) for state in range(len(values))]
    for _ in range(120):
        going_on = np.where(table.terminated, 0.0, gamma * values[table.next_state])
        values = np.array([sum(p * (reward + going_on[at]) for p, _, reward, at in row) for row in known])
    return values


@given(outcomes(), st.integers(0, 2**32))
def test_a_world_is_worth_what_a_walk_with_flags_is(table, seed):
    policy = np.random.default_rng(seed).dirichlet(np.ones(table.next_state.shape[1]), len(table.start))
    mdp = mdp_from_outcomes("random", table)
    chain = Chain(mdp, policy[mdp.number])
    found = chain.outcome(HORIZON)
    of_ends = found.goal, found.trap, found.timeout, found.expected_return, found.expected_length
    assert np.allclose(of_ends, walked(table, policy), atol=1e-9)
    assert np.isclose(mdp.start @ chain.value(0.8), table.start @ valued(table, policy), atol=1e-9)
    assert not (mdp.start[mdp.terminal] > 0).any()
    for state in np.flatnonzero(~mdp.terminal):  # where an episode goes on, the rows are kept
        possible, leads_to = table.probability[state] > 0, mdp.next_state[state]
        assert np.array_equal(mdp.probability[state], table.probability[state])
        assert np.array_equal(mdp.reward[state][possible], table.reward[state][possible])
        assert np.array_equal(mdp.number[leads_to][possible], table.next_state[state][possible])
        assert (mdp.terminal[leads_to] | ~table.terminated[state])[possible].all()


@pytest.mark.parametrize(
    ("shape", "told"),
    [
        ((600_000, 2, 1), "600,000 states and 2 actions are too many"),
        ((100_000, 100, 20), r"would take [\d.]+ GiB of memory; at most 4 GiB"),
    ],
)
def test_worlds_that_are_too_large_are_refused_with_what_they_would_take(shape, told):
    tables = {name: np.broadcast_to(0.0, shape) for name in ("probability", "reward")}
    tables |= {"next_state": np.broadcast_to(np.int64(0), shape), "terminated": np.broadcast_to(False, shape)}
    with pytest.raises(InputError, match=told):
        mdp_from_outcomes("big", Outcomes(**tables, start=np.zeros(shape[0])))
