"""Bounds of settings: a value outside raises `InputError` with a sentence that names key, value and bound."""

from __future__ import annotations

import math

from gridworld.errors import InputError

STEP_LIMIT = 100  # steps of an episode, where neither the world nor a setting says another
MOST_STEPS = 100_000  # of an episode; an evaluation goes through all of them
NEAREST_GAMMA = 1 - 1e-11  # to 1, but for 1 itself


def at_least(key: str, value: float, bound: float) -> None:
    """Refuse a value that is below the bound, infinite or NaN."""
    if not bound <= value < math.inf:
        raise InputError(f"{key}={value}: must be at least {bound}")


def at_most(key: str, value: float, bound: float) -> None:
    """Refuse a value that is above the bound, or NaN."""
    if not value <= bound:
        raise InputError(f"{key}={value}: must be at most {bound}")


def above_zero(key: str, value: float) -> None:
    """Refuse a value that is not positive, infinite or NaN."""
    if not 0 < value < math.inf:
        raise InputError(f"{key}={value}: must be a positive number")


def within(key: str, value: float, low: float, high: float) -> None:
    """Refuse a value outside [low, high], or NaN."""
    if not low <= value <= high:
        raise InputError(f"{key}={value}: must be from {low} to {high}")


def within_size(key: str, value: float, least: float, most: float, why: str = "") -> None:
    """Refuse a value that is neither 0 nor of a size in [least, most], or NaN."""
    if value != 0 and not least <= abs(value) <= most:
        raise InputError(f"{key}={value}: must be 0 or of a size from {least:g} to {most:g}{why}")


def discount(key: str, value: float) -> None:
    """Refuse a value outside [0, 1], or one so near to 1 that double precision loses the cost of a step."""
    within(key, value, 0, 1)
    if NEAREST_GAMMA < value < 1:
        raise InputError(
            f"{key}={value}: is so near to 1 that rounding hides what a step costs; must be 1, or at most "
            f"{NEAREST_GAMMA}"
        )
