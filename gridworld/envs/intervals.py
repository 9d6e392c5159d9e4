"""95 % intervals for what is sampled: a share of hits, and a mean."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from gridworld.world.mdp import BoolArray, FloatArray

_Z = 1.959963984540054  # standard deviations of the normal distribution on either side of 95 % of it
_UNBOUNDED = (-math.inf, math.inf)


@dataclass(frozen=True)
class Estimate:
    """A mean over samples with its 95 % interval."""

    mean: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.mean:.4g} [{self.low:.3g}, {self.high:.3g}]"


def wilson_interval(count: int, total: int) -> tuple[float, float]:
    """Wilson's score interval, from 0 to 1, for the share of `count` hits in `total` samples, one or more.

    It is `scipy.stats.binomtest(count, total).proportion_ci(0.95, method="wilson")`, without the second that
    `scipy.stats` takes to import. Reference: method 3 of R. G. Newcombe, Statistics in Medicine 17, 1998.
    """
    share = count / total
    scale = 2 * (total + _Z**2)
    centre = (2 * total * share + _Z**2) / scale
    half_width = _Z / scale * math.sqrt(4 * total * share * (1 - share) + _Z**2)
    return (0.0 if count == 0 else centre - half_width), (1.0 if count == total else centre + half_width)


def estimate_share(hits: BoolArray) -> Estimate:
    """The share of samples (n,) that are hits, with Wilson's interval."""
    count, total = int(hits.sum()), len(hits)
    return Estimate(count / total, *wilson_interval(count, total))


def estimate_mean(
    samples: FloatArray, unseen: float, unseen_if_equal: float, bounds: tuple[float, float] = _UNBOUNDED
) -> Estimate:
    """The mean of samples (n,), with a normal interval that is widened by what rare samples may hide.

    The half-width is z²R/2n + z √(s²/n + z²R²/4n²): z²R/n for equal samples, z s/√n for many, widened as
    Wilson's interval is for a share. R, their range, is at least `unseen`, or `unseen_if_equal` where all are
    equal. No sample is outside of `bounds`, and so is no end of the interval.
    """
    count, mean, seen = len(samples), float(samples.mean()), float(np.ptp(samples))
    spread = max(unseen, seen) if seen else unseen_if_equal
    variance = float(samples.var(ddof=1)) / count if count > 1 else math.inf
    hidden = _Z**2 * spread / (2 * count)
    half_width = hidden + math.hypot(_Z * variance**0.5, hidden)
    return Estimate(mean, max(bounds[0], mean - half_width), min(bounds[1], mean + half_width))
