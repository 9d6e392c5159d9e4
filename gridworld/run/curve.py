"""The learning curve of a run, read as the run wrote it."""

from __future__ import annotations

import csv
from collections.abc import Sequence

import numpy as np

from gridworld.base.console import printable
from gridworld.base.errors import InputError
from gridworld.base.safe_read import LARGEST_CSV, as_table
from gridworld.run.reader import RunReader
from gridworld.world.mdp import FloatArray

REQUIRED = ("step", "value", "regret", "certified", "goal_probability", "return")  # columns
ONLINE = "online_return"  # undiscounted, of training episodes (`training.learning_curve`); may be empty
_MOST_COLUMNS = 100


def read_columns(run: RunReader, wanted: Sequence[str] | None = None) -> dict[str, FloatArray]:
    """Read columns (evaluations,) of the learning curve as the run wrote them, NaN where a field is empty.

    `wanted` are names of columns, which the file need not have; None: all that it has. Raises `InputError`
    where the file is missing, too large, cut off, or holds what no run writes.
    """
    path = run.curve_file
    lines = as_table(run.read(path, LARGEST_CSV), path).splitlines()
    if lines and lines[0].count(",") >= _MOST_COLUMNS:
        raise InputError(f"{path}: has more than {_MOST_COLUMNS} columns; was it written by another version?")
    try:
        header, *rows = list(csv.reader(lines)) or [[]]
    except csv.Error as error:
        raise InputError(f"{path}: is not valid CSV ({error})") from None
    if not rows:
        raise InputError(f"{path}: has no rows")
    if missing := [name for name in REQUIRED if name not in header]:
        raise InputError(f"{path}: has no column {', '.join(missing)}; was it written by another version?")
    for line, row in enumerate(rows, 2):
        if len(row) != len(header):
            raise InputError(f"{path}: line {line} has {len(row)} of {len(header)} columns; it was cut off")
    curve: dict[str, FloatArray] = {}
    for name in header if wanted is None else wanted:
        if name not in header:
            continue
        at = header.index(name)
        try:
            curve[name] = np.array([row[at] or "nan" for row in rows], dtype=np.float64)
        except ValueError as error:
            raise InputError(f"{path}: {name}: {printable(str(error))}") from None
        if name != ONLINE and np.isnan(curve[name]).any():
            raise InputError(f"{path}: {name} is NaN or empty; the run diverged or the file was changed")
    steps = curve["step"]
    if steps[0] != 0 or not np.isfinite(steps).all() or (np.diff(steps) <= 0).any():
        raise InputError(f"{path}: the steps do not increase from 0, row by row")
    if not np.isin(curve["certified"], (0, 1)).all():
        raise InputError(f"{path}: certified must be 0 or 1 in every row")
    return curve
