"""No cell of a CSV file is a formula, and a text is read as it was written."""

import csv
import dataclasses
import io
import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gridworld.base.console import plain
from gridworld.base.safe_read import csv_rows, csv_text
from gridworld.report.tables import Table, to_csv
from gridworld.sweeps.folder import JobRow, SweepFolder

FORMULA = re.compile(r"[=+\-@\t\r\n]")
TEXTS = st.text(st.sampled_from("=+-@\t\r\n',;\"a1. "), max_size=6)


def is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


@given(st.lists(st.lists(TEXTS, min_size=1, max_size=3), max_size=3))
def test_every_printable_text_is_read_as_it_was_written_and_none_is_a_formula(rows: list[list[str]]) -> None:
    text = csv_text(rows)
    assert list(csv_rows(text)) == [[plain(cell) for cell in row] for row in rows]
    for row in csv.reader(io.StringIO(text)):
        assert all(is_number(cell) or not FORMULA.match(cell) for cell in row)


@pytest.mark.parametrize("number", [-3, -2.5e-7, "-2.5e-07", "-0.125", "+4", -0.0])
def test_numbers_stay_numbers(number: float | str) -> None:
    assert csv_text([[number]]) == f"{number}\n"


def test_tables_of_reports_and_of_sweeps_have_no_formulas(tmp_path: Path) -> None:
    name = '@SUM(1+1)*cmd|" /C calc"!A0'
    table = to_csv(Table("runs", "", ["-x", "n"], [[name, -1.5], ["\tq", None]]))
    assert list(csv.reader(io.StringIO(table))) == [["'-x", "n"], [f"'{name}", "-1.5"], ["\\tq", ""]]
    row = JobRow(name, "", "failed", objective="-0.25", error="-> it broke")
    SweepFolder(tmp_path).write({name: row})
    written = (tmp_path / "jobs.csv").read_text()
    assert ",'-> it broke" in written
    assert list(csv_rows(written))[1] == list(dataclasses.astuple(row))
