"""`grade.py` of the course on a sheet of two exercises: what notebooks may do, and its time."""

import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from grading.sheet import grade, read_sheet
from grading.work import Work, WrongAnswerError
from helpers.support import ROOT

MARKING = """
from grading import Work, WrongAnswerError, exercise

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
# What `one` does, and a part of the sentence that it gets.
HOSTILE = {
    "while True: pass": "`one` took more than 1 s",
    "import os; os._exit(0)": "`one` ended its process",
    "import sys; sys.exit(0)": "raised SystemExit",
    "return bytearray(2**40)": "raised MemoryError",
    "print('x' * 10**8); return 1": "is wrong",
    "return 'x' * 10**8": "gave an answer other than",
    "return float('nan')": "gave an answer other than",
    "return object()": "is not JSON serializable",
    "return one()": "RecursionError",
    "import os\n    while True: os.write(3, b'{}' + bytes([10]))": "`one` took more than 1 s",
    "import os\n    if not os.fork(): os.setsid()\n"
    "    while True: os.write(3, b'{}' + bytes([10]))": "`one` took more than 1 s",
    "import os, time\n    while True: os.write(3, b' '); time.sleep(0.1)": "`one` took more than 1 s",
    "import os; os.kill(os.getpid(), 19)": "`one` took more than 1 s",  # SIGSTOP
    "import os, time; os.closerange(0, 99); time.sleep(99)": "`one` ended its process",
    "import os; os.fork()": "is wrong",
    "import subprocess; subprocess.Popen(['sleep', '99'], pass_fds=[3])": "is wrong",
    "import os\n    for n in range(2000): os.mkdir('x'); os.chdir('x')": "is wrong",
    "import os\n    for n in range(99):\n        try: os.write(n, b'{}' + bytes([10]))\n"
    "        except OSError: pass\n    return 1": "`one`",
    "raise ValueError('\\x1b[1m' + 'x' * 10**6)": "raised ValueError: \x1b[1mxxx",
    "raise NotImplementedError": "is not done yet",
}
# Answers that are no array (2, 2) of finite numbers, whatever NumPy would make of them.
NO_NUMBERS = (
    "'nan'",
    "['nan'] * 2",
    "[['nan'] * 2] * 2",
    "[['1', '0']] * 2",
    "[[1, '0']] * 2",
    "[[float('nan')] * 2] * 2",
    "[[float('inf')] * 2] * 2",
    "[[1e400] * 2] * 2",
    "[[10**400] * 2] * 2",
    "[[None] * 2] * 2",
    "[[1j] * 2] * 2",
    "[{'a': 1}] * 2",
    "None",
    "{}",
    "''",
    "True",
    "[]",
    "[1] * 4",
    "[[1], [1, 2]]",
    "[[[1] * 2] * 2]",
    "np.full((2, 2), np.nan)",
    "np.full((2, 2), -np.inf)",
    "np.full((2, 2), 1j)",
    "np.full((2, 2), 'nan')",
    "np.full((2, 2), None)",
    "np.full((2, 2), np.datetime64('nat'))",
    "np.ma.masked_all((2, 2))",
)


def grade_py(*words: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(ROOT / "docs" / "course" / "grade.py"), *words]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=120)


def notebook(folder: Path, *cells: str) -> Path:
    (folder / "marking").mkdir(exist_ok=True)
    (folder / "marking" / "sheet.py").write_text(MARKING)
    path = folder / "mine.ipynb"
    path.write_text(json.dumps({"cells": [{"cell_type": "code", "source": each} for each in cells]}))
    return path


def marked(folder: Path, *cells: str, seconds: int = 3) -> tuple[list[int], str, list[str]]:
    """The points of the exercises, the first one's sentence, and the notes."""
    mine = notebook(folder, *cells)
    results = list(grade(read_sheet(folder / "sheet.ipynb"), mine, seconds, 2 * 2**30))
    rows = [each for each in results if not isinstance(each, str)]
    notes = [each for each in results if isinstance(each, str)]
    return [points for _, points, _ in rows], rows[0][2], notes


