"""One memory budget for whatever reads a folder that somebody else may have written.

What opens a run is `limited`, and so is a command that reads sweeps or studies while it is at work. Whoever
then allocates by a number that was read calls `check_memory` first. The variable `GRIDWORLD_BUDGET` raises
the budget, e.g. to 8GB. Time has no limit: `progress.telling_if_slow` says what takes long, until it is done
or Ctrl-C.
Training of one's own, by train.py or tune.py, has neither budget nor such lines.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from contextvars import ContextVar

from gridworld.errors import InputError

VARIABLE = "GRIDWORLD_BUDGET"
_USUAL = "1GB"
_UNITS = {"MB": 10**6, "GB": 10**9}

_memory: ContextVar[float | None] = ContextVar("memory", default=None)  # bytes; None: no limit yet


class BudgetError(InputError):
    """Something would take more than the budget."""


@contextmanager
def limited() -> Iterator[None]:
    """Apply the budget to the block, or to the function that this decorates.

    Raises:
        InputError: the variable `GRIDWORLD_BUDGET` holds no amount of memory.
    """
    own = _memory.get() == math.inf
    with _budget(math.inf if own else _bytes(os.environ.get(VARIABLE) or _USUAL)):
        yield


def unlimited() -> AbstractContextManager[None]:
    """Apply no budget to the block, nor to what is `limited` in it: this process wrote what it reads."""
    return _budget(math.inf)


@contextmanager
def _budget(most: float) -> Iterator[None]:
    token = _memory.set(most)
    try:
        yield
    finally:
        _memory.reset(token)


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
        raise BudgetError(
            f"{what}: would take about {_shown(size)} of memory, the budget is {_shown(most)}; if you trust "
            f"it and have room for it, set {VARIABLE}={_enough(size)}"
        )


def _bytes(text: str) -> int:
    found = re.fullmatch(r"(\d{1,6})(MB|GB)", text.strip(), re.ASCII | re.IGNORECASE)
    if found is None or int(found[1]) == 0:
        raise InputError(f"{VARIABLE}={text[:80]}: must be an amount of memory, e.g. 500MB or 8GB")
    return int(found[1]) * _UNITS[found[2].upper()]


def _shown(size: float) -> str:
    unit = "GB" if size >= _UNITS["GB"] else "MB"
    return f"{size / _UNITS[unit]:,.3g} {unit}" if size < 1e15 else "more than a million GB"


def _enough(size: float) -> str:
    """The least amount for the variable that is not below `size`."""
    return f"{min(-int(-size // _UNITS['GB']), 999_999)}GB"
