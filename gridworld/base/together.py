"""What each of several runs that train together has for itself: a clock, and what its numbers depend on."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator, Mapping
from contextvars import ContextVar
from types import MappingProxyType

LARGEST = 32  # runs of a population unless more are asked for; larger ones train no faster


_runs: ContextVar[int] = ContextVar("runs", default=1)
_mixed: ContextVar[Mapping[str, str]] = ContextVar("mixed", default=MappingProxyType({}))


def clock() -> float:
    """Seconds since some moment; of runs that train together, each counts its share of them."""
    return time.perf_counter() / _runs.get()


def share_clock(runs: int) -> None:
    """Let `clock` in the present context count for one of so many runs."""
    _runs.set(runs)


@contextlib.contextmanager
def mixing(runs: Mapping[str, str]) -> Iterator[None]:
    """Let runs in the block form populations even where their numbers then depend on each other.

    `runs` has a hash of the settings of each by its folder's name, in their order; none: let them not.
    """
    token = _mixed.set(runs)
    try:
        yield
    finally:
        _mixed.reset(token)


def mixed() -> Mapping[str, str]:
    """The runs of `mixing`, this one among them; none outside of such a block."""
    return _mixed.get()
