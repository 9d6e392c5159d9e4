"""How often a policy comes to each state, discounted, without a step limit.

    d(s) = Σ_t γ^t P(s_t = s),    so    d = start + γ Pᵀ d

With γ = 1 a policy that never ends has no such sum. The walk then stops where it cannot end any more.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from gridworld.world.exact.markov_chain import Chain, can_reach
from gridworld.world.exact.one_thread import in_one_thread
from gridworld.world.mdp import BoolArray, FloatArray


def stopping_states(chain: Chain, gamma: float) -> BoolArray:
    """(S,), where nothing is counted any more; with γ = 1, where an episode cannot end any more."""
    mdp = chain.mdp
    if gamma < 1:
        return mdp.absorbing
    taken = (chain.policy[:, :, None] > 0) & (mdp.probability > 0)
    return mdp.absorbing | ~can_reach(mdp, taken, mdp.terminal)


@in_one_thread
def discounted_visits(chain: Chain, gamma: float, stops: BoolArray) -> FloatArray:
    """Discounted visits (S,) from the start distribution on: d(s) = Σ_t γ^t P(s_t = s).

    No one leaves a state of `stops` (S,); there it is the discounted probability to come there.
    """
    start, going = chain.mdp.start, np.flatnonzero(~stops)
    ahead = gamma * chain.transition[going]
    visits = start.copy()
    visits[going] = _solved(ahead[:, going], start[going])
    visits[stops] += (ahead.T @ visits[going])[stops]
    visits[visits < 0] = 0.0  # rounding
    return visits


def _solved(ahead: Any, right: FloatArray) -> FloatArray:
    if isinstance(ahead, np.ndarray):
        return np.asarray(np.linalg.solve(np.eye(len(right)) - ahead.T, right))
    from scipy.sparse import eye_array
    from scipy.sparse.linalg import spsolve

    return np.atleast_1d(spsolve((eye_array(len(right)) - ahead.T).tocsc(), right))
