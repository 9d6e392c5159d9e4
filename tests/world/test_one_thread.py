"""Values do not depend on how many threads the linear algebra may take."""

import numpy as np
import pytest
from helpers.support import configure

from gridworld.world.exact.markov_chain import Chain, _openblas


@pytest.mark.parametrize("env", ["four_rooms", "maze"])
def test_a_value_has_the_same_bits_with_any_number_of_threads(env: str) -> None:
    mdp = configure(f"env={env}").env.compile()
    policy = np.random.default_rng(0).dirichlet(np.ones(mdp.num_actions), mdp.num_states)
    count, limit = _openblas()
    before, found = count(), set()
    try:
        for threads in (1, 2, 3):
            limit(threads)
            chain = Chain(mdp, policy)
            numbers = [chain.value(0.99), chain.discounted_return(50, 0.9), chain.outcome(50).expected_return]
            found.add(b"".join(np.asarray(number).tobytes() for number in numbers))
            assert count() in (1, threads)  # it is left as it was; not every library has so many
    finally:
        limit(before)
    assert len(found) == 1
