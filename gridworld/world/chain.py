"""The Markov chain that a policy makes of the world, and what can be known of it exactly.

The value of a policy π, a table (S, A) of action probabilities, solves the linear system V = r_π + γ P_π V;
what becomes of an episode follows from its distribution over states, step by step. Small worlds are dense
matrices, large ones sparse. Without discount (γ = 1) the value is the expected total reward, which may be
infinite where a policy never ends.

Reference: M. L. Puterman, Markov Decision Processes, 1994, chapters 6 and 7 and appendix A.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import as_strided
from numpy.typing import ArrayLike

from gridworld.base.bounds import Discount, positive_int
from gridworld.base.errors import InputError
from gridworld.base.user_input import check_memory
from gridworld.base.workarounds import blas_threads
from gridworld.world import levels
from gridworld.world.mdp import BoolArray, FloatArray, IntArray, Mdp, steps_from, steps_to

ORDINARY_GAMMA = 0.9999  # up to here a plain solution of the linear system is accurate
DENSE_STATES = 512  # up to here a dense matrix is both faster and small
_MOST_FACTORED = 512 * 512  # states; the factors of more fill the memory
_ACCURACY = 1e-11  # of sparse factors
_STEPS_AT_ONCE = 32  # of an episode, before looking whether it can still go on


@contextmanager
def in_one_thread() -> Iterator[None]:
    """OpenBLAS in one thread, however many the machine has; another library is left as it is.

    Systems divided among threads have other last bits with another number of cores, and the threads wait for
    one another at work.
    """
    count, limit = blas_threads()
    before = count()
    limit(1)
    try:
        yield
    finally:
        limit(before)


@dataclass(frozen=True)
class Outcome:
    """What one episode of a policy comes to, in expectation over starts, slips and the policy's own draws."""

    goal: float  # probabilities; goal + trap + timeout = 1
    trap: float
    timeout: float
    expected_return: float  # undiscounted sum of rewards
    expected_length: float  # steps


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Of one policy under one discount."""

    value: FloatArray  # (S,), V_π = E Σ γ^t r_t
    scale: FloatArray  # (S,), E Σ γ^t |r_t|, what a relative error is relative to
    # (S,), dV_π/dγ = E Σ t γ^(t-1) r_t: of equal values, the sooner is smaller
    slope: FloatArray | None = None
    slope_scale: FloatArray | None = None  # (S,), the same of |r_t|


class Chain:
    """States under one policy."""

    def __init__(self, mdp: Mdp, policy: ArrayLike) -> None:
        self.mdp = mdp
        self.policy = check_policy(mdp, policy)  # (S, A), rows sum to 1
        self._weight = self.policy[:, :, None] * mdp.probability  # (S, A, K)
        self.reward: FloatArray = (self._weight * mdp.reward).sum(axis=(1, 2))  # (S,), r_π
        self.transition = self._transition()  # (S, S), P_π, numpy, or in large worlds a scipy CSR array

    def _transition(self) -> Any:
        size, weight = self.mdp.num_states, self._weight
        rows = np.broadcast_to(np.arange(size)[:, None, None], weight.shape)
        if size <= DENSE_STATES:
            index = (rows * size + self.mdp.next_state).ravel()
            return np.bincount(index, weight.ravel(), size * size).reshape(size, size)
        from scipy.sparse import csr_array

        used = weight > 0
        return csr_array((weight[used], (rows[used], self.mdp.next_state[used])), shape=(size, size))

    @in_one_thread()
    def value(self, gamma: float) -> FloatArray:
        """V_π (S,), the expected discounted sum of rewards, without a step limit.

        With γ = 1 it is ±inf where a policy may earn or pay for ever, NaN where it goes on doing both.
        """
        gamma = check_gamma(gamma)
        if gamma > ORDINARY_GAMMA:
            return (self.undiscounted if gamma == 1 else self.evaluation(gamma)).value
        states = np.flatnonzero(~self.mdp.absorbing)
        if not isinstance(self.transition, np.ndarray):
            return self._sums(self.reward[:, None], gamma)[:, 0]
        value = np.zeros(self.mdp.num_states)
        matrix = np.eye(len(states)) - gamma * self.transition[np.ix_(states, states)]
        value[states] = np.linalg.solve(matrix, self.reward[states])
        return value

    @in_one_thread()
    def evaluation(self, gamma: float, with_slope: bool = False) -> Evaluation:
        """The value and what else policy iteration needs, in which tiny values are accurate too.

        Gains and losses are solved for apart, as sums of non-negative numbers: their error is small beside
        each state's own scale.
        """
        signs = (np.maximum(self.mdp.reward, 0), np.maximum(-self.mdp.reward, 0))
        paid = np.stack([(self._weight * part).sum(axis=(1, 2)) for part in signs], axis=1)
        sums = self._sums(paid, gamma)
        if not with_slope:
            return Evaluation(*_value_and_scale(sums))
        finite = np.isfinite(sums)
        slopes = self._sums(self.transition @ np.where(finite, sums, 0.0), gamma)
        return Evaluation(*_value_and_scale(sums), *_value_and_scale(np.where(finite, slopes, np.inf)))

    @cached_property
    def undiscounted(self) -> Evaluation:
        """The evaluation at γ = 1."""
        return self.evaluation(1.0)

    @in_one_thread()
    def outcome(self, max_steps: int) -> Outcome:
        """The exact outcome of an episode of at most `max_steps` steps."""
        positive_int("max_steps", max_steps)
        live = ~self.mdp.terminal
        counted = np.stack([live, self.reward], axis=1)  # summed over an episode: its length and return
        mass: FloatArray = self.mdp.start
        total, steps = np.zeros(2), 0
        while steps < max_steps and mass[live].any():
            visits = self._visits(mass, min(_STEPS_AT_ONCE, max_steps - steps))
            total += visits[:-1].sum(axis=0) @ counted
            steps += len(visits) - 1
            mass = visits[-1]
        # sums of shares, which rounding may take beyond their ranges
        goal, trap, going = (
            min(float(mass[part].sum()), 1.0) for part in (self.mdp.goal, self.mdp.trap, live)
        )
        return Outcome(goal, trap, going, float(total[1]), min(float(total[0]), float(max_steps)))

    @in_one_thread()
    def discounted_return(self, max_steps: int, gamma: float) -> float:
        """The exact discounted sum of rewards of an episode of at most `max_steps` steps."""
        positive_int("max_steps", max_steps)
        total, mass = 0.0, self.mdp.start
        for first in range(0, max_steps, _STEPS_AT_ONCE):
            visits = self._visits(mass, min(_STEPS_AT_ONCE, max_steps - first))
            discounts = gamma ** np.arange(first, first + len(visits) - 1)
            total += float(discounts @ (visits[:-1] @ self.reward))
            mass = visits[-1]
        return total

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

    @in_one_thread()
    def total(self, counted: FloatArray, gamma: float) -> FloatArray:
        """(S,), the expected discounted sum of numbers (S,) of at least 0, one for each state on the way."""
        return self._sums(counted[:, None], gamma)[:, 0]

    def endless_states(self) -> IntArray:
        """(n,), ascending, where an episode may go on for ever: of a deterministic policy its cycle."""
        mdp = self.mdp
        reached = steps_from(mdp.start_states, mdp.next_state, self._taken) >= 0
        states: IntArray = np.flatnonzero(reached & (steps_to(mdp, self._taken, mdp.terminal) < 0))
        while True:  # what lies on the way into a cycle has no predecessor here and drops out
            following = np.unique(mdp.next_state[states][self._taken[states]])
            if following.size == states.size:
                return states
            states = following

    def _sums(self, right: FloatArray, gamma: float) -> FloatArray:
        """x = right + γ P_π x for each column, x = 0 where nothing moves any more.

        With γ = 1 the columns must not be negative; x is infinite where it does not stop growing.
        """
        sums = np.zeros_like(right)
        playing = ~self.mdp.absorbing
        if gamma == 1:
            for column, collected in zip(sums.T, right.T, strict=True):
                paying = np.unique(self._recurrent[(self._recurrent > 0) & (collected > 0)])
                if paying.size:
                    column[steps_to(self.mdp, self._taken, np.isin(self._recurrent, paying)) >= 0] = np.inf
            playing = playing & ~(self._recurrent > 0) & np.isfinite(sums).all(axis=1)
        if levels.are_enough(self.mdp, gamma):
            with suppress(levels.NotConvergedError):
                for column, counted in zip(sums.T, right.T, strict=True):
                    column[:] = levels.of(self.mdp).sums(self.transition, counted, gamma)
                return sums
        states = np.flatnonzero(playing)
        if states.size:
            if states.size > _MOST_FACTORED:
                raise InputError(
                    f"{self.mdp.name}: {states.size:,} states are too many for gamma={gamma:g}; more than "
                    f"{_MOST_FACTORED:,} need at most {levels.SWEPT_GAMMA:g}, and values that sweeps find"
                )
            leaving = self.transition[states][:, np.flatnonzero(~playing)].sum(axis=1)
            leak = (1 - gamma) + gamma * leaving
            sums[states] = factor(gamma * self.transition[states][:, states], leak)(right[states])
        return sums

    @cached_property
    def _taken(self) -> BoolArray:
        """(S, A, K), the outcomes that the policy may have."""
        return np.asarray(self._weight > 0)

    @cached_property
    def _recurrent(self) -> IntArray:
        """(S,), a number from 1 on for each class of states that it never leaves, 0 for all other states."""
        recurrent = np.zeros(self.mdp.num_states, dtype=np.int64)
        ends = steps_to(self.mdp, self._taken, self.mdp.terminal) >= 0
        endless = np.flatnonzero(~self.mdp.absorbing & ~ends)
        if endless.size:
            from scipy.sparse import coo_array
            from scipy.sparse.csgraph import connected_components

            among = coo_array(self.transition[endless][:, endless])
            _, label = connected_components(among, directed=True, connection="strong")
            leaving = label[among.row][label[among.row] != label[among.col]]
            to_rest = self.transition[endless][:, np.flatnonzero(self.mdp.absorbing)].sum(axis=1) > 0
            leaving = np.concatenate([leaving, label[to_rest]])
            recurrent[endless] = np.where(np.isin(label, leaving), 0, label + 1)
        return recurrent


def stopping_states(chain: Chain, gamma: float) -> BoolArray:
    """(S,), where nothing is counted any more; with γ = 1, where an episode cannot end any more."""
    mdp = chain.mdp
    if gamma < 1:
        return mdp.absorbing
    taken = (chain.policy[:, :, None] > 0) & (mdp.probability > 0)
    return mdp.absorbing | (steps_to(mdp, taken, mdp.terminal) < 0)


@in_one_thread()
def discounted_visits(chain: Chain, gamma: float, stops: BoolArray) -> FloatArray:
    """Discounted visits (S,) from the start distribution on: d(s) = Σ_t γ^t P(s_t = s).

    No one leaves a state of `stops` (S,); there it is the discounted probability to come there.
    """
    start, going = chain.mdp.start, np.flatnonzero(~stops)
    ahead = gamma * chain.transition[going]
    visits = start.copy()
    if isinstance(ahead, np.ndarray):
        visits[going] = np.linalg.solve(np.eye(len(going)) - ahead[:, going].T, start[going])
    else:
        from scipy.sparse import eye_array
        from scipy.sparse.linalg import spsolve

        visits[going] = spsolve((eye_array(len(going)) - ahead[:, going].T).tocsc(), start[going])
    visits[stops] += (ahead.T @ visits[going])[stops]
    visits[visits < 0] = 0.0  # rounding
    return visits


def check_gamma(gamma: float) -> float:
    """A discount as a float, from 0 to 1 and not so near to 1 that the cost of a step is lost in rounding."""
    Discount().check("gamma", gamma)
    return float(gamma)


def one_hot_policy(actions: IntArray, num_actions: int) -> FloatArray:
    """The policy (S, A), float64, that takes one action (S,) in every state."""
    policy = np.zeros((len(actions), num_actions))
    policy[np.arange(len(actions)), actions] = 1.0
    return policy


def check_policy(mdp: Mdp, policy: ArrayLike) -> FloatArray:
    """A policy (S, A) of this world as float64 whose rows sum to 1; refuses anything else."""
    try:
        table: FloatArray = np.asarray(policy, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"policy={policy!r}: must be a table of action probabilities") from None
    if table.shape != (mdp.num_states, mdp.num_actions):
        raise InputError(
            f"policy of shape {table.shape}: this world needs ({mdp.num_states}, {mdp.num_actions}), action "
            "probabilities per state"
        )
    total = table.sum(axis=1, keepdims=True)
    wrong = ~((table >= 0).all(axis=1) & (np.abs(total[:, 0] - 1) <= 1e-4))
    if wrong.any():
        state = int(np.argmax(wrong))
        raise InputError(f"policy: row {state} is {table[state].tolist()}, not a probability distribution")
    normalised: FloatArray = table / total
    return normalised


def _value_and_scale(sums: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Gains - losses and gains + losses."""
    with np.errstate(invalid="ignore"):  # inf - inf is no value
        return sums[:, 0] - sums[:, 1], sums.sum(axis=1)


