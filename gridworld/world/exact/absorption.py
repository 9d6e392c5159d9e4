"""Expected sums until absorption: x = right + γ P x, accurate also where the end is nearly never reached.

P holds the transition probabilities between the states that are still in play; what is missing from a row,
with γ < 1 also the discount, leaves the system. With w_ij = γ p_ij (i ≠ j) and the leak

    l_i = (1 - γ) + γ Σ_(j not in play) p_ij

the system is (l_i + Σ_j w_ij) x_i - Σ_j w_ij x_j = right_i. The diagonal is a sum of non-negative numbers: it
is never computed as 1 - γ p_ii, where everything that matters may cancel. Eliminated like that, without a
subtraction anywhere, every x_i has a small error relative to itself, however small the leaks are
(W. Grassmann, M. Taksar and D. Heyman, Regenerative analysis and steady state distributions for Markov
chains, Operations Research 33, 1985; C. O'Cinneide, Numerische Mathematik 65, 1993). This needs right >= 0.

Large systems are factored sparsely by SuperLU, if that is accurate: with the leaks for a right-hand side, x
is the probability of ever leaving, which is 1. Else it is eliminated in a band around the diagonal.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import as_strided

from gridworld.process.memory_budget import check_memory
from gridworld.world.mdp import FloatArray

_ACCURACY = 1e-11


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


class BandedElimination:
    """The same for a sparse system: its states are renumbered so that a narrow band holds all weights."""

    def __init__(self, weights: Any, leak: FloatArray) -> None:
        """Factor weights (n, n), a scipy CSR array without a diagonal, and leak (n,)."""
        from scipy.sparse.csgraph import reverse_cuthill_mckee

        self._order = reverse_cuthill_mckee(weights)
        ordered = weights[self._order][:, self._order].tocoo()
        size, band = len(leak), int(np.abs(ordered.row - ordered.col).max(initial=0))
        check_memory(f"the exact solution of a world of {size:,} states", 8 * size * (2 * band + 1))
        stored = np.zeros((size, 2 * band + 1))
        stored[ordered.row, ordered.col - ordered.row + band] = ordered.data
        down, right = stored.strides
        table = as_strided(stored[0, band:], (size, size), (down - right, right))  # valid within the band
        self._elimination = Elimination(table, leak[self._order], band)

    def solve(self, right: FloatArray) -> FloatArray:
        x = np.empty_like(right)
        x[self._order] = self._elimination.solve(right[self._order])
        return x


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
        factors = splu(
            matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )
        is_accurate = np.abs(factors.solve(leak) - 1).max() <= _ACCURACY
    except RuntimeError:  # rounding has made it singular
        is_accurate = False
    solve: Callable[[FloatArray], FloatArray] = (
        factors.solve if is_accurate else BandedElimination(weights, leak).solve
    )
    return solve
