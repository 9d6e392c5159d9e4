"""Signal handling while the package is imported, which scripts arrange for first; later, see `signals`."""

from __future__ import annotations

import os
import signal
import sys
from types import FrameType


def listen() -> None:
    """Let Ctrl-C end the process at once, without a traceback, as SIGTERM does."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # a shell's background job ignores it
        signal.signal(signal.SIGINT, signal.SIG_DFL)


class AtWork:
    """A block in which there may be something to clean up: the signals raise instead of ending at once.

    SIGINT raises `KeyboardInterrupt`, SIGTERM `SystemExit`. At the block's end, what was printed is flushed.
    """

    def __enter__(self) -> None:
        self._before = {each: signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)}
        if self._before[signal.SIGINT] is signal.SIG_DFL:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.signal(signal.SIGTERM, _exit)

    def __exit__(self, *error: object) -> None:
        for stream in (sys.stdout, sys.stderr):
            if stream is not None:
                stream.flush()
        for number, handler in self._before.items():
            signal.signal(number, handler)


def _exit(number: int, frame: FrameType | None) -> None:
    os.write(2, b"stopped by SIGTERM\n")
    raise SystemExit(128 + number)
