"""Draws that environments share out evenly: each environment's own chances stay what they are."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from gridworld import GridWorldEnv
from gridworld.envs.vector_env import GridWorldVectorEnv, stratified_numbers
from gridworld.world.mdp import FloatArray, IntArray

GROUPS = st.lists(st.integers(0, 9), min_size=1, max_size=60).map(np.array)


def by_hand(groups: IntArray, rng: np.random.Generator) -> FloatArray:
    """Group by group, member by member."""
    numbers = np.empty(len(groups))
    for group in sorted(set(groups.tolist())):
        shift = rng.random()
        members = [place for place, other in enumerate(groups) if other == group]
        for rank, place in enumerate(members):
            numbers[place] = (rank / len(members) + shift) % 1.0
    return numbers


@given(GROUPS, st.integers(0, 2**32 - 1), st.sampled_from([0, 70_000]))
def test_the_numbers_are_those_of_a_loop_over_groups(groups: IntArray, seed: int, first: int) -> None:
    found, expected = np.random.default_rng(seed), np.random.default_rng(seed)
    assert np.array_equal(stratified_numbers(groups + first, found), by_hand(groups, expected))
    assert found.bit_generator.state == expected.bit_generator.state


def test_the_starts_are_spread_over_the_states() -> None:
    mdp = GridWorldEnv().mdp.with_exploring_starts(1.0)
    envs = GridWorldVectorEnv(len(mdp.start_states) * 7, mdp=mdp, stratified=True)
    states, _ = envs.reset(seed=0)
    assert (np.bincount(states)[mdp.start_states] == 7).all()
