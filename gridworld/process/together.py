"""What each of several runs that train together has for itself: a clock, and what its numbers depend on."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Mapping
from contextvars import ContextVar
from types import MappingProxyType


class Clock:
    """Counts the seconds that were spent on one run, with `shared`, its share of those spent on all."""

    def __init__(self, shared: Callable[[], float]) -> None:
        self._shared = shared
        self._seconds = 0.0
        self._resumed: float | None = None

    @contextlib.contextmanager
    def running(self) -> Iterator[None]:
        """Count the block as this run's own."""
        self._resumed = time.perf_counter()
        try:
            yield
        finally:
            self._seconds += time.perf_counter() - self._resumed
            self._resumed = None

    def now(self) -> float:
        """Seconds so far."""
        own = 0.0 if self._resumed is None else time.perf_counter() - self._resumed
        return self._seconds + own + self._shared()


_now: ContextVar[Callable[[], float]] = ContextVar("now", default=time.perf_counter)
_mixed: ContextVar[Mapping[str, str]] = ContextVar("mixed", default=MappingProxyType({}))


def clock() -> float:
    """Seconds since some moment; of a run among others, only those that were spent on it."""
    return _now.get()()


def set_clock(own: Clock) -> None:
    """Let `clock` be this one in the present context."""
    _now.set(own.now)


@contextlib.contextmanager
def mixing(runs: Mapping[str, str]) -> Iterator[None]:
    """Let runs in the block form populations even where their numbers then depend on each other.

    Args:
        runs: a hash of the settings of each by its folder's name, in their order; none: where their numbers
            are those of each alone.
    """
    token = _mixed.set(runs)
    try:
        yield
    finally:
        _mixed.reset(token)


def mixed() -> Mapping[str, str]:
    """The runs of `mixing`, this one among them; none outside of such a block."""
    return _mixed.get()
