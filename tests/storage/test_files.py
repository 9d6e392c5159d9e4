"""Files come back as written: CSV without formulas, a state to the last bit; nothing is left half written."""

import csv
import dataclasses
import io
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.resuming import differences
from hypothesis import given
from hypothesis import strategies as st

from gridworld.base.atomic_write import tidy
from gridworld.base.console import plain
from gridworld.base.safe_read import csv_rows, csv_text
from gridworld.base.serialization import decode, encode
from gridworld.report.tables import Table, to_csv
from gridworld.sweeps.folder import JobRow, SweepFolder

FORMULA = re.compile(r"[=+\-@\t\r\n]")
NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)")
TEXTS = st.text(st.sampled_from("=+-@\t\r\n',;\"a1. "), max_size=6)


@given(st.lists(st.lists(TEXTS, min_size=1, max_size=3), max_size=3))
def test_every_printable_text_is_read_as_it_was_written_and_none_is_a_formula(rows: list[list[str]]) -> None:
    text = csv_text(rows)
    assert list(csv_rows(text)) == [[plain(cell) for cell in row] for row in rows]
    for row in csv.reader(io.StringIO(text)):
        assert all(NUMBER.fullmatch(cell.strip()) or not FORMULA.match(cell) for cell in row)


def test_tables_of_reports_and_of_sweeps_have_no_formulas_and_their_numbers(tmp_path: Path) -> None:
    name = '@SUM(1+1)*cmd|" /C calc"!A0'
    table = to_csv(Table("runs", "", ["-x", "n"], [[name, -1.5], ["\tq", None]]))
    assert list(csv.reader(io.StringIO(table))) == [["'-x", "n"], [f"'{name}", "-1.5"], ["\\tq", ""]]
    row = JobRow(name, "", "failed", objective="-0.25", error="-> it broke")
    SweepFolder(tmp_path).write({name: row})
    written = (tmp_path / "jobs.csv").read_text()
    assert ",'-> it broke" in written
    assert list(csv_rows(written))[1] == list(dataclasses.astuple(row))
    assert csv_text([[-3, -2.5e-7, "-2.5e-07", "+4", -0.0]]) == "-3,-2.5e-07,-2.5e-07,+4,-0.0\n"


def test_a_packed_state_comes_back() -> None:
    noise = np.random.default_rng(0)
    state = {
        "weights": noise.standard_normal(50_000),
        "counts": np.arange(200_000) // 1000,
        "more": [noise.standard_normal(3), {"empty": np.zeros((2, 0)), "bytes": noise.bytes(8).hex()}],
        "late": noise.standard_normal(20_000).astype(np.float32),
    }
    packed = encode(state, compress=True)
    assert differences(decode(packed), state) == []
    assert len(packed) < 520_000  # the noise, and little of the rest
    assert len(encode(state)) > 2_000_000


@pytest.mark.parametrize(
    ("node", "sentence"),
    [
        ({1: 0}, "a state's keys are strings"),
        ({"@": 0}, "a state's keys are strings"),
        (np.array(["x"]), "arrays of <U1 are not part of a state"),
        ((1, 2), "a tuple is not part of a state"),
    ],
)
def test_what_is_no_part_of_a_state_is_named_by_its_place(node: object, sentence: str) -> None:
    with pytest.raises(TypeError, match=rf"state\.a\[1\]\.b: {sentence}"):
        encode({"a": [0, {"b": node}]})


_WRITES = """
import os, sys
from pathlib import Path
from gridworld.base.atomic_write import replacing, replacing_folder
end, name = sys.argv[1:]
with (replacing if "." in name else replacing_folder)(Path(name)) as part:
    (part if "." in name else part / "events").write_text("half")
    print("half", flush=True)
    sys.stdin.read() if end == "waits" else os.kill(os.getpid(), 9)
"""


@pytest.mark.parametrize("name", ["film.apng", "answers"])
def test_what_killed_writers_left_is_removed_and_nothing_else(name: str, tmp_path: Path) -> None:
    def writer(end: str) -> subprocess.Popen[str]:
        """A process that is in the middle of a write."""
        words = [sys.executable, "-c", _WRITES, end, name]
        process = subprocess.Popen(words, cwd=tmp_path, stdin=-1, stdout=-1, text=True)
        assert process.stdout is not None
        assert process.stdout.readline() == "half\n"
        return process

    def names() -> list[str]:
        return sorted(path.name for path in tmp_path.iterdir())

    for _ in range(2):
        killed = writer("dies")
        killed.communicate(timeout=180)
        assert killed.returncode == -9
    (tmp_path / ".film.9.part.txt").touch()  # none of ours
    living = writer("waits")
    assert len(names()) == 4 if "." in name else 2  # a new folder has removed what it found
    tidy(tmp_path)
    assert names() == sorted([".film.9.part.txt", f".{name}.{living.pid}.part"])
    living.communicate("")
    assert living.returncode == 0
    assert names() == sorted([".film.9.part.txt", name])
