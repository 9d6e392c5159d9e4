"""Whether an environment reads the clock, by which it might act."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

_NAMES = ("time", "time_ns", "monotonic", "monotonic_ns", "perf_counter", "perf_counter_ns")
_OURS = str(Path(__file__).parents[2])


@contextmanager
def watched() -> Iterator[set[str]]:
    """The places, as file and line, of others' code that call `time.time` and its like in this block.

    A function that somebody imported by its own name, and `datetime`, are not seen.
    """
    before = {name: getattr(time, name) for name in _NAMES}
    found, thread = set[str](), threading.get_ident()

    def watching(read: Callable[[], Any]) -> Callable[[], Any]:
        def called() -> Any:
            frame: FrameType | None = sys._getframe(1)
            assert frame is not None
            place = f"{Path(frame.f_code.co_filename).name}:{frame.f_lineno}"
            is_ours = frame.f_code.co_filename.startswith(_OURS)
            while frame is not None and not frame.f_code.co_filename.startswith("<frozen importlib"):
                frame = frame.f_back
            if threading.get_ident() == thread and not is_ours and frame is None:  # None: not while importing
                found.add(place)
            return read()

        return called

    for name, read in before.items():
        setattr(time, name, watching(read))
    try:
        yield found
    finally:
        for name, read in before.items():
            setattr(time, name, read)
