"""The exact answers: optimal values, the value of any policy, its outcome within the step limit.

With V = 0 at the end of an episode, the optimum is the fixed point of

    Q*(s, a) = Σ_k p(k | s, a) [ r(s, a, k) + γ V*(next(s, a, k)) ],    V*(s) = max_a Q*(s, a)

and the value of a policy π solves the linear system V = r_π + γ P_π V. A policy is a table (S, A) of action
probabilities. Small worlds are solved densely, large ones with a sparse LU factorisation.

References: M. L. Puterman, Markov Decision Processes, 1994, chapters 6 and 7; R. Sutton and A. Barto,
Reinforcement Learning, 2nd ed., 2018, chapter 4.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from gridworld.errors import InputError
from gridworld.layout import positive_int
from gridworld.mdp import NUM_ACTIONS, BoolArray, FloatArray, IntArray, Mdp

# Two actions whose values agree to this relative precision are equally good. Rounding stays far below it.
TIE = 1e-9

_DENSE_STATES = 512  # up to here a dense matrix is both faster and small
_SWEEP_TOLERANCE = 1e-3  # with discounting, sweeps need only find a good policy; the rest is solved exactly
_UNDISCOUNTED_TOLERANCE = 1e-15
_IMPROVEMENT = 1e-11


@dataclass(frozen=True, eq=False)
class Solution:
    """The optimum of a world under one discount."""

    gamma: float
    v: FloatArray  # (S,)
    q: FloatArray  # (S, A)
    optimal: BoolArray  # (S, A), True for every action as good as the best, also all actions where it is over
    scale: FloatArray  # (S,), expected discounted sum of |reward|: what "relative" is relative to


@dataclass(frozen=True)
class Outcome:
    """What one episode of a policy comes to, in expectation over starts, slips and the policy's own draws."""

    goal: float  # probabilities; goal + trap + timeout = 1
    trap: float
    timeout: float
    expected_return: float  # undiscounted sum of rewards
    expected_length: float  # steps


def check_gamma(gamma: float) -> float:
    """A discount as a float in [0, 1]; `InputError` otherwise."""
    if isinstance(gamma, bool) or not isinstance(gamma, int | float | np.number) or not 0 <= gamma <= 1:
        raise InputError(f"gamma={gamma!r}: a discount must be a number from 0 to 1")
    return float(gamma)


def value_iteration(mdp: Mdp, gamma: float) -> Solution:
    """V*, Q* and all optimal actions.

    Value iteration from V = 0 finds the policy; with γ < 1, policy iteration from there then makes values
    and ties exact up to rounding. Raises `InputError` where no finite optimum exists (γ = 1 and a positive
    step reward). With γ = 1 and a negative step reward, a cell from which no end can be reached has V = -inf.
    """
    gamma = check_gamma(gamma)
    if gamma == 1 and mdp.step_reward > 0:
        raise InputError(
            f"gamma=1 with step_reward={mdp.step_reward}: the return grows without end; "
            "take a gamma below 1 or a step_reward of at most 0"
        )
    v = _sweep(mdp, gamma)
    q = _backup(mdp, v, gamma)
    if gamma == 1:
        return Solution(gamma, v, q, q >= (v - TIE * np.abs(v))[:, None], np.abs(v))
    greedy, seen = np.argmax(q, axis=1), set()
    while True:
        v, scale = _solve(mdp, one_hot_policy(greedy), gamma, precise=True)
        q = _backup(mdp, v, gamma)
        q_scale = _backup(mdp, scale, gamma, magnitude=True)
        best = np.argmax(q, axis=1)
        gain = _pick(q, best) - _pick(q, greedy)
        better = gain > _IMPROVEMENT * np.maximum(_pick(q_scale, best), _pick(q_scale, greedy))
        seen.add(greedy.tobytes())
        greedy = np.where(better, best, greedy)
        if greedy.tobytes() in seen:  # no better action anywhere; by rounding, perhaps one met before
            tolerance = TIE * np.maximum(q_scale, _pick(q_scale, best)[:, None])
            return Solution(gamma, v, q, q >= _pick(q, best)[:, None] - tolerance, scale)


def policy_value(mdp: Mdp, policy: FloatArray, gamma: float) -> FloatArray:
    """V_π (S,), exact. With γ = 1, a policy that may go on for ever is worth 0 or ±inf by its step reward."""
    return _solve(mdp, check_policy(mdp, policy), check_gamma(gamma))[0]


