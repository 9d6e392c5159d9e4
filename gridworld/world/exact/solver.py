"""The exact optimum of a world: its values and all its optimal actions.

With V = 0 at the end of an episode, the optimum is the fixed point of

    Q*(s, a) = Σ_k p(k | s, a) [ r(s, a, k) + γ V*(next(s, a, k)) ],    V*(s) = max_a Q*(s, a),

found by value iteration and made exact by policy iteration. `gridworld.world.exact.undiscounted` has what
differs with γ = 1 and with discounts just below it.

References: M. L. Puterman, Markov Decision Processes, 1994, chapter 6; R. Sutton and A. Barto, Reinforcement
Learning, 2nd ed., 2018, chapter 4.
"""

from __future__ import annotations

from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np

from gridworld.world.exact.bellman import backup, pick
from gridworld.world.exact.markov_chain import ORDINARY_GAMMA, Chain, check_gamma, one_hot_policy
from gridworld.world.exact.undiscounted import better_or_resting, solve_by_value_and_slope
from gridworld.world.mdp import BoolArray, FloatArray, IntArray, Mdp, frozen

# Two actions whose values agree to this relative precision are equally good. Rounding stays far below it.
TIE = 1e-9

_SWEEP_TOLERANCE = 1e-3  # sweeps need only find a good policy; the rest is solved exactly
_IMPROVEMENT = 1e-11  # relative; less than that is rounding
_PATIENT = 100.0  # steps; a longer horizon, 1 / (1 - γ), adds up more of what counts as a tie in one step
_MOST_SOLUTIONS = 8  # of a world that are kept
_NOTHING = 1e-290  # a value that has faded so far is 0: the smallest numbers of all never get smaller


@dataclass(frozen=True, eq=False)
class Solution:
    """The optimum of a world under one discount.

    Attributes:
        gamma: the discount.
        v: (S,), float64, V*.
        q: (S, A), float64, Q*.
        optimal: (S, A), True for every action as good as the best; all actions where it is over.
        scale: (S,), float64, the expected discounted sum of |reward|: what "relative" is relative to.
    """

    gamma: float
    v: FloatArray
    q: FloatArray
    optimal: BoolArray
    scale: FloatArray


def value_iteration(mdp: Mdp, gamma: float) -> Solution:
    """Find V*, Q* and all optimal actions, exact up to rounding.

    With γ = 1 and costs, a state from which every policy may go on paying for ever has V = -inf, and all its
    actions are as good as each other.

    Args:
        mdp: the world.
        gamma: the discount γ, from 0 to 1.

    Raises:
        InputError: another discount; or no finite optimum: γ = 1 and a way to go on earning for ever.
    """
    gamma = check_gamma(gamma)
    ordinary = min(gamma, ORDINARY_GAMMA)
    greedy: IntArray = np.argmax(backup(mdp, _sweep(mdp, ordinary), ordinary), axis=1)
    if gamma <= ORDINARY_GAMMA:
        return _solve_discounted(mdp, gamma, greedy)
    if gamma == 1:
        greedy = better_or_resting(mdp, greedy)
    found, optimal = solve_by_value_and_slope(mdp, gamma, greedy)
    return Solution(gamma, found.value, backup(mdp, found.value, gamma), optimal, found.scale)


_solved: WeakKeyDictionary[Mdp, dict[float, Solution]] = WeakKeyDictionary()


def solved(mdp: Mdp, gamma: float) -> Solution:
    """What `value_iteration` finds, found once for a world and discount; its arrays are read-only."""
    gamma, solutions = check_gamma(gamma), _solved.setdefault(mdp, {})
    if gamma not in solutions:
        solution = value_iteration(mdp, gamma)
        for table in (solution.v, solution.q, solution.optimal, solution.scale):
            frozen(table)
        while len(solutions) >= _MOST_SOLUTIONS:
            del solutions[next(iter(solutions))]
        solutions[gamma] = solution
    return solutions[gamma]


def _solve_discounted(mdp: Mdp, gamma: float, greedy: IntArray) -> Solution:
    """Policy iteration from `greedy` (S,)."""
    seen = set()
    precision = min(1.0, _PATIENT * (1 - gamma))
    while True:
        found = Chain(mdp, one_hot_policy(greedy, mdp.num_actions)).evaluation(gamma)
        v, scale = found.value, found.scale
        q = backup(mdp, v, gamma)
        q_scale = backup(mdp, scale, gamma, magnitude=True)
        best = np.argmax(q, axis=1)
        gain = pick(q, best) - pick(q, greedy)
        least = precision * _IMPROVEMENT * np.maximum(pick(q_scale, best), pick(q_scale, greedy))
        seen.add(greedy.tobytes())
        greedy = np.where(gain > _NOTHING + least, best, greedy)
        if greedy.tobytes() in seen:  # no better action anywhere; by rounding, perhaps one met before
            tolerance = precision * TIE * np.maximum(q_scale, pick(q_scale, best)[:, None])
            return Solution(gamma, v, q, q >= pick(q, best)[:, None] - tolerance, scale)


def _sweep(mdp: Mdp, gamma: float) -> FloatArray:
    """Value iteration from V = 0, each sweep only where a successor's value has just changed.

    Changes are measured relative to the value, so the wave of a far goal is followed to the last cell,
    however small the discounted value has become there. Measured so, a value that fades away to 0 never
    comes to rest; sweeping stops when the waves from all ends have long passed.
    """
    v = np.zeros(mdp.num_states)
    playing = ~mdp.absorbing
    active = np.flatnonzero(playing)
    for _ in range(100 + 2 * max(_farthest(mdp, ends) for ends in (mdp.goal, mdp.trap))):
        if not active.size:
            break
        new = backup(mdp, v, gamma, active).max(axis=1)
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
