"""A run's files, read within bounds. Raises `InputError` with a sentence for whatever is wrong with one."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from gridworld.errors import InputError
from gridworld.mdp import FloatArray

_LARGEST_JSON = 4 * 2**20  # bytes
_LARGEST_CSV = 64 * 2**20

REQUIRED = ("step", "value", "regret", "certified", "goal_probability", "return")
SAMPLED_RETURN = "sampled_return"
ONLINE = "online_return"  # undiscounted, of the training episodes ended since the row before; may be empty
_OPTIONAL = (SAMPLED_RETURN, ONLINE)


def read_object(path: Path) -> dict[str, Any]:
    """A JSON object."""
    text = bounded_text(path, _LARGEST_JSON)
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: is no JSON, it was changed or cut off ({error})") from None
    if not isinstance(content, dict):
        raise InputError(f"{path}: holds no JSON object")
    return content


def bounded_text(path: Path, most: int = _LARGEST_CSV) -> str:
    """A file's text."""
    try:
        if not path.is_file():
            raise InputError(f"{path.parent}: has no {path.name}")
        if path.stat().st_size > most:
            raise InputError(f"{path}: is larger than {most / 2**20:.0f} MiB")
        return path.read_text("utf-8")
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: cannot be read, it is no UTF-8 text") from None


def read_curve(path: Path) -> dict[str, FloatArray]:
    """The columns of a learning curve that are needed, (evaluations,) each."""
    lines = bounded_text(path, _LARGEST_CSV).splitlines()
    try:
        rows = list(csv.reader(lines))
    except csv.Error as error:
        raise InputError(f"{path}: is no CSV ({error})") from None
    if len(rows) < 2:
        raise InputError(f"{path}: has no row")
    header = rows[0]
    if missing := [name for name in REQUIRED if name not in header]:
        raise InputError(f"{path}: has no column {', '.join(missing)}; is it of another version?")
    for number, row in enumerate(rows[1:], start=2):
        if len(row) != len(header):
            raise InputError(f"{path}: line {number} has {len(row)} of {len(header)} columns, it was cut off")
    curve = {
        name: _column(path, name, header, rows[1:]) for name in (*REQUIRED, *_OPTIONAL) if name in header
    }
    if not np.isfinite(curve["step"]).all() or (np.diff(curve["step"]) <= 0).any():
        raise InputError(f"{path}: the steps do not rise from row to row")
    if curve["step"][0] != 0:
        raise InputError(f"{path}: does not begin at step 0, rows were taken out")
    if not np.isin(curve["certified"], (0, 1)).all():
        raise InputError(f"{path}: certified must be 0 or 1 in every row")
    curve["regret"] = np.maximum(0.0, curve["regret"])  # below zero is rounding
    return curve


def _column(path: Path, name: str, header: list[str], rows: list[list[str]]) -> FloatArray:
    index = header.index(name)
    values = np.empty(len(rows))
    for number, row in enumerate(rows):
        text = row[index]
        try:
            value = float(text) if text or name != ONLINE else math.nan
        except ValueError:
            raise InputError(f"{path}: line {number + 2}: {name}={text[:40]!r} is no number") from None
        if math.isnan(value) and name != ONLINE:
            raise InputError(
                f"{path}: line {number + 2}: {name} is NaN; the run diverged or the file was changed"
            )
        values[number] = value
    return values
