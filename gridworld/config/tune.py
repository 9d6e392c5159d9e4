"""Settings of the command `tune`: `tune` on its command line, and what conf/tune/*.yaml may hold."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Optional

from gridworld.config.agents import MISSING
from gridworld.config.fields import bounds

# OmegaConf reads these annotations at run time and knows no `X | None`.

MOST_SEEDS = 10_000
MOST_TRIALS = 1_000_000


@dataclass
class DimensionConfig:
    """What a search may choose for one key: a range, or a list."""

    type: str = MISSING  # float, int, categorical
    low: Optional[float] = None  # noqa: UP045  # of a range, included
    high: Optional[float] = None  # noqa: UP045  # the same
    log: bool = False  # even on a logarithmic scale
    step: Optional[float] = None  # noqa: UP045  # between the values of a range
    choices: Optional[list[Any]] = None  # noqa: UP045  # of a categorical one


@dataclass
class TuneConfig:
    """How `scripts/tune.py` searches; `tune` on the command line."""

    trials: int = field(default=100, metadata=bounds(1, MOST_TRIALS))  # the search ends after so many
    seeds: int = field(default=3, metadata=bounds(1, MOST_SEEDS))  # a trial's: seed, seed + 1, ...
    # trials that go on to more seeds, beside what the search began from
    finalists: int = field(default=5, metadata=bounds(1, MOST_SEEDS))
    final_seeds: int = field(default=10, metadata=bounds(0, MOST_SEEDS))  # the next ones, for the finalists
    # the next ones, for the winner and for what the search began from
    confirm_seeds: int = field(default=20, metadata=bounds(2, MOST_SEEDS))
    study: Optional[str] = None  # noqa: UP045  # its name; null: of agent and world
    folder: Optional[str] = None  # noqa: UP045  # null: runs/STUDY
    storage: Optional[str] = None  # noqa: UP045  # any URL that Optuna takes; null: study.db in the folder
    workers: int = field(default=-1, metadata=bounds(-1))  # processes; -1 for one on each core
    # trials of a worker at once; null: 8 of all, 1 of one
    together: Optional[int] = field(default=None, metadata=bounds(1))  # noqa: UP045
    # seconds; no trial begins after that
    timeout: Optional[float] = field(default=None, metadata=bounds(0, above=True))  # noqa: UP045
    sampler: str = "tpe"  # or random
    sampler_seed: int = field(default=0, metadata=bounds(0))  # of the search itself
    pruner: str = "median"  # or hyperband, none
    # of a seed, at least, so that who is certified sooner shows
    evaluations: int = field(default=50, metadata=bounds(1, 100_000))
    reports: int = field(default=10, metadata=bounds(1, 100_000))  # looks of the pruner at a seed's curve
    # a trial's seed ends at this many certificates in a row
    stop_after: Optional[int] = field(default=3, metadata=bounds(1))  # noqa: UP045
    space: dict[str, DimensionConfig] = field(default_factory=dict)  # conf/tune/*.yaml


@dataclass
class SearchConfig:
    """The root of conf/tune.yaml."""

    tune: TuneConfig = field(default_factory=TuneConfig)
