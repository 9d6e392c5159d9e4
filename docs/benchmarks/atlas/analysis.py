"""What rows show: shares, steps and regret with intervals, and whether two implementations are equal."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from plan import MARGIN, Job, World, worlds_of
from rows import Row, grid
from scipy import stats

from gridworld.report import statistics

SEED = 0  # of the bootstrap
_LEVEL = 0.05  # of each one-sided test
_FEW, _PLANNED = 10, 50


@dataclass(frozen=True)
class Group:
    """The rows of one library's algorithm in one world, by seed."""

    library: str
    algorithm: str
    world: World
    rows: tuple[Row, ...]

    @property
    def steps(self) -> np.ndarray:
        """(n,), steps to certified for good; infinity where it is not."""
        return np.array([float(row.certified_since or math.inf) for row in self.rows])

    @property
    def certified(self) -> statistics.Share:
        return statistics.share(int(np.isfinite(self.steps).sum()), len(self.rows))

    def curve(self) -> tuple[np.ndarray, ...]:
        """Steps (points,), and the interquartile mean of regret there with its band, (points,) each."""
        regrets = np.stack([row.regrets() for row in self.rows], axis=1)
        steps = grid(self.rows[0].done, self.rows[0].every)
        return (steps, *statistics.bands(statistics.iqm, [regrets], SEED))


def groups(rows: Iterable[Row], page: str) -> list[Group]:
    """The rows of a page as its settings are now, with each library's newest versions in the file."""
    worlds = {world.name: world for world in worlds_of(page)}
    own = [row for row in rows if row.page == page and row.world in worlds]
    newest = {row.library: row.versions for row in own}
    found = defaultdict(list)
    for row in sorted(own, key=lambda row: int(row.seed)):
        if row.versions == newest[row.library]:
            found[row.algorithm, row.world, row.library, row.digest].append(row)
    order = list(worlds)
    return [
        Group(library, algorithm, worlds[name], tuple(each))
        for (algorithm, name, library, digest), each in sorted(
            found.items(), key=lambda item: (item[0][0], order.index(item[0][1]), *item[0][2:])
        )
        if digest == Job(page, library, algorithm, worlds[name], 0).digest
    ]


@dataclass(frozen=True)
class Comparison:
    """Two libraries' same algorithm in the same world, by steps to certified for good."""

    first: Group
    second: Group

    @property
    def seeds(self) -> int:
        return min(len(self.first.rows), len(self.second.rows))

    @property
    def identical(self) -> int:
        """On how many seeds both have the same curve, in every digit."""
        curves = {row.seed: (row.curve, row.done) for row in self.first.rows}
        return sum(curves.get(row.seed) == (row.curve, row.done) for row in self.second.rows)

    @property
    def improvement(self) -> statistics.Interval:
        """The probability that a run of the first needs fewer steps."""
        return statistics.improvement([(-self.first.steps, -self.second.steps)], SEED)

    @property
    def equivalence(self) -> tuple[statistics.Interval, float] | None:
        """Two one-sided tests; None where a run was not certified, which has no number of steps."""
        both = self.first.steps, self.second.steps
        return equivalence(*both) if np.isfinite(np.concatenate(both)).all() and self.seeds > 1 else None

    @property
    def verdict(self) -> str:
        """In words; each pair alone, without a correction for how many pairs there are."""
        if self.identical == self.seeds:
            return "the same curves"
        if self.seeds < _FEW:
            return "too few seeds"
        if self.equivalence is None:
            apart = statistics.difference(self.first.certified, self.second.certified)
            return "differ in share" if apart.low > 0 or apart.high < 0 else "undecided"
        ratio, p = self.equivalence
        differ = "differ" if ratio.low > 1 or ratio.high < 1 else "undecided"
        return "equal" if p <= _LEVEL else differ


def equivalence(one: np.ndarray, other: np.ndarray) -> tuple[statistics.Interval, float]:
    """The ratio of geometric means with its 90 % interval, and the p value of two one-sided Welch tests.

    D. Schuirmann, Journal of Pharmacokinetics and Biopharmaceutics 15, 1987.
    """
    logs, margin = [np.log(np.maximum(steps, 1)) for steps in (one, other)], math.log(MARGIN)
    gap, parts = logs[0].mean() - logs[1].mean(), [log.var(ddof=1) / len(log) for log in logs]
    error = math.sqrt(sum(parts))
    if error == 0:
        return statistics.Interval(*[math.exp(gap)] * 3), float(abs(gap) >= margin)
    freedom = sum(parts) ** 2 / sum(part**2 / (len(log) - 1) for part, log in zip(parts, logs, strict=True))
    half = stats.t.ppf(1 - _LEVEL, freedom) * error
    p = max(stats.t.sf((margin + side * gap) / error, freedom) for side in (1, -1))
    return statistics.Interval(*(math.exp(gap + side * half) for side in (0, -1, 1))), float(p)


def caution(found: Iterable[Group]) -> str:
    """How much so many seeds allow to say."""
    counts = sorted({len(group.rows) for group in found})
    number = " to ".join(map(str, dict.fromkeys((counts[0], counts[-1])))) + " seeds"
    if counts[0] < _FEW:
        return f"**{number}: a smoke test, no claim.**"
    return f"**{number}{': a first look' if counts[0] < _PLANNED else ''}.**"