class Elimination:
    """Elimination without subtractions. Right-hand sides must not be negative."""

    def __init__(self, weights: FloatArray, leak: FloatArray, band: int) -> None:
        """Overwrites weights (n, n), of which only |i - j| <= band is read, and leak (n,)."""
        size = len(weights)
        self._table = weights  # above the diagonal each pivot row's shares, below it what was eliminated
        self._pivots = np.empty(size)
        self._columns = [slice(k + 1, min(k + 1 + band, size)) for k in range(size)]
        self._below = []  # rows that had to be eliminated
        for k, columns in enumerate(self._columns):
            row = weights[k, columns]
            self._pivots[k] = leak[k] + row.sum()
            row /= self._pivots[k]
            leak[k] /= self._pivots[k]
            below = k + 1 + np.flatnonzero(weights[columns, k])
            factors = weights[below, k]
            weights[below, columns] += factors[:, None] * row
            leak[below] += factors * leak[k]
            self._below.append(below)

    def solve(self, right: FloatArray) -> FloatArray:
        x = right.copy()
        for k, below in enumerate(self._below):
            x[k] /= self._pivots[k]
            x[below] += self._table[below, k][:, None] * x[k]
        for k in range(len(x) - 1, -1, -1):
            x[k] += self._table[k, self._columns[k]] @ x[self._columns[k]]
        return x