def outcome(mdp: Mdp, policy: FloatArray, max_steps: int) -> Outcome:
    """Goal, trap and time-out probability, return and length, exact for episodes of at most `max_steps`."""
    positive_int("max_steps", max_steps)
    policy = check_policy(mdp, policy)
    transition, reward = _policy_tables(mdp, policy)
    backwards = transition.T
    live = ~mdp.terminal
    mass, expected_return, expected_length = mdp.start, 0.0, 0.0
    for _ in range(max_steps):
        running = float(mass[live].sum())
        if running == 0.0:
            break
        expected_length += running
        expected_return += float((mass * reward).sum())  # a dot product would wake BLAS's threads
        mass = backwards @ mass
    goal, trap = float(mass[mdp.goal].sum()), float(mass[mdp.trap].sum())
    return Outcome(goal, trap, float(mass[live].sum()), expected_return, expected_length)


def endless_states(mdp: Mdp, policy: FloatArray) -> IntArray:
    """States, ascending, that a started episode may come to walk in for ever; empty for a policy that ends.

    For a deterministic policy in a world without slip these are the cells of its cycle.
    """
    policy = check_policy(mdp, policy)
    taken = _taken(mdp, policy)
    reached = np.zeros(mdp.num_states, dtype=np.bool_)
    frontier: IntArray = mdp.start_states
    while frontier.size:
        reached[frontier] = True
        following = np.unique(mdp.next_state[frontier][taken[frontier]])
        frontier = following[~reached[following]]
    states: IntArray = np.flatnonzero(reached & ~_can_end(mdp, taken))
    while True:  # what lies on the way into a cycle has no predecessor here and drops out
        following = np.unique(mdp.next_state[states][taken[states]])
        if following.size == states.size:
            return states
        states = following


def one_hot_policy(actions: IntArray) -> FloatArray:
    """The table (S, A) of a deterministic policy, from its action in every state (S,)."""
    policy = np.zeros((len(actions), NUM_ACTIONS))
    policy[np.arange(len(actions)), actions] = 1.0
    return policy


def check_policy(mdp: Mdp, policy: ArrayLike) -> FloatArray:
    """`policy` as float64 with rows that sum to 1; `InputError` where it is no policy of this world."""
    try:
        table: FloatArray = np.asarray(policy, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"policy={policy!r}: must be a table of action probabilities") from None
    if table.shape != (mdp.num_states, NUM_ACTIONS):
        raise InputError(
            f"policy of shape {table.shape}: this world needs ({mdp.num_states}, {NUM_ACTIONS}), "
            "a row of action probabilities per state"
        )
    total = table.sum(axis=1, keepdims=True)
    wrong = ~((table >= 0).all(axis=1) & (np.abs(total[:, 0] - 1) <= 1e-4))
    if wrong.any():
        state = int(np.argmax(wrong))
        raise InputError(f"policy: row {state} is {table[state].tolist()}, not a probability distribution")
    normalised: FloatArray = table / total
    return normalised


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
    q: FloatArray = np.einsum("sak,sak->sa", mdp.probability[states], target)
    return q


def _pick(table: FloatArray, actions: IntArray) -> FloatArray:
    """table[s, actions[s]] for every state."""
    return table[np.arange(len(actions)), actions]


def _sweep(mdp: Mdp, gamma: float) -> FloatArray:
    """Value iteration from V = 0, each sweep only where a neighbour's value has just changed.

    Changes are measured relative to the value, so the wave of a far goal is followed to the last cell,
    however small the discounted value has become there. Measured so, a value that fades away to 0 never
    comes to rest; with γ < 1 the waves from all ends have long passed when sweeping stops.
    """
    tolerance = _UNDISCOUNTED_TOLERANCE if gamma == 1 else _SWEEP_TOLERANCE
    v = np.zeros(mdp.num_states)
    playing = ~(mdp.terminal | mdp.wall)
    if gamma == 1 and mdp.step_reward < 0:
        can_end = _can_end(mdp, np.ones(mdp.next_state.shape, dtype=np.bool_))
        v[playing & ~can_end] = -np.inf
        playing &= can_end
    active = np.flatnonzero(playing)
    sweeps = (
        itertools.count()
        if gamma == 1
        else range(100 + 2 * max(_farthest(mdp, ends) for ends in (mdp.goal, mdp.trap)))
    )
    for _ in sweeps:
        if not active.size:
            break
        new = _backup(mdp, v, gamma, active).max(axis=1)
        changed = active[np.abs(new - v[active]) > tolerance * np.abs(new)]
        v[active] = new
        affected = np.zeros(mdp.num_states, dtype=np.bool_)
        affected[changed] = True
        affected[mdp.neighbour[changed]] = True  # moves are symmetric: predecessors are neighbours
        active = np.flatnonzero(affected & playing)
    return v


