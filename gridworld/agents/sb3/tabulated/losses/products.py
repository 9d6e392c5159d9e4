"""Products of vectors for runs that train together."""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray


def products(these: NDArray[Any], those: NDArray[Any]) -> NDArray[Any]:
    """The product of two vectors for each of P runs, (P,) of (P, n), each as one alone is made."""
    found: NDArray[Any] = (these[:, None] @ those[:, :, None]).ravel()
    return found