def _banded(weights: Any, leak: FloatArray) -> Callable[[FloatArray], FloatArray]:
    """The same of a scipy CSR array (n, n): its states are renumbered so that a narrow band holds it."""
    from scipy.sparse.csgraph import reverse_cuthill_mckee

    order = reverse_cuthill_mckee(weights)
    ordered = weights[order][:, order].tocoo()
    size, band = len(leak), int(np.abs(ordered.row - ordered.col).max(initial=0))
    check_memory(f"the exact solution of a world of {size:,} states", 8 * size * (2 * band + 1))
    stored = np.zeros((size, 2 * band + 1))
    stored[ordered.row, ordered.col - ordered.row + band] = ordered.data
    down, right = stored.strides
    table = as_strided(stored[0, band:], (size, size), (down - right, right))  # valid within the band
    elimination, back = Elimination(table, leak[order], band), np.argsort(order)
    return lambda sums: elimination.solve(sums[order])[back]


def factor(weights: Any, leak: FloatArray) -> Callable[[FloatArray], FloatArray]:
    """Solve for right-hand sides (n, columns); overwrites `weights` (n, n), numpy or CSR, and `leak` (n,)."""
    if isinstance(weights, np.ndarray):
        return Elimination(weights, leak, band=len(leak)).solve
    from scipy.sparse import diags_array
    from scipy.sparse.linalg import splu

    weights.setdiag(0.0)
    weights.eliminate_zeros()
    matrix = diags_array(leak + weights.sum(axis=1), format="csr") - weights
    try:
        symmetric = {"SymmetricMode": True}
        factors = splu(matrix.tocsc(), "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=symmetric)
        if np.abs(factors.solve(leak) - 1).max() <= _ACCURACY:
            solve: Callable[[FloatArray], FloatArray] = factors.solve
            return solve
    except RuntimeError:  # rounding has made it singular
        pass
    return _banded(weights, leak)
