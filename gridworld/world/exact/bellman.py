"""One step of Bellman's equation over all states, which every solver here is made of."""

from __future__ import annotations

import numpy as np

from gridworld.world.mdp import FloatArray, IntArray, Mdp


def backup(
    mdp: Mdp,
    v: FloatArray,
    gamma: float,
    states: IntArray | slice = slice(None),
    magnitude: bool = False,
) -> FloatArray:
    """Q(s, a) = Σ_k p_k [ r_k + γ v(next_k) ] (n, A) of `states` (n,); `magnitude` takes |r_k| for r_k."""
    reward = np.abs(mdp.reward[states]) if magnitude else mdp.reward[states]
    target = reward + gamma * v[mdp.next_state[states]]
    if target.shape[2] == 1:
        return target[:, :, 0]
    possible = mdp.probability[states] > 0  # with γ = 1 an impossible outcome may be worth -inf
    q: FloatArray = np.einsum("sak,sak->sa", mdp.probability[states], np.where(possible, target, 0.0))
    return q


def pick(table: FloatArray, actions: IntArray) -> FloatArray:
    """Look up table[s, actions[s]] (S,) in a table (S, A) with an action per state (S,)."""
    return table[np.arange(len(actions)), actions]
