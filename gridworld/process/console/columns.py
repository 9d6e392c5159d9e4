"""Columns of text for the terminal."""

from __future__ import annotations

from collections.abc import Sequence


def aligned(rows: Sequence[Sequence[str]], columns: Sequence[str]) -> list[str]:
    """Align cells in columns that are at least a blank apart.

    Args:
        rows: the cells, as many in every row as there are `columns`.
        columns: for each, "<" to align left (words) or ">" to align right (numbers), and its least width,
            e.g. ">9". A column is as wide as its widest cell.

    Returns:
        A line for each row.
    """
    widths = [
        max([int(column[1:]), *(len(row[index]) for row in rows)]) for index, column in enumerate(columns)
    ]
    forms = [f"{column[0]}{width}" for column, width in zip(columns, widths, strict=True)]
    return [
        " ".join(format(cell, form) for cell, form in zip(row, forms, strict=True)).rstrip() for row in rows
    ]
