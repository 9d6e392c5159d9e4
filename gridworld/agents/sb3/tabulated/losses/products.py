"""Products of vectors for runs that train together."""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

_PIECE = 8192  # numbers; BLAS divides longer ones among as many threads as there are cores


def products(these: NDArray[Any], those: NDArray[Any]) -> NDArray[Any]:
    """The product of two vectors for each of P runs, (P,) of (P, n), each as one alone is made."""
    starts = range(0, these.shape[1], _PIECE)
    pieces = ((these[:, None, at : at + _PIECE], those[:, at : at + _PIECE, None]) for at in starts)
    found: NDArray[Any] = sum((left @ right).ravel() for left, right in pieces)
    return found
