"""One memory budget for whatever reads a folder that somebody else may have written.

What opens a run is `limited`, and so is a command that reads sweeps or studies while it is at work. Whoever
then allocates by a number that was read calls `check_memory` first. The variable `GRIDWORLD_BUDGET` raises
the budget, e.g. to 8GB. Time has no limit: `progress.telling_if_slow` says what takes long. The user's own
training, by train.py or tune.py, has neither budget nor such lines.
"""

from __future__ import annotations

import gc
import math
import os
import re
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from contextvars import ContextVar

from gridworld.errors import InputError

VARIABLE = "GRIDWORLD_BUDGET"
_MEGABYTES = {"MB": 1, "GB": 1000}
_OBJECTS_BETWEEN_COLLECTIONS = 50_000  # 700 is Python's own

_memory: ContextVar[float | None] = ContextVar("memory", default=None)  # bytes; None: no limit yet


class BudgetError(InputError):
    """Something would take more than the budget."""


@contextmanager
def limited(most: float | None = None) -> Iterator[None]:
    """Apply a budget, by default the user's, to the block, or to the function that this decorates."""
    text = os.environ.get(VARIABLE) or "1GB"
    found = re.fullmatch(r"([1-9]\d{0,5})(MB|GB)", text.strip().upper(), re.ASCII)
    if _memory.get() == math.inf:
        most = math.inf
    elif most is None and found is None:
        raise InputError(f"{VARIABLE}={text[:80]}: must be an amount of memory, e.g. 500MB or 8GB")
    elif most is None and found is not None:
        most = int(found[1]) * _MEGABYTES[found[2]] * 1e6
    token = _memory.set(most)
    try:
        yield
    finally:
        _memory.reset(token)


def unlimited() -> AbstractContextManager[None]:
    """Apply no budget to the block, nor to what is `limited` in it: this process wrote what it reads."""
    return limited(math.inf)


def is_limited() -> bool:
    """Whether a budget applies here."""
    return _memory.get() not in (None, math.inf)


def check_memory(what: object, size: float) -> None:
    """Refuse what would take more memory than the budget. Call it before allocating.

    Args:
        what: a file or a part of a run, for the message.
        size: bytes.

    Raises:
        BudgetError: there is a budget, and `size` is above it.
    """
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


def collect_less_often() -> None:
    """Set how often garbage is collected in this process: it is a sixth of the time of a short run."""
    gc.set_threshold(_OBJECTS_BETWEEN_COLLECTIONS)
