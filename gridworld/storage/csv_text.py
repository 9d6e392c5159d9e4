"""Text of CSV files: a row is a line, and no cell is a formula to a spreadsheet.

Control characters are escaped. A text that begins as a formula does, and is no number, is written behind an
apostrophe, as spreadsheets do it themselves, and read without.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable, Iterator

from gridworld.process.console import plain

_FORMULA = re.compile(r"'*[=+\-@\uff1d\uff0b\uff0d\uff20]")  # the last four are as wide as Chinese signs


def csv_text(rows: Iterable[Iterable[object]]) -> str:
    """Rows of cells as the text of a file, a line each."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(map(_cell, row) for row in rows)
    return text.getvalue()


def csv_rows(text: str) -> Iterator[list[str]]:
    """The rows that `csv_text` was given. Raises `csv.Error`."""
    for row in csv.reader(io.StringIO(text)):
        yield [cell[cell.startswith("'") and _FORMULA.match(cell) is not None :] for cell in row]


def _cell(value: object) -> object:
    if not isinstance(value, str):
        return value
    text = plain(value)
    try:
        float(text)
    except ValueError:
        return f"'{text}" if _FORMULA.match(text) else text
    return text
