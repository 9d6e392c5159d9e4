"""Exact evaluation in one thread of numpy's linear algebra, however many the machine has.

OpenBLAS divides products and systems of a hundred states or more among threads. That changes their last bits,
so that a run's numbers would depend on the number of cores and on the launcher. And its threads wait for one
another at work: where other processes need the cores, for ten times the processor time.
"""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import numpy as np

P = ParamSpec("P")
T = TypeVar("T")


def in_one_thread(function: Callable[P, T]) -> Callable[P, T]:
    """Let a function call OpenBLAS in one thread; another library is left as it is."""

    @functools.wraps(function)
    def called(*arguments: P.args, **named: P.kwargs) -> T:
        count, limit = _openblas()
        before = count()
        if before == 1:
            return function(*arguments, **named)
        limit(1)
        try:
            return function(*arguments, **named)
        finally:
            limit(before)

    return called


@functools.cache
def _openblas() -> tuple[Callable[[], int], Callable[[int], Any]]:
    """OpenBLAS's functions that tell and set the number of its threads."""
    library: Any = ctypes.CDLL(np.linalg._umath_linalg.__file__)
    for prefix in ("scipy_openblas", "openblas"):
        for suffix in ("64_", "_64", ""):
            tell, limit = (f"{prefix}_{verb}_num_threads{suffix}" for verb in ("get", "set"))
            if hasattr(library, tell) and hasattr(library, limit):
                return getattr(library, tell), getattr(library, limit)
    return (lambda: 1), (lambda threads: None)
