"""Sweeps in order of distance: how large worlds are solved, and a first policy is found in small ones.

A level is all states that are equally many steps away from where episodes pay. A sweep takes the levels
from the nearest to the farthest, each with what was just found of the nearer ones (Gauss-Seidel by levels).
A level is swept again only where what it reads has changed. Most sweeps follow the actions that were best
when all were last compared (modified policy iteration); the last one compares all.

Changes are relative to the value: actions in far cells are as exact as in near ones, however small the
discounted value has become there.

References: M. L. Puterman, Markov Decision Processes, 1994, sections 6.3.3 and 6.5; P. Dai and J. Goldsmith,
Topological value iteration algorithm for Markov decision processes, 2007.
"""

from __future__ import annotations

import itertools
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from gridworld.world.mdp import BoolArray, FloatArray, IntArray, Mdp, steps_to

NOTHING = 1e-290  # a value that has faded so far is 0: the smallest numbers of all never get smaller
ACCURATE = 1e-13  # a relative change that adds up to little on the longest ways
SWEPT_STATES = 20_000  # beyond, sweeps are faster than the factors of a sparse matrix
SWEPT_GAMMA = 0.999  # up to here changes that small mean errors that small
_LEAST = 64  # states of a level; smaller ones take as long, and are one with the next
_COMPARED = 8  # of so many sweeps, one compares all actions
_ROUNDING = 1e-15  # relative to the largest value of a level: less than that is no change
MOST_SWEEPS = 2_000


class NotConvergedError(ArithmeticError):
    """Values still change after so many sweeps; with them (S,)."""