@pytest.mark.slow
def test_what_a_function_does_costs_its_own_points(tmp_path: Path) -> None:
    for body, words in HOSTILE.items():
        started = time.monotonic()
        points, sentence, notes = marked(
            tmp_path, TWO, f"def one():\n    {body}", seconds=1 if "took" in words else 10
        )
        assert (points, notes) == ([0, 2], []), body
        assert words in sentence, sentence
        assert len(sentence) < 400
        assert time.monotonic() - started < 15, body


def test_only_finite_numbers_of_the_right_shape_are_numbers() -> None:
    with Work({1: "import numpy as np\ndef answer(source): return eval(source)"}, 20, 2 * 2**30) as work:
        for source in (
            "np.eye(2)",
            "[[1, 0], [0, 1]]",
            "np.eye(2, dtype=bool)",
            "[[Fraction(1), 0], (0, 1)]",
        ):
            work.begin()
            work.run("from fractions import Fraction")
            assert work.array("answer", source, shape=(2, 2)).tolist() == [[1, 0], [0, 1]]
        for source in NO_NUMBERS:
            work.begin()
            with pytest.raises(WrongAnswerError):
                pytest.fail(f"{source}: {work.array('answer', source, shape=(2, 2))}")


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
    done = grade_py("sheet.ipynb", str(mine), cwd=tmp_path)
    assert (done.returncode, done.stderr) == (1, "")
    one, two, total = done.stdout.splitlines()
    assert one.split(maxsplit=3) == ["1", "one", "0/1", "`one` is not in the notebook"]
    assert two.split() == ["2", "two", "2/2", "right"]
    assert total == "total: 2 of 3 points"
    notebook(tmp_path, TWO, "def one():\n    return 'hidden'")
    assert grade_py("sheet.ipynb", str(mine), cwd=tmp_path).returncode == 0


def test_what_cannot_be_marked_is_refused(tmp_path: Path) -> None:
    notebook(tmp_path, TWO)
    (tmp_path / "empty").mkdir()
    (tmp_path / "other.ipynb").write_text("{}")

    def refused(*words: str) -> str:
        done = grade_py(*words, cwd=tmp_path)
        assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
        return done.stderr

    for words, sentence in (
        (["0", "mine.ipynb"], "error: 0: not a lab sheet; must be from 1 to 4"),
        (["sheet.py", "mine.ipynb"], "error: sheet.py: not a notebook; give a shipped sheet's number"),
        (["nothing.ipynb", "mine.ipynb"], "error: nothing.ipynb: no such file"),
        (["other.ipynb", "mine.ipynb"], "other.py: missing; the marking of other.ipynb must be in this file"),
        (["sheet.ipynb", "mine.ipynb", "nothing.ipynb"], "error: nothing.ipynb: no such file"),
        (["sheet.ipynb", "marking/sheet.py"], "error: marking/sheet.py: not a notebook"),
        (["sheet.ipynb", "empty"], "error: empty: has no notebook"),
        (["sheet.ipynb", "mine.ipynb", "--seconds", "0"], "argument --seconds: 0: must be at least 1"),
    ):
        assert sentence in refused(*words)
    (tmp_path / "hidden").mkdir()
    (tmp_path / "hidden" / "sheet.json").write_text('{"answers": 1}')
    (tmp_path / "marking" / "sheet.py").write_text(f'{MARKING}PUBLIC = {{"answer": 1}}')
    assert "sheet.json: must have the keys of PUBLIC in marking/sheet.py: answer" in refused(
        "sheet.ipynb", "mine.ipynb"
    )
    (tmp_path / "marking" / "sheet.py").write_text("1 / 0")
    sentence = "sheet.py: cannot be run (ZeroDivisionError: division by zero)"
    assert sentence in refused("sheet.ipynb", "mine.ipynb")


