"""Comparing two runs of one configuration bit for bit.

Compared are the learning curve, the model's tensors (the optimiser's too), the visit counts, the summary and
TensorBoard's scalars, without the times in them. The runs' files are data, read within bounds.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gridworld.agents import family
from gridworld.config.settings import flat
from gridworld.config.train import TrainConfig
from gridworld.restore.saved_run import read_visits
from gridworld.run.folder import BEST_MODEL, EVENTS, MODEL
from gridworld.run.reader import LARGEST_RESULT, RunReader
from gridworld.storage.event_file import read_scalars
from gridworld.storage.safe_read import LARGEST_CSV, as_table
from gridworld.training.summary import CLOCK
from gridworld.world.mdp import Mdp

CLOCK_TAGS = "time/"  # prefix of the TensorBoard tags of SB3's speed
_SPARE_BYTES = 2**20


@dataclass(frozen=True)
class Finding:
    """How one part of the result compares.

    Attributes:
        part: Which part.
        told: How much was compared, or the first difference.
        same: Whether it is identical; None: it cannot be compared.
    """

    part: str
    told: str
    same: bool | None = True


def check_whole(then: RunReader, config: TrainConfig) -> None:
    """Check the files of a run that are to be compared."""
    best = [then.best_model_file] if _has_best(then) else []
    for path in (then.curve_file, then.model_file, *best, then.visits_file, then.summary_file):
        then.verify(path)
    if config.logging.tensorboard:
        for _ in _points(then.folder):
            pass


def compare(then: RunReader, now: RunReader, config: TrainConfig, mdp: Mdp) -> Iterator[Finding]:
    """Compare two finished runs.

    Args:
        then: The earlier run.
        now: The later one.
        config: The settings of both.
        mdp: The world of both.

    Yields:
        A finding for each part of the result.
    """
    yield _curves(then, now)
    yield _weights(then, now, config, MODEL)
    if _has_best(then):
        yield _weights(then, now, config, BEST_MODEL)
    yield _visits(then, now, mdp)
    yield _summaries(then, now)
    if config.logging.tensorboard:
        yield _scalars(then, now)


def _curves(then: RunReader, now: RunReader) -> Finding:
    part = "learning curve"
    before, after = (list(csv.reader(_lines(run))) for run in (then, now))
    rows: Iterator[tuple[list[str], list[str]]] = zip_longest(before, after, fillvalue=[])
    for row, (one, other) in enumerate(rows):
        for column, (old, new) in enumerate(zip_longest(one, other)):
            if old != new:
                step = (one or other)[0]
                name = before[0][column] if column < len(before[0]) else f"column {column + 1}"
                where = f"step {step}, {name}" if row else "the header"
                return Finding(part, f"first at {where}: {_cell(old)} then, {_cell(new)} now", False)
    return Finding(part, f"{len(before) - 1:,} rows")


def _lines(run: RunReader) -> list[str]:
    return as_table(run.read(run.curve_file, LARGEST_CSV), run.curve_file).splitlines()


def _cell(text: str | None) -> str:
    return "nothing" if text is None else text[:40] or "empty"


def _has_best(run: RunReader) -> bool:
    """Whether it kept its best model, which older versions did not."""
    return BEST_MODEL in run.manifest.get("sha256", {})


def _weights(then: RunReader, now: RunReader, config: TrainConfig, name: str) -> Finding:
    part, read = "best weights" if name == BEST_MODEL else "final weights", family(config.agent).weights
    after = read(now.folder / name, LARGEST_RESULT)
    before = read(then.folder / name, 2 * (now.folder / name).stat().st_size + _SPARE_BYTES)
    for name in sorted(before.keys() ^ after.keys()):
        return Finding(part, f"{name[:80]} is in one of the models only", False)
    for name, old in before.items():
        new = after[name]
        if (old.dtype, old.shape) != (new.dtype, new.shape):
            told = f"{old.dtype} {old.shape} then, {new.dtype} {new.shape} now"
            return Finding(part, f"first in {name}: {told}", False)
        if (place := _first_difference(old, new)) is not None:
            told = f"{old[place]} then, {new[place]} now"
            where = f"{name}{list(map(int, place)) if place else ''}"
            return Finding(part, f"first in {where}: {told}", False)
    return Finding(part, f"{len(before):,} tensors and numbers")


def _first_difference(old: NDArray[Any], new: NDArray[Any]) -> tuple[Any, ...] | None:
    """The index of the first element that differs in arrays of one type and shape; NaN equals NaN."""
    same = old == new
    if old.dtype.kind in "fc":
        same |= np.isnan(old) & np.isnan(new)
    return None if same.all() else tuple(np.argwhere(np.atleast_1d(~same))[0][: old.ndim])


def _visits(then: RunReader, now: RunReader, mdp: Mdp) -> Finding:
    before, after = (read_visits(run, mdp.probability.shape[:2]) for run in (then, now))
    place = _first_difference(before, after)
    if place is None:
        return Finding("visits", f"{before.sum():,} steps")
    where = f"{mdp.state_name(int(place[0]))}, {mdp.action_names[int(place[1])]}"
    return Finding("visits", f"first at {where}: {before[place]} then, {after[place]} now", False)


def _summaries(then: RunReader, now: RunReader) -> Finding:
    before, after = (_without_clock(run.read_summary()) for run in (then, now))
    for name in {**before, **after}:
        if name in _NEWER and name not in before:
            continue  # the run is of a version before it
        if before.get(name) != after.get(name):
            told = f"{str(before.get(name))[:40]} then, {str(after.get(name))[:40]} now"
            return Finding("summary", f"first in {name[:80]}: {told}", False)
    return Finding("summary", f"{len(before)} entries, those of the clock aside")


_NEWER = ("recipe", "preset", "privileges", "endless_states")  # of a summary


def _without_clock(summary: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in flat(summary) if key not in CLOCK}


def _scalars(then: RunReader, now: RunReader) -> Finding:
    part = "TensorBoard points"
    pairs = zip_longest(*(_points(run.folder) for run in (then, now)))
    if next(_points(then.folder), None) is None:
        return Finding(part, "the run's folder has no event file any more", None)
    count = 0
    for old, new in pairs:
        count += 1
        if old != new and not (old and new and old[:2] == new[:2] and math.isnan(old[2] + new[2])):
            tag, step, _ = old or new or ("", 0, 0.0)
            told = f"{old[2] if old else 'nothing'} then, {new[2] if new else 'nothing'} now"
            if old and new and old[:2] != new[:2]:
                told = f"{old[0][:80]} at step {old[1]} then, {new[0]} at step {new[1]} now"
            return Finding(part, f"first at step {step}, {tag[:80]}: {told}", False)
    return Finding(part, f"{count:,} points")


def _points(folder: Path) -> Iterator[tuple[str, int, float]]:
    """(tag, step, value) in the order in which they were written."""
    points = (point for path in sorted(folder.glob(EVENTS)) for point in read_scalars(path))
    return (point for point in points if not point[0].startswith(CLOCK_TAGS))
