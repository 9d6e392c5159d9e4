"""Tables, written as Markdown to be read and as CSV to be computed with; the page writes them as HTML."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from gridworld.process.console import plain
from gridworld.report.statistics import Interval, Share
from gridworld.storage.csv_text import csv_text

NOTHING = "\N{EN DASH}"
_MINUS = "\N{MINUS SIGN}"
# Signs with which a name out of a run's folder could be HTML, a link, a row, or the end of a marked place.
_MARKS = re.compile(r"""[\\|<>&`\[\]*!\n\r]|:(?=//)|(?<=www)\.""")


@dataclass(frozen=True)
class Estimate:
    """An interval with the way its numbers are written."""

    interval: Interval
    form: Callable[[float], str]


Cell = str | float | int | None | Share | Estimate


@dataclass(frozen=True)
class Table:
    """A table whose texts are plain: control characters in names of strangers' runs are escaped."""

    name: str  # of its files
    caption: str
    columns: Sequence[str]  # the headings
    rows: Sequence[Sequence[Cell]]  # a cell for each column

    def __post_init__(self) -> None:
        rows = [[plain(cell) if isinstance(cell, str) else cell for cell in row] for row in self.rows]
        object.__setattr__(self, "caption", plain(self.caption))
        object.__setattr__(self, "columns", list(map(plain, self.columns)))
        object.__setattr__(self, "rows", rows)


def number(value: float) -> str:
    """Write a number with four digits, an infinite one as ∞, NaN as a dash."""
    if math.isnan(value):
        return NOTHING
    if math.isinf(value):
        return "∞" if value > 0 else f"{_MINUS}∞"
    if value == 0:
        return "0"
    text = f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}" if abs(value) >= 1e-4 else f"{value:.1e}"
    return text.replace("-", _MINUS)


def steps_up_to(bound: float) -> Callable[[float], str]:
    """How to write a number of steps: an infinite one as more than `bound`, the steps that were given."""
    return lambda value: f"> {bound:,.0f}" if math.isinf(value) else number(round(value))


def main_text(cell: Cell) -> str:
    """The cell without its interval."""
    match cell:
        case None:
            return NOTHING
        case str():
            return cell
        case Share(count, total, _, _):
            return f"{count} / {total}"
        case Estimate(interval, form):
            return form(interval.point)
        case int():
            return f"{cell:,}"
        case float():
            return number(cell)


def interval_text(cell: Cell) -> str:
    """The interval of a cell, or nothing."""
    match cell:
        case Share(_, _, low, high):
            return f"[{100 * low:.0f} %, {100 * high:.0f} %]"
        case Estimate(interval, form) if not math.isnan(interval.low):
            return f"[{form(interval.low)}, {form(interval.high)}]"
        case _:
            return ""


def is_text(table: Table, column: int) -> bool:
    """Whether a column holds words, which are aligned to the left; numbers are aligned to the right."""
    return bool(table.rows) and all(isinstance(row[column], str) for row in table.rows)


def to_captioned_markdown(table: Table) -> str:
    """A Markdown pipe table below its caption."""
    return f"{_plain_markdown(table.caption)}\n\n{to_markdown(table)}"


def to_markdown(table: Table) -> str:
    """A Markdown pipe table; names in it are shown as they are."""

    def text(cell: Cell) -> str:
        if isinstance(cell, str):
            return _plain_markdown(cell)
        return f"{main_text(cell)} {interval_text(cell)}".strip()

    sides = ("---" if is_text(table, column) else "---:" for column in range(len(table.columns)))
    rows: list[Iterable[str]] = [map(_plain_markdown, table.columns), sides]
    rows += [map(text, row) for row in table.rows]
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)


def _plain_markdown(text: str) -> str:
    """Text that may be anybody's, so that it is shown as it is."""
    return _MARKS.sub(lambda found: f"&#{ord(found[0])};", text)


def to_csv(table: Table) -> str:
    """A CSV of plain numbers; an interval takes three columns, a share four."""
    suffixes = []  # of each column's headings
    for index in range(len(table.columns)):
        kinds = {type(row[index]) for row in table.rows}
        is_share, is_estimate = Share in kinds, Estimate in kinds
        suffixes.append(
            ("", " of", " low", " high") if is_share else ("", " low", " high") if is_estimate else ("",)
        )
    rows: list[list[object]] = [
        [head + suffix for head, own in zip(table.columns, suffixes, strict=True) for suffix in own]
    ]
    for row in table.rows:
        rows.append([])
        for cell, own in zip(row, suffixes, strict=True):
            match cell:
                case Estimate(interval, _):
                    rows[-1] += map(_digits, (interval.point, interval.low, interval.high))
                case Share(count, total, low, high):
                    rows[-1] += (count, total, _digits(low), _digits(high))
                case None:
                    rows[-1] += [""] * len(own)
                case _:
                    rows[-1].append(_digits(cell) if isinstance(cell, float) else cell)
    return csv_text(rows)


def _digits(value: float) -> str:
    return "" if math.isnan(value) else f"{value:.10g}"
