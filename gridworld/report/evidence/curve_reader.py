"""A run's learning curve, read within bounds."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence

import numpy as np

from gridworld.errors import InputError
from gridworld.run.reader import RunReader
from gridworld.storage.safe_read import LARGEST_CSV, as_table
from gridworld.world.mdp import FloatArray
from gridworld.world.metrics import METRICS, Metric

_MOST_COLUMNS = 100

REQUIRED = ("step", "value", "regret", "certified", "goal_probability", "return")
SAMPLED_RETURN = "sampled_return"
ONLINE = "online_return"  # undiscounted, of training episodes (`training.learning_curve`); may be empty
_FIRST = ("value", "return", "goal_probability")  # in the report's tables


def reported() -> list[Metric]:
    """The metrics of which a report has the last value, in the order of its tables."""
    chosen = [metric for metric in METRICS if metric.in_report]
    return sorted(chosen, key=lambda metric: (*_FIRST, metric.name).index(metric.name))


def read_curve(run: RunReader) -> dict[str, FloatArray]:
    """Read the columns that the statistics need: those in `REQUIRED`, and optional ones that the file has."""
    used = dict.fromkeys((*REQUIRED, *(metric.name for metric in reported()), SAMPLED_RETURN, ONLINE))
    curve = read_columns(run, tuple(used))
    curve["regret"] = np.maximum(0.0, curve["regret"])  # below zero is rounding
    return curve


def read_columns(run: RunReader, wanted: Sequence[str] | None = None) -> dict[str, FloatArray]:
    """Read columns of the learning curve as the run wrote them.

    Args:
        run: the run.
        wanted: names of columns, which the file need not have; None: all that it has.

    Returns:
        (evaluations,) each, by name; NaN where the file has an empty field.

    Raises:
        InputError: the file is missing, too large, cut off, or holds what no run writes.
    """
    path = run.curve_file
    lines = as_table(run.read(path, LARGEST_CSV), path).splitlines()
    if lines and lines[0].count(",") >= _MOST_COLUMNS:
        raise InputError(f"{path}: has more than {_MOST_COLUMNS} columns; is it of another version?")
    try:
        header, *rows = list(csv.reader(lines)) or [[]]
    except csv.Error as error:
        raise InputError(f"{path}: is no CSV ({error})") from None
    if not rows:
        raise InputError(f"{path}: has no row")
    if missing := [name for name in REQUIRED if name not in header]:
        raise InputError(f"{path}: has no column {', '.join(missing)}; is it of another version?")
    curve = {name: np.empty(len(rows)) for name in (header if wanted is None else wanted) if name in header}
    places = [(name, header.index(name)) for name in curve]
    for index, row in enumerate(rows):
        line = index + 2
        if len(row) != len(header):
            raise InputError(f"{path}: line {line} has {len(row)} of {len(header)} columns, it was cut off")
        for name, place in places:
            text = row[place]
            try:
                value = float(text) if text or name != ONLINE else math.nan
            except ValueError:
                raise InputError(f"{path}: line {line}: {name}={text[:40]!r} is no number") from None
            if math.isnan(value) and name != ONLINE:
                raise InputError(
                    f"{path}: line {line}: {name} is NaN; the run diverged or the file was changed"
                )
            curve[name][index] = value
    if not np.isfinite(curve["step"]).all() or (np.diff(curve["step"]) <= 0).any():
        raise InputError(f"{path}: the steps do not rise from row to row")
    if curve["step"][0] != 0:
        raise InputError(f"{path}: does not begin at step 0, rows were taken out")
    if not np.isin(curve["certified"], (0, 1)).all():
        raise InputError(f"{path}: certified must be 0 or 1 in every row")
    return curve
