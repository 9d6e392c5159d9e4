"""Settings of the command `tune`: `tune` on its command line, and what conf/tune/*.yaml may hold."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Optional

from gridworld.config.agents import MISSING

# OmegaConf reads these annotations at run time and knows no `X | None`.


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

    trials: int = 100  # the search ends after so many
    seeds: int = 3  # a trial's: seed, seed + 1, ...
    finalists: int = 5  # trials that go on to more seeds, beside what the search began from
    final_seeds: int = 10  # the next ones, for the finalists
    confirm_seeds: int = 20  # the next ones, for the winner and for what the search began from
    study: Optional[str] = None  # noqa: UP045  # its name; null: of agent and world
    folder: Optional[str] = None  # noqa: UP045  # null: runs/STUDY
    storage: Optional[str] = None  # noqa: UP045  # any URL that Optuna takes; null: study.db in the folder
    workers: int = -1  # processes; -1 for one on each core
    together: Optional[int] = None  # noqa: UP045  # trials of a worker at once; null: 8 of all, 1 of one
    timeout: Optional[float] = None  # noqa: UP045  # seconds; no trial begins after that
    sampler: str = "tpe"  # or random
    sampler_seed: int = 0  # of the search itself
    pruner: str = "median"  # or hyperband, none
    evaluations: int = 50  # of a seed, at least, so that who is certified sooner shows
    reports: int = 10  # looks of the pruner at a seed's curve
    stop_after: Optional[int] = 3  # noqa: UP045  # a trial's seed ends at this many certificates in a row
    heartbeat: int = 5  # seconds; a worker that gives no sign for three times as long loses its trial
    space: dict[str, DimensionConfig] = field(default_factory=dict)  # conf/tune/*.yaml


@dataclass
class SearchConfig:
    """The root of conf/tune.yaml."""

    tune: TuneConfig = field(default_factory=TuneConfig)
