"""A finished run as other programs take one: flat settings, numbers, curve, and verified copies of its files.

The run's folder is data, as for a report: its settings are checked against the schema, its files against the
manifest's checksums, and nothing in it is imported or unpickled.
"""

from __future__ import annotations

import dataclasses
import math
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gridworld.base.console import plain
from gridworld.base.errors import InputError
from gridworld.base.safe_read import sha256
from gridworld.config.settings import flat, read_config
from gridworld.config.train import TrainConfig
from gridworld.config.worlds import MapConfig
from gridworld.report.evidence import Evidence, Unusable
from gridworld.report.evidence import read as read_evidence
from gridworld.run.reader import LARGEST_RESULT, ONLINE, RunReader, open_run, read_columns, stored_world
from gridworld.world.mdp import Mdp
from gridworld.world.metrics import METRICS

_LARGEST_PICTURE = 64 * 2**20  # bytes
_COLUMNS = (*(f"{whose}{metric.name}" for whose in ("", "sampled_") for metric in METRICS), ONLINE)

Row = tuple[int, dict[str, float]]  # environment steps, and the numbers that there are


@dataclass(frozen=True, eq=False)
class ExportedRun:
    """What a target writes."""

    identity: str  # 16 hexadecimal digits, no other run's
    evidence: Evidence  # as a report has it
    config: TrainConfig
    summary: dict[str, float]  # the numbers of summary.json, those in a group under dotted names
    curve: list[Row]  # one for each evaluation
    models: tuple[Path, ...]  # copies: of the last one, and of the best one
    pictures: tuple[Path, ...]  # copies of the pictures and films that the manifest has
    mdp: Mdp  # its world

    @property
    def is_map(self) -> bool:
        """Whether its world is a map."""
        return isinstance(self.config.env, MapConfig)

    @property
    def env(self) -> str:
        """The map's name, in letters that are safe in names of files."""
        return _safe(self.evidence.env)

    @property
    def group(self) -> str:
        """The agent and the map, in such letters: the same for all seeds."""
        return _safe(f"{self.evidence.agent}-{self.env}")

    @property
    def name(self) -> str:
        """`group` and the seed."""
        return f"{self.group}-seed{self.evidence.seed}"

    @property
    def settings(self) -> dict[str, Any]:
        """All settings, flat: {"agent.gamma": 0.9, ...}; values as in JSON."""
        return {plain(key): value for key, value in flat(dataclasses.asdict(self.config))}


def read(folder: Path, copies: Path) -> ExportedRun:
    """Read a finished run; `copies` is an empty folder, for copies of its files."""
    evidence = read_evidence(folder)
    if isinstance(evidence, Unusable):
        raise InputError("; ".join(evidence.reasons))
    run = open_run(folder)
    config, sums = read_config(run.manifest["config"], str(run.manifest_file)), run.manifest["sha256"]
    numbers = {key: value for key, value in flat(run.read_summary()) if isinstance(value, int | float)}

    def copied(path: Path, most: int) -> Path:
        copy = copies / path.name
        copy.write_bytes(run.read(path, most))
        return copy

    pictures = [run.folder / name for name in run.pictures() if os.path.lexists(run.folder / name)]
    return ExportedRun(
        identity=sha256(repr(sorted(sums.items())).encode())[:16],
        evidence=evidence,
        config=config,
        summary={key: value for key, value in numbers.items() if re.fullmatch(r"[\w.]+", key, re.ASCII)},
        curve=_curve(run),
        models=tuple(copied(path, LARGEST_RESULT) for path in (run.model_file, run.best_model_file)),
        pictures=tuple(copied(path, _LARGEST_PICTURE) for path in pictures),
        mdp=stored_world(run, config.env),
    )


def _safe(name: str) -> str:
    return re.sub(r"[^\w.-]+", "_", name, flags=re.ASCII)


def _curve(run: RunReader) -> list[Row]:
    columns = {name: column.tolist() for name, column in read_columns(run, ("step", *_COLUMNS)).items()}
    rows = (dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True))
    return [
        (int(row.pop("step")), {name: number for name, number in row.items() if math.isfinite(number)})
        for row in rows
    ]
