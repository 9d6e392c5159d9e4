"""The Markov chain that a policy makes of the world, and what can be known of it exactly.

The value of a policy π solves the linear system V = r_π + γ P_π V; what becomes of an episode follows from
its distribution over states, step by step. A policy is a table (S, A) of action probabilities. Small worlds
are dense matrices, large ones sparse.

Reference: M. L. Puterman, Markov Decision Processes, 1994, chapter 6 and appendix A.
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

_DENSE_STATES = 512  # up to here a dense matrix is both faster and small
_STEPS_AT_ONCE = 32  # of an episode, before looking whether it can still go on


@dataclass(frozen=True)
class Outcome:
    """What one episode of a policy comes to, in expectation over starts, slips and the policy's own draws."""

    goal: float  # probabilities; goal + trap + timeout = 1
    trap: float
    timeout: float
    expected_return: float  # undiscounted sum of rewards
    expected_length: float  # steps


class Chain:
    """States under one policy. Raises `InputError` for a table that is no policy of this world."""

    def __init__(self, mdp: Mdp, policy: ArrayLike) -> None:
        self.mdp = mdp
        self.policy = check_policy(mdp, policy)
        self._weight = self.policy[:, :, None] * mdp.probability  # (S, A, K)
        self.reward: FloatArray = (self._weight * mdp.reward).sum(axis=(1, 2))  # (S,), r_π
        self.transition = self._transition()  # (S, S), an array, or in large worlds a scipy CSR array

    def _transition(self) -> Any:
        size, weight = self.mdp.num_states, self._weight
        rows = np.broadcast_to(np.arange(size)[:, None, None], weight.shape)
        if size <= _DENSE_STATES:
            index = (rows * size + self.mdp.next_state).ravel()
            return np.bincount(index, weight.ravel(), size * size).reshape(size, size)
        from scipy.sparse import csr_array

        used = weight > 0
        return csr_array((weight[used], (rows[used], self.mdp.next_state[used])), shape=(size, size))

    def value(self, gamma: float) -> FloatArray:
        """V_π (S,). With γ = 1, a policy that may go on for ever is worth 0 or ±inf by its step reward."""
        return self._solve(check_gamma(gamma), self.reward[:, None])[:, 0]

    def value_and_scale(self, gamma: float) -> tuple[FloatArray, FloatArray]:
        """V_π and the expected discounted sum of |reward|, both (S,).

        By an elimination whose error is small beside each state's own scale, not only beside the largest
        one, so that it tells good from better even where values have become tiny.
        """
        magnitude = (self._weight * np.abs(self.mdp.reward)).sum(axis=(1, 2))
        both = self._solve(gamma, np.stack([self.reward, magnitude], axis=1), precise=True)
        return both[:, 0], both[:, 1]

    def outcome(self, max_steps: int) -> Outcome:
        """Goal, trap and time-out probability, return and length, exact within `max_steps`."""
        positive_int("max_steps", max_steps)
        live = ~self.mdp.terminal
        told = np.stack([live, self.reward], axis=1)  # summed over an episode: its length and return
        mass: FloatArray = self.mdp.start
        total, steps = np.zeros(2), 0
        while steps < max_steps and mass[live].any():
            visits = self._visits(mass, min(_STEPS_AT_ONCE, max_steps - steps))
            total += visits[:-1].sum(axis=0) @ told
            steps += len(visits) - 1
            mass = visits[-1]
        goal, trap = float(mass[self.mdp.goal].sum()), float(mass[self.mdp.trap].sum())
        return Outcome(goal, trap, float(mass[live].sum()), float(total[1]), float(total[0]))

    def _visits(self, mass: FloatArray, steps: int) -> FloatArray:
        """(steps + 1, S), the distribution over states from `mass` on, step by step."""
        visits = np.empty((steps + 1, len(mass)))
        visits[0] = mass
        if isinstance(self.transition, np.ndarray):
            for before, after in itertools.pairwise(visits):
                before.dot(self.transition, out=after)
        else:
            backwards = self.transition.T
            for before, after in itertools.pairwise(visits):
                after[:] = backwards @ before
        return visits

    def endless_states(self) -> IntArray:
        """States, ascending, that a started episode may come to walk in for ever; empty if it always ends.

        For a deterministic policy in a world without slip these are the cells of its cycle.
        """
        mdp, taken = self.mdp, self._weight > 0
        reached = np.zeros(mdp.num_states, dtype=np.bool_)
        frontier: IntArray = mdp.start_states
        while frontier.size:
            reached[frontier] = True
            following = np.unique(mdp.next_state[frontier][taken[frontier]])
            frontier = following[~reached[following]]
        states: IntArray = np.flatnonzero(reached & ~can_reach(mdp, taken, mdp.terminal))
        while True:  # what lies on the way into a cycle has no predecessor here and drops out
            following = np.unique(mdp.next_state[states][taken[states]])
            if following.size == states.size:
                return states
            states = following

    def _solve(self, gamma: float, right: FloatArray, precise: bool = False) -> FloatArray:
        """x = right + γ P_π x for each column, x = 0 where nothing moves any more."""
        mdp = self.mdp
        solution = np.zeros_like(right)
        playing = ~(mdp.terminal | mdp.wall)
        if gamma == 1:
            taken = self._weight > 0
            endless = playing & ~can_reach(mdp, taken, mdp.terminal)
            playing &= ~endless
            if mdp.step_reward != 0:
                # For ever is infinitely much, and so is a chance of it.
                lost = can_reach(mdp, taken, endless)
                solution[lost] = np.sign(mdp.step_reward) * np.inf
                playing &= ~lost
        states = np.flatnonzero(playing)
        if isinstance(self.transition, np.ndarray):
            matrix = np.eye(len(states)) - gamma * self.transition[np.ix_(states, states)]
            solve = _eliminate if precise else np.linalg.solve
            solution[states] = solve(matrix, right[states])
        else:
            from scipy.sparse import eye_array
            from scipy.sparse.linalg import splu

            matrix = eye_array(len(states), format="csr") - gamma * self.transition[states][:, states]
            factors = splu(
                matrix.tocsc(),
                permc_spec="MMD_AT_PLUS_A",
                diag_pivot_thresh=0.0,
                options={"SymmetricMode": True},
            )
            solution[states] = factors.solve(right[states])
        return solution


def check_gamma(gamma: float) -> float:
    """A discount as a float in [0, 1]; `InputError` otherwise."""
    if isinstance(gamma, bool) or not isinstance(gamma, int | float | np.number) or not 0 <= gamma <= 1:
        raise InputError(f"gamma={gamma!r}: a discount must be a number from 0 to 1")
    return float(gamma)


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


def can_reach(mdp: Mdp, taken: BoolArray, targets: BoolArray) -> BoolArray:
    """(S,), states from which `targets` can be reached over the outcomes in `taken`; the targets are."""
    reaching = targets.copy()
    frontier: IntArray = np.flatnonzero(targets)
    while frontier.size:
        around = np.unique(mdp.predecessors(frontier))
        around = around[~reaching[around]]
        leads = (reaching[mdp.next_state[around]] & taken[around]).any(axis=(1, 2))
        frontier = around[leads]
        reaching[frontier] = True
    return reaching


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
