"""Comparisons of two measurements, and tables of their results."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from gridworld.base.console import aligned

Measure = Callable[[], float]  # returns a measurement in the unit of its table


@dataclass(frozen=True)
class Workload:
    """How much to measure."""

    repetitions: int
    seconds: float  # of a stepping measurement
    steps: int  # of a training measurement
    sweep_seeds: int
    certified_seeds: int


QUICK = Workload(repetitions=1, seconds=0.05, steps=8_192, sweep_seeds=1, certified_seeds=1)
FULL = Workload(repetitions=5, seconds=0.5, steps=65_536, sweep_seeds=20, certified_seeds=10)


@dataclass(frozen=True)
class Comparison:
    """A row of a table: ours, and a peer's where there is one to compare with."""

    table: str  # its title, with the unit
    name: str
    ours: Measure
    peer: str = ""
    theirs: Measure | None = None
    absent: str = ""  # why a named peer is not measured

    def measure(self, repetitions: int) -> ComparisonResult:
        """Measure both sides in turn, so many times."""
        pairs = [(self.ours(), self.theirs() if self.theirs else None) for _ in range(repetitions)]
        ours = statistics.median(pair[0] for pair in pairs)
        both = [(one, other) for one, other in pairs if other is not None]
        theirs = statistics.median(other for _, other in both) if both else None
        ratio = statistics.median(one / other for one, other in both) if both else None
        peer = f"{self.peer}: {self.absent}" if self.absent else self.peer
        return ComparisonResult(self.table, self.name, ours, peer, theirs, ratio, repetitions)


@dataclass(frozen=True)
class ComparisonResult:
    """The medians of both sides; the ratio is the median of the ratios pair by pair."""

    table: str
    name: str
    ours: float
    peer: str
    theirs: float | None
    ratio: float | None
    repetitions: int


def lines(results: Iterator[ComparisonResult]) -> Iterator[str]:
    """Format results as tables, each line as soon as its result is there."""
    table = None
    for result in results:
        if result.table != table:
            table = result.table
            yield ""
            yield _line(table, "ours", "peer", "ratio", "peer")
        theirs = "" if result.theirs is None else _number(result.theirs)
        ratio = "" if result.ratio is None else f"{result.ratio:.2f}x"
        yield _line(f"  {result.name}", _number(result.ours), theirs, ratio, result.peer)


def _line(name: str, ours: str, theirs: str, ratio: str, peer: str) -> str:
    [line] = aligned([[name, ours, theirs, ratio, f" {peer}"]], ("<50", ">12", ">12", ">8", "<0"))
    return line


def _number(value: float) -> str:
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"
