"""Bounds that prove how good a policy is: numbers above every policy's value, and numbers below one's.

In the states that any actions reach let u ≥ max_a T_a u, where (T_a x)(s) = Σ_k p_k [ r_k + γ x(next_k) ],
and in those that a policy π reaches let l ≤ T_π l, with 0 where an episode has ended. For γ < 1 then u ≥ V*
and l ≤ V_π, so that the regret of π from the start is at most Σ_s start(s) (u(s) - l(s)). Probabilities count
as their shares of their sum, so that only the sign of

    d(s, a) = Σ_k p_k [ r_k + γ (x(next_k) - x(s)) - (1 - γ) x(s) ]

matters, which floats decide: a computed sum of n such terms is off by at most 2 n + 8 half units of their
sizes and by what the smallest numbers lose. So nothing here depends on how V* and V_π were found.

References: M. L. Puterman, Markov Decision Processes, 1994, theorem 6.2.2; N. J. Higham, Accuracy and
Stability of Numerical Algorithms, 2002, sections 2.1 and 3.1.
"""

from __future__ import annotations

from collections.abc import Callable
from decimal import ROUND_CEILING, Context
from typing import Any

import numpy as np

from gridworld.world.chain import Chain, one_hot_policy
from gridworld.world.mdp import FloatArray, IntArray, Mdp

_UNIT = 2.0**-53  # of rounding, relative to a number
_LEAST = 2.0**-1074  # the smallest number, which is more than an underflow loses
_TRIES, _STEP = 60, 1.5  # of a shift, each so many times as large
_BETWEEN = 10  # smaller ones are tried, where little is much
_ROUNDS = 20  # of policy iteration


class Bounds:
    """Proven bounds of what the policies of a world are worth.

    Args:
        mdp: the world.
        gamma: the discount, below 1.
        values: V* (S,), but for rounding.
        enough: half of a regret that need not be told from 0.

    Attributes:
        upper: (S,), at least V* in the states that any actions reach, or infinite; 0 where it is over.
    """

    def __init__(self, mdp: Mdp, gamma: float, values: FloatArray, enough: float) -> None:
        self._gamma, self._enough = gamma, enough
        self._live, self._starts = ~mdp.terminal, mdp.start_states
        self._share = mdp.start[self._starts] / mdp.start[self._starts].sum()
        self._states: IntArray = np.flatnonzero(mdp.reachable & self._live)
        following, paid, chance = (
            table[self._states] for table in (mdp.next_state, mdp.reward, mdp.probability)
        )
        self._weight = chance / chance.sum(axis=2, keepdims=True)
        self._following, self._lost = following, -paid
        self.upper = self._above(
            values,
            lambda actions: Chain(mdp, one_hot_policy(actions, mdp.num_actions)),
            *(following, paid, self._weight),
        )

    def lower(self, chain: Chain, values: FloatArray) -> FloatArray:
        """Numbers (S,) that are at most V_π in the states that a policy reaches, or -infinite.

        Args:
            chain: of the policy.
            values: V_π (S,), but for rounding.
        """
        policy, size = chain.policy[self._states], len(self._states)
        taken = np.arange(size), policy.argmax(axis=1)
        if (policy[taken] == 1).all():
            rows = [each[taken][:, None] for each in (self._following, self._lost, self._weight)]
        else:
            weight = policy[:, :, None] * self._weight
            rows = [each.reshape(size, 1, -1) for each in (self._following, self._lost, weight)]
        return -self._above(-values, lambda actions: chain, *rows)

    def regret(self, lower: FloatArray) -> float:
        """The regret from the start distribution that a policy with this lower bound (S,) has at most."""
        return self._at_start(self.upper - lower)

    def _at_start(self, gap: FloatArray) -> float:
        """Not less than the mean of a gap (S,) between two bounds, each of which was rounded once."""
        here, size = gap[self._starts], len(self._starts)
        return float(here @ self._share) * (1 + (2 * size + 8) * _UNIT) + size * _LEAST * bool(here.any())

    def _above(self, given: FloatArray, chain_of: Callable[[IntArray], Chain], *rows: Any) -> FloatArray:
        """x (S,) with x ≥ max_b T_b x, near to its fixed point `given`; see `_rest` for the rows.

        `chain_of` makes the chain that follows one row (S,) in each state.
        """
        given = np.where(self._live, given, 0.0)
        with np.errstate(all="ignore"):  # what is too large or too small has no bound
            large, paid = (np.abs(each).max(initial=0.0) for each in (given[self._states], rows[1]))
            before = 0.0
            for number in range(_TRIES):
                shift = _STEP**number * 2 * _UNIT * (large + paid * (number > 0)) / (1 - self._gamma)
                found = self._shifted(given, shift)
                if (self._rest(found, *rows) <= 0).all():
                    break
                before = shift
            else:
                return np.where(self._live, np.inf, 0.0)
            if self._at_start(found - given) <= self._enough:
                return found
            between = (self._shifted(given, each) for each in np.linspace(before, shift, _BETWEEN))
            found = next((each for each in between if (self._rest(each, *rows) <= 0).all()), found)
            return self._nearer(given, found, chain_of, *rows)

    def _shifted(self, given: FloatArray, shift: float) -> FloatArray:
        return np.where(self._live, np.nextafter(given + shift, np.inf), 0.0) if shift else given

    def _nearer(
        self, given: FloatArray, found: FloatArray, chain_of: Callable[[IntArray], Chain], *rows: Any
    ) -> FloatArray:
        """The same, by each state's own rounding and what follows, where that of all states is too much.

        What adds up is largest by some rows, which policy iteration finds.
        """
        rest = self._rest(given, *rows)
        chosen: IntArray = np.zeros(len(given), dtype=np.int64)
        chosen[self._states] = rest.argmax(axis=1)
        for times in (4, 16, 64):
            own = times * _UNIT * np.abs(given)
            own[self._states] += 2 * np.maximum(rest.max(axis=1), 0.0)
            for _ in range(_ROUNDS):
                nearer = given + chain_of(chosen).total(own, self._gamma)
                nearer = np.where(self._live & (nearer != given), np.nextafter(nearer, np.inf), nearer)
                off = self._rest(nearer, *rows)
                if (off <= 0).all():
                    return nearer
                chosen[self._states] = np.where(off.max(axis=1) > 0, off.argmax(axis=1), chosen[self._states])
        return found

    def _rest(self, x: FloatArray, following: IntArray, paid: FloatArray, weight: FloatArray) -> FloatArray:
        """Not less than d (n, B) of numbers x (S,), for rows of outcomes (n, B, K) in the live states."""
        here = x[self._states][:, None, None]
        moved, faded = self._gamma * (x[following] - here), (1 - self._gamma) * here
        total = (weight * (paid + moved - faded)).sum(axis=2)
        size = (weight * (np.abs(paid) + np.abs(moved) + np.abs(faded))).sum(axis=2)
        count = weight.shape[2]
        is_more = (weight > 0) & ((paid != 0) | (here != 0) | (x[following] != 0))  # else nothing is lost
        lost = 8 * (count + 1) * _LEAST * is_more.any(axis=2)
        rest: FloatArray = total + size * (1.01 * (2 * count + 8) * _UNIT) + lost
        return rest


def at_most(number: float) -> str:
    """A bound with two digits, rounded up."""
    return f"{Context(2, ROUND_CEILING).create_decimal(number):.2g}"
