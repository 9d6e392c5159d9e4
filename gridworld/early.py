"""Being asked to stop while a program still imports what it needs, and after its last word.

Every script listens before it imports anything that takes time. Once training runs, `gridworld.signals` takes
the signals, and puts these handlers back afterwards.
"""

from __future__ import annotations

import atexit
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

_at_work = False


def listen() -> None:
    """End with a line and 130 or 143 from here on, without a traceback."""
    for number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(number) is not signal.SIG_IGN:  # as it is of a job in the background
            signal.signal(number, _asked)
    atexit.register(_ignore)


@contextmanager
def at_work() -> Iterator[None]:
    """For the block there may be something to put right: the signals raise, where before they end at once."""
    global _at_work
    _at_work = True
    try:
        yield
    finally:
        _at_work = False
        for stream in (sys.stdout, sys.stderr):
            if stream is not None:
                stream.flush()


def _ignore() -> None:
    """Python takes its handlers away before it is gone; what is left is ignored then, the exit code stays."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)


def _asked(number: int, frame: FrameType | None) -> None:
    if _at_work and number == signal.SIGINT:
        raise KeyboardInterrupt
    os.write(2, f"stopped by {signal.Signals(number).name}\n".encode())
    if _at_work:
        raise SystemExit(128 + number)
    os._exit(128 + number)
