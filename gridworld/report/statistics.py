"""Statistics over seeds, with intervals.

Interquartile mean (IQM): the mean without the lowest and the highest ⌊n/4⌋ values, as
`scipy.stats.trim_mean(x, 0.25)`. Intervals: the 95 % percentile bootstrap, runs drawn anew within each task
(the strata), as `scipy.stats.bootstrap` does; the same draws serve every point of a curve. Both come to
SciPy's numbers without `scipy.stats`, which takes as long to import as two runs to train.

Infinity is a value like any other: a run that was never certified took infinitely many steps.

References: R. Agarwal et al., Deep Reinforcement Learning at the Edge of the Statistical Precipice, NeurIPS
2021; H. B. Mann and D. R. Whitney, Annals of Mathematical Statistics 18, 1947;
R. G. Newcombe, Statistics in Medicine 17, 1998 (his method 10).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from gridworld.world.mdp import FloatArray
from gridworld.world.metrics import wilson_interval

RESAMPLES = 2000
INFINITE = 1e90  # numbers beyond stand for infinity

_TRIMMED = 0.25  # of the values, at either end
_BOUNDS = (0.025, 0.975)  # quantiles
_FAR = 1e100  # stands in for infinity while sums and differences are taken; whatever it touches is infinite
_LARGEST_BATCH = 4_000_000  # numbers that one batch of resamples may hold, 32 MB


@dataclass(frozen=True)
class Interval:
    """A point estimate and its 95 % interval; NaN bounds where one run allows none."""

    point: float
    low: float
    high: float


@dataclass(frozen=True)
class Share:
    """How many of how many, with Wilson's interval for the share."""

    count: int
    total: int
    low: float
    high: float

    @property
    def is_whole(self) -> bool:
        """Whether it is all of them."""
        return self.count == self.total

    def __str__(self) -> str:
        return f"{self.count} of {self.total} [{100 * self.low:.0f} %, {100 * self.high:.0f} %]"


Statistic = Callable[..., FloatArray]  # of all samples (..., n) together, along the last axis


def mean(*samples: FloatArray) -> FloatArray:
    """Mean of all samples together, each (..., n)."""
    return np.asarray(np.concatenate(samples, axis=-1).mean(axis=-1))


def median(*samples: FloatArray) -> FloatArray:
    """Median of all samples together, each (..., n)."""
    return np.asarray(np.median(np.concatenate(samples, axis=-1), axis=-1))


def iqm(*samples: FloatArray) -> FloatArray:
    """Interquartile mean of all samples together, each (..., n)."""
    values = np.concatenate(samples, axis=-1)
    count = values.shape[-1]
    cut = int(_TRIMMED * count)
    ordered = np.partition(values, (cut, count - cut - 1), axis=-1)
    return np.asarray(ordered[..., cut : count - cut].mean(axis=-1))


def share(count: int, total: int) -> Share:
    """The share `count / total` with Wilson's 95 % interval."""
    return Share(count, total, *wilson_interval(count, total))


def difference(first: Share, second: Share) -> Interval:
    """How much greater the first share is, with Newcombe's 95 % interval (his method 10)."""
    one, other = first.count / first.total, second.count / second.total
    return Interval(
        one - other,
        one - other - math.hypot(one - first.low, second.high - other),
        one - other + math.hypot(first.high - one, other - second.low),
    )


def bands(statistic: Statistic, samples: Sequence[FloatArray], seed: int) -> tuple[FloatArray, ...]:
    """A statistic of samples (..., n), one for each stratum, with its 95 % bootstrap interval at each point.

    Returns point, low and high, (...) each; low and high are NaN where a stratum has one run. Points with the
    same values, such as those of a curve that has arrived, have the same draws, and so the same statistics,
    which are computed once.
    """
    samples = [np.clip(sample, -_FAR, _FAR) for sample in samples]
    point, sizes = statistic(*samples), [sample.shape[-1] for sample in samples]
    bounds = np.full((2, *point.shape), math.nan)
    if min(sizes) > 1:
        joined = np.concatenate(samples, axis=-1)
        rows = joined.reshape(-1, joined.shape[-1])
        _, first, place = np.unique(rows, axis=0, return_index=True, return_inverse=True)
        samples = [sample.reshape(-1, sample.shape[-1])[first] for sample in samples]
        rng, batch = np.random.default_rng(seed), max(1, _LARGEST_BATCH // joined.size)
        parts = []
        for begin in range(0, RESAMPLES, batch):
            draws = [rng.integers(0, size, (min(batch, RESAMPLES - begin), size)) for size in sizes]
            parts.append(statistic(*(sample[..., draw] for sample, draw in zip(samples, draws, strict=True))))
        bounds = np.quantile(np.concatenate(parts, axis=-1), _BOUNDS, axis=-1)
        bounds = bounds[:, place.reshape(point.shape)]
    found = np.stack([point, *bounds])
    return tuple(np.where(np.abs(found) > INFINITE, np.copysign(math.inf, found), found))


def interval(statistic: Statistic, samples: Sequence[FloatArray], seed: int) -> Interval:
    """`bands` of samples (n,)."""
    return Interval(*(float(number) for number in bands(statistic, samples, seed)))


def profile(samples: Sequence[FloatArray], levels: FloatArray, seed: int) -> tuple[FloatArray, ...]:
    """A performance profile: the share of runs whose score is above each level, as the mean over tasks.

    `samples` are an agent's scores on each task, (n,). Returns the share and its pointwise 95 % interval,
    (points,) each (the score distribution of Agarwal et al. 2021, section 4.3).
    """

    def mean_share(*above: FloatArray) -> FloatArray:
        return np.asarray(np.mean([each.mean(axis=-1) for each in above], axis=0))

    return bands(mean_share, [(sample > levels[:, None]).astype(np.float64) for sample in samples], seed)


def improvement(pairs: Sequence[tuple[FloatArray, FloatArray]], seed: int) -> Interval:
    """The probability that a run of the first agent has the greater number; ties count as half.

    It is the Mann-Whitney statistic over n·m of both agents' samples on a task, (n,) and (m,), and the mean
    of these over tasks, with its 95 % bootstrap interval.
    """
    # (n, m) for each task: 1 where the first is greater, 1/2 for a tie.
    wins = [
        0.5 * np.greater.outer(first, second) + 0.5 * np.greater_equal.outer(first, second)
        for first, second in pairs
    ]

    def mean_probability(*drawn: FloatArray) -> FloatArray:
        """The mean share of pairs won among runs drawn by their places, (..., n) and (..., m) in turn."""
        shares = []
        for won, first, second in zip(wins, drawn[::2], drawn[1::2], strict=True):
            of_first = (_times_drawn(first) @ won) * _times_drawn(second)
            shares.append(of_first.sum(axis=-1) / won.size)
        return np.asarray(np.mean(shares, axis=0))

    places = [np.arange(len(sample), dtype=np.float64) for pair in pairs for sample in pair]
    return interval(mean_probability, places, seed)


def _times_drawn(places: FloatArray) -> FloatArray:
    """How often each of n places was drawn, (..., n) to (..., n); the rest is a matrix product, not pairs."""
    count = places.shape[-1]
    rows = places.reshape(-1, count).astype(np.int64)
    offsets = count * np.arange(len(rows))[:, None]
    return np.bincount((rows + offsets).ravel(), minlength=rows.size).reshape(places.shape).astype(np.float64)
