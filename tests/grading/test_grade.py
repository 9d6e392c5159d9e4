"""`gridworld grade` on a sheet of two exercises: what a notebook may do, and what it cannot gain by it."""

import json
from pathlib import Path

import pytest
from helpers.support import ROOT, script

from gridworld.grading.sheet import COURSE, grade

MARKING = """
from gridworld.grading import Work, WrongAnswerError, exercise

@exercise("1 one", points=1)
def one(work):
    if work.call("one") != "hidden":
        raise WrongAnswerError("`one` is wrong")
    return "right"

@exercise("2 two", points=2)
def two(work):
    if work.array("two", [1, 2], shape=()) != 3:
        raise WrongAnswerError("`two` is wrong")
    return "right"
"""
TWO = "def two(numbers):\n    return sum(numbers)"
SECRET = COURSE / "solutions" / "lab1_values.ipynb"
# What `one` does, and a part of the sentence that it gets.
HOSTILE = {
    "while True: pass": "`one` took more than 3 s",
    "import os; os._exit(0)": "`one` ended its process",
    "import sys; sys.exit(0)": "raised SystemExit",
    "return bytearray(2**40)": "raised MemoryError",
    "print('x' * 10**8); return 1": "is wrong",
    "return 'x' * 10**8": "gave an answer other than",
    "return float('nan')": "gave an answer other than",
    "return object()": "is not JSON serializable",
    "return one()": "RecursionError",
    f"return open({str(SECRET)!r}).read()": "PermissionError",
    f"import os; return os.listdir({str(SECRET.parent)!r})": "PermissionError",
    "import gridworld": "ImportError: gridworld cannot be imported",
    "import sys; sys.addaudithook = None; import gridworld": "ImportError",
    f"return open({str(ROOT / 'gridworld' / '__init__.py')!r}).read()": "PermissionError",
    "import os; os.kill(os.getppid(), 9)": "PermissionError",
    "import os; os.fork()": "no processes",
    "import subprocess; subprocess.run(['true'])": "no processes",
    "import ctypes; ctypes.CDLL(None).fork()": "no processes and native functions",
    "import os; open(f'/proc/{os.getppid()}/environ')": "PermissionError",
    "open('/tmp/gridworld-grade', 'w')": "PermissionError",
    "import socket; socket.create_connection(('127.0.0.1', 9))": "PermissionError",
    "import os\n    for n in range(99):\n        try: os.write(n, b'{}' + bytes([10]))\n"
    "        except OSError: pass\n    return 1": "`one`",
    "raise ValueError('\\x1b[1m' + 'x' * 10**6)": "raised ValueError: \x1b[1mxxx",
    "raise NotImplementedError": "is not done yet",
}


def notebook(folder: Path, *cells: str) -> Path:
    (folder / "marking").mkdir(exist_ok=True)
    (folder / "marking" / "sheet.py").write_text(MARKING)
    path = folder / "mine.ipynb"
    path.write_text(json.dumps({"cells": [{"cell_type": "code", "source": each} for each in cells]}))
    return path


def marked(folder: Path, *cells: str) -> tuple[list[int], str, list[str]]:
    """The points of the exercises, the first one's sentence, and the notes."""
    results = list(grade(folder / "sheet.ipynb", notebook(folder, *cells), 3, 2 * 2**30))
    rows = [each for each in results if not isinstance(each, str)]
    notes = [each for each in results if isinstance(each, str)]
    return [points for _, points, _ in rows], rows[0][2], notes


def test_what_a_function_does_costs_its_own_points(tmp_path: Path) -> None:
    if any("Landlock" in note for note in marked(tmp_path, TWO)[2]):
        pytest.skip("this system has no Landlock")
    for body, words in HOSTILE.items():
        points, sentence, notes = marked(tmp_path, TWO, f"def one():\n    {body}")
        assert (points, notes) == ([0, 2], []), body
        assert words in sentence, sentence
        assert len(sentence) < 400


def test_a_cell_that_fails_is_named_and_costs_no_others(tmp_path: Path) -> None:
    right = "def one():\n    return 'hidden'"
    cells = ("1 / 0", "while True: pass", TWO, "%matplotlib inline\n!true\nx = 1", right, "# not graded\nx.y")
    points, _, notes = marked(tmp_path, *cells)
    assert points == [1, 2]
    assert notes == [
        "code cell 1 raised ZeroDivisionError: division by zero",
        "code cell 2 took more than 3 s",
    ]
    exits = "import os; os._exit(0)"
    points, sentence, notes = marked(tmp_path, TWO, exits, exits, exits, right)
    assert (points, sentence) == ([0, 2], "`one` is not in the notebook")
    assert notes[-1] == "code cell 5 was not run, since others had to be stopped"


def test_the_command(tmp_path: Path) -> None:
    mine = notebook(tmp_path, TWO)
    done = script("grade.py", "sheet.ipynb", str(mine), cwd=tmp_path)
    assert (done.returncode, done.stderr) == (1, "")
    one, two, total = done.stdout.splitlines()
    assert one.split(maxsplit=3) == ["1", "one", "0/1", "`one` is not in the notebook"]
    assert two.split() == ["2", "two", "2/2", "right"]
    assert total == "total: 2 of 3 points"
    notebook(tmp_path, TWO, "def one():\n    return 'hidden'")
    assert script("grade.py", "sheet.ipynb", str(mine), cwd=tmp_path).returncode == 0
    for words, told in (
        (["5", "mine.ipynb"], "error: 5: not a lab sheet; must be from 1 to "),
        (["other.ipynb", "mine.ipynb"], "other.py: missing; the marking of other.ipynb must be in this file"),
        (["sheet.ipynb", "no.ipynb"], "has no no.ipynb"),
        (["sheet.ipynb", "marking/sheet.py"], "is not JSON"),
    ):
        done = script("grade.py", *words, cwd=tmp_path)
        assert (done.returncode, done.stdout) == (2, "")
        assert told in done.stderr
    (tmp_path / "marking" / "sheet.py").write_text("1 / 0")
    done = script("grade.py", "sheet.ipynb", "mine.ipynb", cwd=tmp_path)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "sheet.py: cannot be run (ZeroDivisionError: division by zero)" in done.stderr
