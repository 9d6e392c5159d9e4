"""One memory budget for whatever reads a folder that somebody else may have written.

What opens a run is `limited`, and so is a command that reads sweeps or studies. Whoever then allocates by a
number that was read calls `check_memory` first. The variable `GRIDWORLD_BUDGET` raises the budget. Time has
no limit: `console.telling_if_slow` says what takes long. Training has neither.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from gridworld.errors import InputError

VARIABLE = "GRIDWORLD_BUDGET"
_BYTES = {"MB": 1e6, "GB": 1e9}

_memory: ContextVar[float | None] = ContextVar("memory", default=None)  # bytes; None: no limit yet


class BudgetError(InputError):
    """Something would take more than the budget."""


@contextmanager
def limited(is_own: bool = False) -> Iterator[None]:
    """Apply the user's budget to the block, or to the function that this decorates.

    For what is this process's own there is none, nor for what is `limited` in the block.
    """
    text = os.environ.get(VARIABLE) or "1GB"
    found = re.fullmatch(r"([1-9]\d{0,5})(MB|GB)", text.strip().upper(), re.ASCII)
    if found is None:
        raise InputError(f"{VARIABLE}={text[:80]}: must be an amount of memory, e.g. 500MB or 8GB")
    most = math.inf if is_own or _memory.get() == math.inf else int(found[1]) * _BYTES[found[2]]
    token = _memory.set(most)
    try:
        yield
    finally:
        _memory.reset(token)


def is_limited() -> bool:
    """Whether a budget applies here."""
    return _memory.get() not in (None, math.inf)


def check_memory(what: object, size: float) -> None:
    """Raise `BudgetError` for more bytes than the budget, if there is one; `what` is for the message."""
    most = _memory.get()
    if most is not None and size > most:
        enough = min(math.ceil(size / 1e9), 999_999)
        raise BudgetError(
            f"{what}: would take about {_shown(size)} of memory, the budget is {_shown(most)}; if you trust "
            f"it and have room for it, set {VARIABLE}={enough}GB"
        )


def _shown(size: float) -> str:
    unit, factor = ("GB", 1e9) if size >= 1e9 else ("MB", 1e6)
    return f"{size / factor:,.3g} {unit}" if size < 1e15 else "more than a million GB"