class Levels:
    """The n states of a world in which an episode goes on, in the order of their distance."""

    def __init__(self, mdp: Mdp) -> None:
        steps = steps_to(mdp, mdp.probability > 0, _paying_ends(mdp))
        steps[steps < 0] = steps.max() + 1
        live = np.flatnonzero(~mdp.absorbing)
        self._order: IntArray = live[np.argsort(steps[live], kind="stable")]
        self._rank = np.full(mdp.num_states, len(live))  # what is over is one place, behind the last
        self._rank[self._order] = np.arange(len(live))
        self._following = self._rank[mdp.next_state[self._order]]  # (n, A, K)
        self._probability = mdp.probability[self._order]
        self._paid = np.einsum("nak,nak->na", self._probability, mdp.reward[self._order])
        self._edges = [0]
        for cut in [*(np.flatnonzero(np.diff(steps[self._order])) + 1).tolist(), len(live)]:
            if cut - self._edges[-1] >= _LEAST or cut == len(live):
                self._edges.append(cut)
        self._readers = self._who_reads()

    def _who_reads(self) -> list[IntArray]:
        """Of each level, those with an outcome in it."""
        count = len(self._edges) - 1
        level = np.repeat(np.arange(count + 1), [*np.diff(self._edges), 1])
        reads = [np.unique(level[self._following[a:b]]) for a, b in itertools.pairwise(self._edges)]
        reader, read = np.repeat(np.arange(count), [len(each) for each in reads]), np.concatenate(reads)
        order = np.argsort(read, kind="stable")
        return np.split(reader[order], np.searchsorted(read[order], np.arange(1, count + 1)))

    def optimum(self, gamma: float, tolerance: float, most: int) -> FloatArray:
        """V* (S,), by sweeps from 0; see `_swept`."""
        return self._swept(self._following, gamma * self._probability, self._paid, tolerance, most)

    def sums(
        self,
        transition: Any,
        paid: FloatArray,
        gamma: float,
        tolerance: float = ACCURATE,
        near: FloatArray | None = None,
    ) -> FloatArray:
        """x (S,) with x = paid + γ P_π x, of a scipy CSR array P_π (S, S), from `near` (S,); see `_swept`."""
        ordered = transition[self._order]
        counts = np.diff(ordered.indptr)
        place = (
            np.repeat(np.arange(len(counts)), counts),
            np.arange(ordered.nnz) - np.repeat(ordered.indptr[:-1], counts),
        )
        following = np.zeros((len(counts), counts.max()), dtype=np.int64)
        weight = np.zeros(following.shape)
        following[place], weight[place] = self._rank[ordered.indices], gamma * ordered.data
        paid, near = paid[self._order][:, None], None if near is None else near[self._order]
        return self._swept(following[:, None], weight[:, None], paid, tolerance, MOST_SWEEPS, near)

    def _swept(
        self,
        following: IntArray,
        weight: FloatArray,
        paid: FloatArray,
        tolerance: float,
        most: int,
        near: FloatArray | None = None,
    ) -> FloatArray:
        """x (S,) with x(s) = max_a [ paid(s, a) + Σ_k weight(s, a, k) x(following(s, a, k)) ].

        Args:
            following: (n, A, K), where outcomes lead, by this order.
            weight: (n, A, K), their discounted probabilities.
            paid: (n, A).
            tolerance: the relative change of a level that those who read it need not know of.
            most: sweeps of all states, or as many of some.
            near: (n,), where to begin; None: at 0.

        Raises:
            NotConvergedError: values still change by more than that.
        """
        edges, num_levels = self._edges, len(self._edges) - 1
        x = np.zeros(len(paid) + 1)  # behind the last is 0
        if near is not None:
            x[:-1] = near
        rows = np.arange(len(paid))
        # Of the action that was best when all were last compared.
        follows, weighs, pays = following[:, 0].copy(), weight[:, 0].copy(), paid[:, 0].copy()
        known = [_COMPARED] * num_levels  # sweeps since then
        moved = [0.0] * num_levels  # by how much no reader knows
        flags = bytearray(b"\1" * num_levels)
        waiting = np.frombuffer(flags, dtype=np.uint8)
        left = most * len(paid)
        while (level := flags.find(1)) >= 0:
            if left < 0:
                raise NotConvergedError(self._of_states(x))
            while level >= 0:
                flags[level] = 0
                part = slice(edges[level], edges[level + 1])
                if known[level] < _COMPARED or paid.shape[1] == 1:
                    new = pays[part] + np.einsum("nk,nk->n", weighs[part], x.take(follows[part]))
                    known[level] += 1
                else:
                    q = paid[part] + np.einsum("nak,nak->na", weight[part], x.take(following[part]))
                    best = rows[part], q.argmax(axis=1)
                    follows[part], weighs[part], pays[part] = following[best], weight[best], paid[best]
                    new, known[level] = q.max(axis=1), 1
                size = np.abs(new)
                change = np.abs(new - x[part]) / (size + _ROUNDING * size.max(initial=0.0) + NOTHING)
                x[part] = new
                moved[level] += float(change.max(initial=0.0))
                left -= len(new)
                if moved[level] > tolerance:
                    moved[level] = 0.0
                    waiting[self._readers[level]] = 1
                level = flags.find(1, level + 1)
            if paid.shape[1] > 1 and flags.find(1) < 0:
                for each, sweeps in enumerate(known):
                    if sweeps > 1:
                        flags[each], known[each] = 1, _COMPARED
        return self._of_states(x)

    def _of_states(self, x: FloatArray) -> FloatArray:
        found = np.zeros(len(self._rank))
        found[self._order] = x[:-1]
        return found


def are_enough(mdp: Mdp, gamma: float) -> bool:
    """Whether sweeps alone are accurate in a world, and the best way to solve it."""
    return mdp.num_states > SWEPT_STATES and gamma <= SWEPT_GAMMA


def _paying_ends(mdp: Mdp) -> BoolArray:
    """(S,), the ends that pay; all ends if none does; without ends, the states in which the most is paid."""
    possible = mdp.probability > 0
    ends = np.zeros(mdp.num_states, dtype=np.bool_)
    ends[mdp.next_state[possible & (mdp.reward > 0)]] = True
    ends &= mdp.terminal
    if ends.any():
        return ends
    if mdp.terminal.any():
        return mdp.terminal
    paid = np.where(possible, mdp.reward, -np.inf).max(axis=(1, 2))
    return np.asarray(paid == paid.max())


_levels: WeakKeyDictionary[Mdp, Levels] = WeakKeyDictionary()


def of(mdp: Mdp) -> Levels:
    """The levels of a world, found once."""
    if mdp not in _levels:
        _levels[mdp] = Levels(mdp)
    return _levels[mdp]