def test_a_class_is_marked_at_once(tmp_path: Path) -> None:
    right = "def one():\n    return 'hidden'"
    for student, cells in {
        "ada": (TWO, right),
        "ben/homework": (TWO,),
        ".ipynb_checkpoints/ada-checkpoint": (),
        "=1+1": (TWO, 5),
    }.items():
        made = notebook(tmp_path, *cells)  # type: ignore[arg-type]
        (tmp_path / "class" / student).parent.mkdir(parents=True, exist_ok=True)
        made.rename(tmp_path / "class" / f"{student}.ipynb")
    (tmp_path / "class" / "cut.ipynb").write_text('{"cells": [')
    done = grade_py("sheet.ipynb", "class", "class/ada.ipynb", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (1, "")
    *table, written = done.stdout.splitlines()
    assert [line.split() for line in table] == [
        ["1", "2", "total"],
        ["=1+1", "0", "0", "0"],
        ["ada", "1", "2", "3"],
        ["ben/homework", "0", "2", "2"],
        ["cut", "0", "0", "0"],
        ["of", "1", "2", "3"],
    ]
    assert len({len(line) for line in table}) == 1
    assert written == "written: marked/sheet/points.csv and marked/sheet/feedback/"
    assert (tmp_path / "marked" / "sheet" / "points.csv").read_text() == (
        "student,1 one,2 two,total,of\n'=1+1,0,0,0,3\nada,1,2,3,3\nben/homework,0,2,2,3\ncut,0,0,0,3\n"
    )
    feedback = tmp_path / "marked" / "sheet" / "feedback"
    files = sorted(str(path.relative_to(feedback)) for path in feedback.rglob("*.txt"))
    assert files == ["=1+1.txt", "ada.txt", "ben/homework.txt", "cut.txt"]
    text = (feedback / "ben" / "homework.txt").read_text()
    assert text.splitlines()[-1] == "total: 2 of 3 points"
    assert "0/1  `one` is not in the notebook" in text
    assert "has a code cell whose source is not text" in (feedback / "=1+1.txt").read_text()
    assert "is not JSON" in (feedback / "cut.txt").read_text()


def test_hidden_values_replace_the_public_ones(tmp_path: Path) -> None:
    mine = notebook(tmp_path, "def one():\n    return 'shown'", TWO)
    marking = MARKING.replace('"hidden"', 'PUBLIC["answer"]') + 'PUBLIC = {"answer": "shown"}'
    (tmp_path / "marking" / "sheet.py").write_text(marking)
    done = grade_py("sheet.ipynb", str(mine), "--to", "here", cwd=tmp_path)
    assert done.returncode == 0
    assert done.stderr.startswith("marked on what the sheet shows, since hidden/sheet.json is missing")
    assert (tmp_path / "here" / "points.csv").read_text().splitlines()[1] == "mine,1,2,3,3"
    (tmp_path / "hidden").mkdir()
    (tmp_path / "hidden" / "sheet.json").write_text('{"answer": "hidden"}')
    done = grade_py("sheet.ipynb", str(mine), cwd=tmp_path)
    assert (done.returncode, done.stderr) == (1, "")
    assert "0/1  `one` is wrong" in done.stdout


def test_gradescope_reads_the_results(tmp_path: Path) -> None:
    """`run_autograder` in folders as Gradescope's."""
    course, source = ROOT / "docs" / "course", tmp_path / "source"
    for folder in ("grading", "marking"):
        shutil.copytree(course / folder, source / folder)
    shutil.copy(course / "grade.py", source)
    (source / "marking" / "sheet.py").write_text(MARKING)
    script = (course / "run_autograder").read_text()
    assert "sheet=1 " in script
    (tmp_path / "run_autograder").write_text(script.replace("sheet=1 ", "sheet=source/sheet.ipynb "))
    for name in ("results", "submission"):
        (tmp_path / name).mkdir()

    def results() -> dict[str, Any]:
        path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
        command = ["bash", str(tmp_path / "run_autograder")]
        subprocess.run(command, env={**os.environ, "PATH": path}, check=True, timeout=120, cwd="/")
        return json.loads((tmp_path / "results" / "results.json").read_text())

    assert results() == {"score": 0, "output": "submission: has no notebook (.ipynb)"}
    notebook(tmp_path, TWO, "1 / 0").rename(tmp_path / "submission" / "mine.ipynb")
    one = {"number": "1", "name": "one", "score": 0, "max_score": 1, "status": "failed"}
    two = {"number": "2", "name": "two", "score": 2, "max_score": 2, "status": "passed", "output": "right"}
    assert results() == {
        "output": "code cell 2 raised ZeroDivisionError: division by zero",
        "tests": [{**one, "output": "`one` is not in the notebook"}, two],
    }
    (tmp_path / "submission" / "second.ipynb").write_text("{}")
    assert results() == {"score": 0, "output": "2 notebooks were submitted, must be one: mine, second"}
