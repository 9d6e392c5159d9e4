"""The exact optimum of a world: its values and all its optimal actions.

With V = 0 at the end of an episode, the optimum is the fixed point of

    Q*(s, a) = Σ_k p(k | s, a) [ r(s, a, k) + γ V*(next(s, a, k)) ],    V*(s) = max_a Q*(s, a),

found by value iteration and made exact by policy iteration.

References: M. L. Puterman, Markov Decision Processes, 1994, chapters 6 and 7; R. Sutton and A. Barto,
Reinforcement Learning, 2nd ed., 2018, chapter 4.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gridworld.chain import Chain, check_gamma, one_hot_policy
from gridworld.errors import InputError
from gridworld.mdp import BoolArray, FloatArray, IntArray, Mdp

# Two actions whose values agree to this relative precision are equally good. Rounding stays far below it.
TIE = 1e-9

_SWEEP_TOLERANCE = 1e-3  # sweeps need only find a good policy; the rest is solved exactly
_NEARLY_ONE = 1 - 1e-8  # one step more costs ten times as much as what counts as a tie
_IMPROVEMENT = 1e-11
_NOTHING = 1e-290  # a value that has faded so far is 0: the smallest numbers of all never get smaller


@dataclass(frozen=True, eq=False)
class Solution:
    """The optimum of a world under one discount."""

    gamma: float
    v: FloatArray  # (S,)
    q: FloatArray  # (S, A)
    optimal: BoolArray  # (S, A), True for every action as good as the best, also all actions where it is over
    scale: FloatArray  # (S,), expected discounted sum of |reward|: what "relative" is relative to


def value_iteration(mdp: Mdp, gamma: float) -> Solution:
    """V*, Q* and all optimal actions.

    Value iteration from V = 0 finds a good policy; policy iteration from there makes values and ties exact
    up to rounding. γ = 1 is taken as the limit of discounting (Blackwell's optimality): of two ways to the
    same return the shorter one, and never one that puts the end off for ever. Raises `InputError` where no
    finite optimum exists (γ = 1 and a positive step reward). With γ = 1 and a negative step reward, a cell
    from which no end can be reached has V = -inf.
    """
    gamma = check_gamma(gamma)
    if gamma < 1:
        return _discounted(mdp, gamma)
    if mdp.step_reward > 0:
        raise InputError(
            f"gamma=1 with step_reward={mdp.step_reward}: the return grows without end; "
            "take a gamma below 1 or a step_reward of at most 0"
        )
    limit = _discounted(mdp, _NEARLY_ONE)
    v, scale = Chain(mdp, one_hot_policy(np.argmax(limit.optimal, axis=1))).value_and_scale(1.0)
    return Solution(1.0, v, _backup(mdp, v, 1.0), limit.optimal, scale)


def _discounted(mdp: Mdp, gamma: float) -> Solution:
    greedy, seen = np.argmax(_backup(mdp, _sweep(mdp, gamma), gamma), axis=1), set()
    while True:
        v, scale = Chain(mdp, one_hot_policy(greedy)).value_and_scale(gamma)
        q = _backup(mdp, v, gamma)
        q_scale = _backup(mdp, scale, gamma, magnitude=True)
        best = np.argmax(q, axis=1)
        gain = _pick(q, best) - _pick(q, greedy)
        better = gain > _NOTHING + _IMPROVEMENT * np.maximum(_pick(q_scale, best), _pick(q_scale, greedy))
        seen.add(greedy.tobytes())
        greedy = np.where(better, best, greedy)
        if greedy.tobytes() in seen:  # no better action anywhere; by rounding, perhaps one met before
            tolerance = TIE * np.maximum(q_scale, _pick(q_scale, best)[:, None])
            return Solution(gamma, v, q, q >= _pick(q, best)[:, None] - tolerance, scale)


def _backup(
    mdp: Mdp,
    v: FloatArray,
    gamma: float,
    states: IntArray | slice = slice(None),
    magnitude: bool = False,
) -> FloatArray:
    """Q (n, A) of these states from the values of their successors; with `magnitude`, rewards as |reward|."""
    reward = np.abs(mdp.reward[states]) if magnitude else mdp.reward[states]
    target = reward + gamma * v[mdp.next_state[states]]
    if target.shape[2] == 1:
        return target[:, :, 0]
    possible = mdp.probability[states] > 0  # with γ = 1 an impossible outcome may be worth -inf
    q: FloatArray = np.einsum("sak,sak->sa", mdp.probability[states], np.where(possible, target, 0.0))
    return q


def _pick(table: FloatArray, actions: IntArray) -> FloatArray:
    """table[s, actions[s]] for every state."""
    return table[np.arange(len(actions)), actions]


def _sweep(mdp: Mdp, gamma: float) -> FloatArray:
    """Value iteration from V = 0, each sweep only where a successor's value has just changed.

    Changes are measured relative to the value, so the wave of a far goal is followed to the last cell,
    however small the discounted value has become there. Measured so, a value that fades away to 0 never
    comes to rest; sweeping stops when the waves from all ends have long passed.
    """
    v = np.zeros(mdp.num_states)
    playing = ~(mdp.terminal | mdp.wall)
    active = np.flatnonzero(playing)
    for _ in range(100 + 2 * max(_farthest(mdp, ends) for ends in (mdp.goal, mdp.trap))):
        if not active.size:
            break
        new = _backup(mdp, v, gamma, active).max(axis=1)
        changed = active[np.abs(new - v[active]) > _NOTHING + _SWEEP_TOLERANCE * np.abs(new)]
        v[active] = new
        affected = np.zeros(mdp.num_states, dtype=np.bool_)
        affected[changed] = True
        affected[mdp.predecessors(changed)] = True
        active = np.flatnonzero(affected & playing)
    return v


def _farthest(mdp: Mdp, ends: BoolArray) -> int:
    """Moves to the nearest of these ends from the cell that is farthest from them, past all other ends."""
    reached = mdp.terminal.copy()
    frontier: IntArray = np.flatnonzero(ends)
    moves = 0
    while frontier.size:
        around = np.unique(mdp.predecessors(frontier))
        frontier = around[~reached[around]]
        reached[frontier] = True
        moves += 1
    return moves
