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

from decimal import ROUND_CEILING, Context

import numpy as np

from gridworld.world.chain import Chain, one_hot_policy
from gridworld.world.mdp import FloatArray, IntArray, Mdp, steps_from
from gridworld.world.solver import Solution

_UNIT = 2.0**-53  # of rounding, relative to a number
_LEAST = 2.0**-1074  # the smallest number, which is more than an underflow loses
_TRIES = 60  # of a shift
_ROUNDS = 20  # of policy iteration


class Bounds:
    """Proven bounds of what the policies of a world are worth.

    Args:
        mdp: the world.
        optimum: its solution, but for rounding, under a discount below 1.
        enough: half of a regret that need not be told from 0.

    Attributes:
        upper: (S,), the upper bound, see `bound`.
    """

    def __init__(self, mdp: Mdp, optimum: Solution, enough: float) -> None:
        self._mdp, self._gamma, self._enough = mdp, optimum.gamma, enough
        self._live, self._starts = ~mdp.terminal, mdp.start_states
        self._share = mdp.start[self._starts] / mdp.start[self._starts].sum()
        self._states: IntArray = np.flatnonzero(mdp.reachable & self._live)
        following, paid, chance = (
            table[self._states] for table in (mdp.next_state, mdp.reward, mdp.probability)
        )
        self._weight = chance / chance.sum(axis=2, keepdims=True)
        self._paid = np.where(chance > 0, paid, 0.0)
        self._following = np.where(chance > 0, following, self._states[:, None, None])
        self.upper = self.bound(optimum.v, None)
        best = one_hot_policy(optimum.optimal.argmax(axis=1), mdp.num_actions)
        lower = self.bound(optimum.v, best)
        self._least_regret = self.at_start(self.upper - lower)
        self._kept = self._starts, np.zeros(0)  # where a policy that keeps to these bounds goes, and how
        # (S, A), where an action is not known to keep to these bounds
        self._others = np.full_like(optimum.optimal, self._least_regret > 2 * enough)
        with np.errstate(all="ignore"):
            self._others[self._states] |= ~(self._rest(lower, -1.0) <= 0)

    def regret(self, policy: FloatArray, values: FloatArray) -> float:
        """The regret from the start that a policy (S, A) of these values V_π (S,) has at most."""
        where, how = self._kept
        if np.array_equal(policy[where], how):
            return self._least_regret
        others = (policy > 0) & self._others
        if others.any():  # then it matters where the policy goes
            taken = (policy > 0)[:, :, None] & (self._mdp.probability > 0)
            reached = steps_from(self._starts, self._mdp.next_state, taken) >= 0
            if others[reached].any():
                return self.at_start(self.upper - self.bound(values, policy))
            where = np.flatnonzero(reached & self._live)
            self._kept = where, policy[where]
        return self._least_regret

    def at_start(self, gap: FloatArray) -> float:
        """Not less than the mean of a gap (S,) between two bounds, each of which was rounded once."""
        here, size = gap[self._starts], len(self._starts)
        return float(here @ self._share) * (1 + (2 * size + 8) * _UNIT) + size * _LEAST * bool(here.any())

    def bound(self, given: FloatArray, policy: FloatArray | None) -> FloatArray:
        """x (S,) near to `given` with x ≥ max_a T_a x, or of a policy (S, A) with x ≤ T_π x; else ±infinite.

        So it is at least V*, or at most V_π in the states that the policy reaches, which `given` is but for
        rounding.
        """
        sign = 1.0 if policy is None else -1.0
        given = np.where(self._live, given, 0.0)
        with np.errstate(all="ignore"):  # what is too large or too small has no bound
            shift = 2 * _UNIT * np.abs(given[self._states]).max(initial=0.0) / (1 - self._gamma)
            for _ in range(_TRIES):
                found = self._moved(given, sign * shift)
                most = self._excess(found, sign, policy)[0].max(initial=0.0)
                if most <= 0:
                    break
                shift = 1.1 * shift + 1.5 * most / (1 - self._gamma)
            else:
                return np.where(self._live, sign * np.inf, 0.0)
            return found if shift <= self._enough else self._nearer(given, found, sign, policy)

    def _moved(self, given: FloatArray, shift: FloatArray | float) -> FloatArray:
        moved = np.nextafter(given + shift, shift * np.inf)
        return np.where(self._live & (shift != 0), moved, given)

    def _nearer(
        self, given: FloatArray, found: FloatArray, sign: float, policy: FloatArray | None
    ) -> FloatArray:
        """The same, by each state's own rounding and what follows, where that of all states is too much.

        What adds up is largest by some rows, which policy iteration finds.
        """
        excess, chosen = self._excess(given, sign, policy)
        lacking = 2 * np.maximum(excess, 0.0)
        actions: IntArray = np.zeros(len(given), dtype=np.int64)
        actions[self._states] = chosen
        for times in (4, 16, 64):
            own = times * _UNIT * np.abs(given)
            own[self._states] += lacking
            before = np.inf
            for _ in range(_ROUNDS):
                follow = one_hot_policy(actions, self._mdp.num_actions) if policy is None else policy
                nearer = self._moved(given, sign * Chain(self._mdp, follow).total(own, self._gamma))
                excess, chosen = self._excess(nearer, sign, policy)
                if (most := excess.max()) <= 0:
                    return nearer
                if most >= before:  # what is left is rounding
                    break
                before = most
                actions[self._states] = np.where(excess > 0, chosen, actions[self._states])
        return found

    def _excess(self, x: FloatArray, sign: float, policy: FloatArray | None) -> tuple[FloatArray, IntArray]:
        """(n,), not less than the largest d, of actions (n,), or - d of a policy (S, A) on average."""
        rest = self._rest(x, sign)
        chosen = rest.argmax(axis=1)
        if policy is None:
            return rest[np.arange(len(rest)), chosen], chosen
        chance = policy[self._states]
        parts, count = chance * rest, rest.shape[1]
        lost = count * _LEAST * ((rest != 0) & (chance > 0) & (chance < 1)).any(axis=1)
        return parts.sum(axis=1) + 2 * count * _UNIT * np.abs(parts).sum(axis=1) + lost, chosen

    def _rest(self, x: FloatArray, sign: float) -> FloatArray:
        """Not less than ± d (n, A) of numbers x (S,) in the live states."""
        here, there = x[self._states][:, None, None], x[self._following]
        moved, faded = self._gamma * (there - here), (1 - self._gamma) * here
        total = (self._weight * (self._paid + moved - faded)).sum(axis=2)
        size = (self._weight * (np.abs(self._paid) + np.abs(moved) + np.abs(faded))).sum(axis=2)
        spread = np.abs(self._paid) + np.abs(here) + np.abs(there)  # where all are 0, nothing is lost
        lost, count = (spread + (spread > 0)).sum(axis=2), self._weight.shape[2]
        error = 1.01 * (2 * count + 8) * _UNIT * size + 8 * (count + 1) * _LEAST * lost
        return np.asarray(sign * total + error)


def at_most(number: float) -> str:
    """A bound with two digits, rounded up."""
    return f"{Context(2, ROUND_CEILING).create_decimal(number):.2g}"
