"""A finished run as other programs take one: flat settings, numbers, curve, and verified copies of its files.

The run's folder is data, as for a report: its settings are checked against the schema, its result against the
manifest's checksums, and nothing in it is imported or unpickled.
"""

from __future__ import annotations

import dataclasses
import math
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gridworld.config.flatten import flat
from gridworld.config.pictures import PICTURES
from gridworld.config.plain_settings import read_config
from gridworld.config.train import TrainConfig
from gridworld.config.worlds import MapConfig
from gridworld.errors import InputError
from gridworld.process.console.terminal import plain, printable, tell
from gridworld.report.evidence.curve_reader import ONLINE, read_columns
from gridworld.report.evidence.run_reader import Evidence, Unusable
from gridworld.report.evidence.run_reader import read as read_evidence
from gridworld.run.folder import WORLD
from gridworld.run.identity.stored_world import stored_world
from gridworld.run.reader import LARGEST_RESULT, RunReader, open_run
from gridworld.storage.safe_read import sha256
from gridworld.world.metrics import METRICS
from gridworld.world.sources.arrays import world_bytes

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
    models: tuple[Path, ...]  # copies: of the last one, and of the best one where it was kept
    pictures: tuple[Path, ...]  # copies of the pictures and films that are there
    world: Path | None  # a copy of its tables; None: it is a map

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
    def steps(self) -> int:
        """Environment steps at the end."""
        return self.evidence.steps

    @property
    def settings(self) -> dict[str, Any]:
        """All settings, flat: {"agent.gamma": 0.9, ...}; values as in JSON."""
        return {plain(key): value for key, value in flat(dataclasses.asdict(self.config))}


def read(folder: Path, copies: Path) -> ExportedRun:
    """Read a finished run.

    Args:
        folder: The run's folder.
        copies: An empty folder, for copies of its files.

    Raises:
        InputError: It is no finished run, or a file is missing, too large, or not the one that the run wrote.
    """
    evidence = read_evidence(folder)
    if isinstance(evidence, Unusable):
        raise InputError("; ".join(evidence.reasons))
    run = open_run(folder)
    config = read_config(run.manifest["config"], str(run.manifest_file))
    return ExportedRun(
        identity=sha256(repr(sorted(run.manifest["sha256"].items())).encode())[:16],
        evidence=evidence,
        config=config,
        summary=dict(_numbers(run)),
        curve=list(_curve(run)),
        models=tuple(_models(run, copies)),
        pictures=tuple(_pictures(run, copies)),
        world=_world(run, config, copies),
    )


def _safe(name: str) -> str:
    return re.sub(r"[^\w.-]+", "_", name, flags=re.ASCII)


def _numbers(run: RunReader) -> Iterator[tuple[str, float]]:
    for key, value in flat(run.read_summary()):
        if isinstance(value, int | float) and re.fullmatch(r"[\w.]+", key, re.ASCII):
            yield key, value


def _curve(run: RunReader) -> Iterator[Row]:
    columns = {name: column.tolist() for name, column in read_columns(run, ("step", *_COLUMNS)).items()}
    for step, *row in zip(*columns.values(), strict=True):
        named = zip(list(columns)[1:], row, strict=True)
        yield int(step), {name: number for name, number in named if math.isfinite(number)}


def _models(run: RunReader, copies: Path) -> Iterator[Path]:
    for path in (run.model_file, run.best_model_file):
        if path == run.model_file or path.name in run.manifest["sha256"]:  # earlier versions kept no best one
            copy = copies / path.name
            copy.write_bytes(run.read(path, LARGEST_RESULT))
            yield copy


def _world(run: RunReader, config: TrainConfig, copies: Path) -> Path | None:
    if isinstance(config.env, MapConfig):
        return None
    copy = copies / WORLD
    copy.write_bytes(world_bytes(stored_world(run, config.env)))
    return copy


def _pictures(run: RunReader, copies: Path) -> Iterator[Path]:
    """Those that the folder still has; earlier versions noted no checksum of an episode's films."""
    for picture in PICTURES:
        path = run.folder / picture.file
        if not path.suffix or not os.path.lexists(path):
            continue
        if picture.file not in run.manifest["sha256"]:
            tell(printable(f"{path}: is left out, the run's manifest has no checksum of it"))
            continue
        copy = copies / path.name
        copy.write_bytes(run.read(path, _LARGEST_PICTURE))
        yield copy