def _solve(
    mdp: Mdp, policy: FloatArray, gamma: float, precise: bool = False
) -> tuple[FloatArray, FloatArray]:
    """V_π and the same sum over |reward|, both (S,).

    `precise` takes the slower elimination whose error is small beside each state's own scale, not only
    beside the largest one, so that it tells good from better even where values have become tiny.
    """
    transition, reward = _policy_tables(mdp, policy)
    absolute = np.einsum("sa,sak,sak->s", policy, mdp.probability, np.abs(mdp.reward))
    values = np.zeros((mdp.num_states, 2))
    playing = ~(mdp.terminal | mdp.wall)
    if gamma == 1:
        taken = _taken(mdp, policy)
        endless = playing & ~_can_end(mdp, taken)
        playing &= ~endless
        if mdp.step_reward != 0:
            # For ever is infinitely much, and so is a chance of it.
            lost = _can_reach(mdp, taken, endless)
            values[lost] = np.sign(mdp.step_reward) * np.inf, np.inf
            playing &= ~lost
    states = np.flatnonzero(playing)
    right = np.stack([reward, absolute], axis=1)[states]
    if isinstance(transition, np.ndarray):
        matrix = np.eye(len(states)) - gamma * transition[np.ix_(states, states)]
        values[states] = _eliminate(matrix, right) if precise else np.linalg.solve(matrix, right)
    else:
        from scipy.sparse import eye_array
        from scipy.sparse.linalg import splu

        matrix = eye_array(len(states), format="csr") - gamma * transition[states][:, states]
        factors = splu(
            matrix.tocsc(),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )
        values[states] = factors.solve(right)
    return values[:, 0], values[:, 1]


def _eliminate(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Gaussian elimination without pivoting, in place.

    I - γ P_π is an M-matrix: nothing cancels off the diagonal, the diagonal stays at least 1 - γ, and sums
    of non-negative numbers stay exactly that. Pivoting would give this up for nothing.
    """
    size = len(matrix)
    for k in range(size - 1):
        factors = matrix[k + 1 :, k] / matrix[k, k]
        rows = np.flatnonzero(factors)
        matrix[k + 1 + rows, k:] -= factors[rows, None] * matrix[k, k:]
        right[k + 1 + rows] -= factors[rows, None] * right[k]
    for k in range(size - 1, -1, -1):
        right[k] = (right[k] - matrix[k, k + 1 :] @ right[k + 1 :]) / matrix[k, k]
    return right


def _policy_tables(mdp: Mdp, policy: FloatArray) -> tuple[Any, FloatArray]:
    """P_π (S, S), an array or in large worlds a scipy CSR array, and r_π (S,)."""
    size = mdp.num_states
    weight = policy[:, :, None] * mdp.probability
    reward = np.einsum("sak,sak->s", weight, mdp.reward)
    rows = np.broadcast_to(np.arange(size)[:, None, None], weight.shape)
    if size <= _DENSE_STATES:
        index = (rows * size + mdp.next_state).ravel()
        return np.bincount(index, weight.ravel(), size * size).reshape(size, size), reward
    from scipy.sparse import csr_array

    used = weight > 0
    return csr_array((weight[used], (rows[used], mdp.next_state[used])), shape=(size, size)), reward


def _farthest(mdp: Mdp, ends: BoolArray) -> int:
    """Moves to the nearest of these ends from the cell that is farthest from them, past all other ends."""
    reached = mdp.terminal.copy()
    frontier: IntArray = np.flatnonzero(ends)
    moves = 0
    while frontier.size:
        around = np.unique(mdp.neighbour[frontier])
        frontier = around[~reached[around]]
        reached[frontier] = True
        moves += 1
    return moves


def _taken(mdp: Mdp, policy: FloatArray) -> BoolArray:
    """(S, A, K), outcomes that happen with a positive probability."""
    return (policy[:, :, None] * mdp.probability) > 0


def _can_end(mdp: Mdp, taken: BoolArray) -> BoolArray:
    return _can_reach(mdp, taken, mdp.terminal)


def _can_reach(mdp: Mdp, taken: BoolArray, targets: BoolArray) -> BoolArray:
    """(S,), states from which `targets` can be reached over the outcomes in `taken`; the targets are."""
    reaching = targets.copy()
    frontier: IntArray = np.flatnonzero(targets)
    while frontier.size:
        around = np.unique(mdp.neighbour[frontier])
        around = around[~reaching[around]]
        leads = (reaching[mdp.next_state[around]] & taken[around]).any(axis=(1, 2))
        frontier = around[leads]
        reaching[frontier] = True
    return reaching
