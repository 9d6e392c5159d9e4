"""Whether an implementation of an algorithm is right."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from gridworld.checking.run import CheckResult, check_all
from gridworld.checking.subject import subject

__all__ = ["CheckResult", "check"]


def check(
    algorithm: Any,
    arguments: Mapping[str, Any] | None = None,
    probes: Sequence[str] = (),
    seed: int = 0,
) -> CheckResult:
    """Train an implementation on small worlds with known answers, and compare with the exact numbers.

    It takes about half a minute, in this process. `check.py --help` has the probes and what it means where
    one fails; a probe fails if it fails on two of three seeds.

    Args:
        algorithm: a class with SB3's interface, its import path, or the name of a shipped agent. A class
            trains in its own loop.
        arguments: of its constructor, in place of those that the probes choose.
        probes: names; none: all.
        seed: the first of the three.

    Returns:
        `passed`, `failed` (names), `findings` (a row for each probe); its text is the table.

    Raises:
        InputError: no such implementation, probe or argument, or a class that refuses its arguments.

    Example:
        >>> check("q_learning").passed
        True
    """
    return check_all(subject(algorithm), dict(arguments or {}), probes, seed)
