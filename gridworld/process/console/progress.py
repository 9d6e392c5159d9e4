"""Progress on standard error: how far something is, and how long the rest may take.

On a terminal a line is rewritten in place; elsewhere a new one is printed now and then.
"""

from __future__ import annotations

import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

from gridworld.process.console.terminal import printable
from gridworld.process.memory_budget import is_limited

_SECONDS_BETWEEN_LINES = 5.0
_CLEAR_TO_END = "\x1b[K"

_is_telling: ContextVar[bool] = ContextVar("is_telling", default=False)


class ProgressLine:
    """A line that may be offered at any time, and is printed when it is due; never if not `enabled`."""

    def __init__(self, enabled: bool, seconds_between_lines: float = 10.0) -> None:
        self._enabled = enabled
        self._seconds_between_lines = seconds_between_lines
        self._terminal = sys.stderr.isatty()
        self._printed = time.monotonic()
        self._shown = ""

    def show(self, text: Callable[[], str]) -> None:
        """Print the line that `text` returns; it is called only if a line is due."""
        if self._enabled and self._terminal:
            line = text()
            if line != self._shown:
                self._shown = line
                print(f"\r{line}{_CLEAR_TO_END}", end="", file=sys.stderr, flush=True)
        elif self._enabled and time.monotonic() - self._printed >= self._seconds_between_lines:
            self._printed = time.monotonic()
            print(text(), file=sys.stderr, flush=True)

    def clear(self) -> None:
        """Remove the line from a terminal."""
        if self._shown:
            print(f"\r{_CLEAR_TO_END}", end="", file=sys.stderr, flush=True)


class Progress:
    """Progress of a run in environment steps: a bar on a terminal or in a notebook, lines elsewhere."""

    def __init__(self, total: int, label: str, enabled: bool = True) -> None:
        self._total = total
        self._label = printable(label)
        self._line = ProgressLine(enabled, _SECONDS_BETWEEN_LINES)
        self._bar: Any = None
        shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
        is_notebook = "IPKernelApp" in getattr(shell, "config", {})
        if enabled and (sys.stderr.isatty() or is_notebook):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # that there are no widgets, where text does as well
                if is_notebook:
                    from tqdm.auto import tqdm
                else:
                    from tqdm import tqdm
            self._bar = tqdm(total=total, desc=self._label, unit="step", unit_scale=True, dynamic_ncols=True)

    def update(self, step: int, note: str) -> None:
        """Show that `step` steps are done; `note` says how it goes."""
        if self._bar is not None:
            self._bar.set_postfix_str(note, refresh=False)
            self._bar.update(min(step, self._total) - self._bar.n)
            return
        share = min(step / self._total, 1.0)
        self._line.show(lambda: f"{self._label}: step {step:,} of {self._total:,} ({share:.0%}), {note}")

    def close(self) -> None:
        """Leave the bar as it is."""
        if self._bar is not None:
            self._bar.close()


@contextmanager
def telling_if_slow(what: str) -> Iterator[None]:
    """Print every few seconds that the block is still at work on `what`, if memory is limited.

    That is so for commands that read what somebody else may have written (`memory_budget`). Within another
    such block only the outer one prints.
    """
    if not is_limited() or _is_telling.get():
        yield
        return
    token, over, began = _is_telling.set(True), threading.Event(), time.monotonic()

    def tell() -> None:
        while not over.wait(_SECONDS_BETWEEN_LINES):
            seconds = time.monotonic() - began
            print(f"{printable(what)}: {seconds:.0f} s so far; Ctrl-C ends it", file=sys.stderr, flush=True)

    teller = threading.Thread(target=tell, daemon=True)
    teller.start()
    try:
        yield
    finally:
        over.set()
        teller.join()
        _is_telling.reset(token)


def time_left(done: int, to_do: int, seconds: float) -> str:
    """How long the rest may take if `done` parts took `seconds`, e.g. ", about 30 s left"; "" for none."""
    return f", about {duration(to_do * seconds / done)} left" if done > 0 else ""


def duration(seconds: float) -> str:
    """A time in the one or two units that say enough, e.g. "3 min 20 s"."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {whole % 3600 // 60} min"
