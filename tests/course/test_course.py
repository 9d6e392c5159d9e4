"""The sheets of docs/course: the solution has all points, and wrong ones lose those of what is wrong."""

import json
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest
from grading.sheet import COURSE, NOT_GRADED, find_sheet, grade, read_cells, read_sheet
from helpers.support import ROOT

import gridworld

SHEETS = {path.stem: path for path in sorted(COURSE.glob("*.ipynb"))}
# By sheet: what is replaced in its solution, and the exercises that this costs.
WRONG: dict[str, list[tuple[str, str, str]]] = {
    "lab1_values": [
        ("990 / 1889", "991 / 1889", "1.1"),
        ("accuracy * (1 - gamma) / gamma", "accuracy", "1.4"),
        ("return q >= q.max(axis=1, keepdims=True) - 1e-9", "return np.eye(4)[q.argmax(axis=1)]", "1.5"),
    ],
    "lab2_cliff": [
        ("0.0 if terminated else q[state, action]", "0.0 if terminated else q[state].max()", "2.3 2.5"),
        (
            "best = q == q.max(axis=1, keepdims=True)",
            "best = np.eye(q.shape[1])[q.argmax(axis=1)]",
            "2.1 2.6",
        ),
        ("(0.0 if terminated else q[state].max())", "q[state].max()", "2.2"),
        ("total + reward", "total + gamma * reward", "2.4 2.5"),
        ("q[state, action] += alpha * (target - q[state, action])", "q[state, action] = target", "2.4 2.5"),
    ],
    "lab3_standing_still": [
        ('"sarsa": "epsilon"', '"sarsa": "exploration"', "3.6"),
        ("np.where(world.terminal, 0.0, d)", "d", "3.3"),
        ("visits(world, policy, gamma)[:, None] * policy * adv", "policy * adv", "3.4"),
        ('"total_timesteps": 180_000', '"total_timesteps": 8_192', "3.7"),
    ],
    "lab4_planted_bug": [
        ("reward, following, terminated)\n", "reward, following, terminated or truncated)\n", "4.2 4.5 4.6"),
        ("    updates[state, action] += 1\n", "    updates[state, action] = 1\n", "4.3 4.5 4.6"),
        ('"stochastic", "trap", ', '"stochastic", ', "4.1"),
        ("return train(NeverTerminated(env),", "return train(env,", "4.6"),
    ],
}
NOTHING = """
import numbers
import numpy as np

def emptied(found):
    if isinstance(found, dict):
        return {name: emptied(each) for name, each in found.items()}
    if isinstance(found, np.ndarray):
        return emptied(found.tolist())
    return [*map(emptied, found)] if isinstance(found, list | tuple) else VALUE

def emptying(function):
    return lambda *given, **named: emptied(function(*given, **named))

for name, found in list(globals().items()):
    if getattr(found, "__module__", "") == "__main__" and name not in ("emptied", "emptying"):
        globals()[name] = emptying(found)
    elif name.isupper():
        globals()[name] = emptied(found)
"""


@pytest.fixture(autouse=True)
def _trains_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a marking trains is the same for each solution."""
    monkeypatch.setattr(gridworld, "train", _train, raising=False)


@cache
def _train(*words: str, **settings: object) -> object:
    from gridworld.api.runs import train

    return train(*words, **settings)  # type: ignore[arg-type]


def points_lost(sheet: str, notebook: Path, course: Path = COURSE) -> dict[str, str]:
    """By the number of each exercise that has not all points: the sentence that says why."""
    results = list(grade(read_sheet(course / f"{sheet}.ipynb"), notebook, 120, 4 * 2**30))
    marked = [each for each in results if not isinstance(each, str)]
    assert [each for each in results if isinstance(each, str)] == []
    assert all(points in (0, exercise.points) for exercise, points, _ in marked)
    return {exercise.title.split()[0]: sentence for exercise, points, sentence in marked if not points}


def changed(sheet: str, old: str, new: str, folder: Path) -> Path:
    """A copy of the solution in which a text is replaced."""
    content = json.loads((COURSE / "solutions" / f"{sheet}.ipynb").read_text("utf-8"))
    found = 0
    for cell in content["cells"]:
        text = "".join(cell["source"])
        found += text.count(old) if cell["cell_type"] == "code" else 0
        cell["source"] = text.replace(old, new)
    assert found == 1
    notebook = folder / "mine.ipynb"
    notebook.write_text(json.dumps(content))
    return notebook


def test_every_sheet_is_tried() -> None:
    assert list(SHEETS) == list(WRONG)
    assert [find_sheet(str(number)) for number in range(1, len(SHEETS) + 1)] == list(SHEETS.values())


@pytest.mark.slow
@pytest.mark.parametrize("sheet", SHEETS)
def test_a_sheet_says_what_it_pays_and_has_no_answers(sheet: str) -> None:
    content = json.loads(SHEETS[sheet].read_text("utf-8"))
    assert len(json.dumps(content)) < 30_000
    assert not any(cell.get("outputs") for cell in content["cells"])
    text = "\n".join("".join(cell["source"]) for cell in content["cells"])
    assert "solutions/" not in text
    exercises = read_sheet(SHEETS[sheet]).exercises
    for each in exercises:
        assert each.title.split()[0] in text
        assert f"{each.points} points" in text
    lost = points_lost(sheet, SHEETS[sheet])
    assert len(lost) == len(exercises)
    assert any("is not done yet" in sentence for sentence in lost.values())


@pytest.mark.slow
@pytest.mark.parametrize("sheet", SHEETS)
def test_the_solution_has_all_points(sheet: str) -> None:
    assert points_lost(sheet, COURSE / "solutions" / f"{sheet}.ipynb") == {}


@pytest.mark.slow
@pytest.mark.parametrize("sheet", [path.stem for path in (COURSE / "hidden").iterdir()])
def test_students_check_themselves_without_the_hidden_part(sheet: str, tmp_path: Path) -> None:
    shutil.copytree(COURSE / "marking", tmp_path / "marking")
    solution, missing = COURSE / "solutions" / f"{sheet}.ipynb", tmp_path / "hidden" / f"{sheet}.json"
    assert points_lost(sheet, solution, tmp_path) == {}
    assert read_sheet(tmp_path / f"{sheet}.ipynb").missing == missing
    assert read_sheet(SHEETS[sheet]).missing is None
    for old, new, lost in WRONG[sheet]:
        assert list(points_lost(sheet, changed(sheet, old, new, tmp_path), tmp_path)) == lost.split()


@pytest.mark.slow
@pytest.mark.parametrize(("sheet", "old", "new", "lost"), [(s, *row) for s in SHEETS for row in WRONG[s]])
def test_a_wrong_answer_costs_its_own_points(
    sheet: str, old: str, new: str, lost: str, tmp_path: Path
) -> None:
    assert list(points_lost(sheet, changed(sheet, old, new, tmp_path))) == lost.split()


@pytest.mark.slow
@pytest.mark.parametrize("sheet", SHEETS)
@pytest.mark.parametrize("value", ["'nan'", "float('nan')", "1j", "None"])
def test_what_is_no_number_earns_no_points(sheet: str, value: str, tmp_path: Path) -> None:
    """Each function and variable of a solution gives its form, with something else in place of numbers."""
    content = json.loads((COURSE / "solutions" / f"{sheet}.ipynb").read_text("utf-8"))
    content["cells"].append({"cell_type": "code", "source": NOTHING.replace("VALUE", value)})
    (tmp_path / "mine.ipynb").write_text(json.dumps(content))
    assert len(points_lost(sheet, tmp_path / "mine.ipynb")) == len(read_sheet(SHEETS[sheet]).exercises)


@pytest.mark.slow
def test_a_right_answer_may_look_different(tmp_path: Path) -> None:
    """Other types, Jupyter's `display`, and a seed with which SARSA learns a bad policy."""
    fractions = "display(1)\nfrom fractions import Fraction\nVALUES_RIGHT = (Fraction(81, 100), 0.9, 1)"
    right = changed("lab1_values", "VALUES_RIGHT = [0.81, 0.9, 1.0]", fractions, tmp_path)
    assert points_lost("lab1_values", right) == {}
    unlucky = changed("lab2_cliff", 'if algorithm == "sarsa":', 'if algorithm == "sarsa" and seed:', tmp_path)
    assert points_lost("lab2_cliff", unlucky) == {}


@pytest.mark.parametrize("sheet", SHEETS)
@pytest.mark.slow
def test_what_a_student_looks_at_runs(sheet: str, tmp_path: Path) -> None:
    """The cells that are not graded, after the solution; the first two sheets need NumPy and no more."""
    solved = read_cells(COURSE / "solutions" / f"{sheet}.ipynb").values()
    content = json.loads(SHEETS[sheet].read_text("utf-8"))
    sources = ["".join(cell["source"]) for cell in content["cells"] if cell["cell_type"] == "code"]
    looked_at = [source for source in sources if source.startswith(NOT_GRADED)]
    heavy = ("torch", "stable_baselines3", "gymnasium", "hydra", "scipy", "pygame")
    not_in_browsers = ("resource", "pwd", "_multiprocessing")  # Pyodide lacks them
    missing = [*heavy, *not_in_browsers] if sheet in ("lab1_values", "lab2_cliff") else []
    without = f"sys.modules |= dict.fromkeys({missing})"
    (tmp_path / "sheet.py").write_text("\n".join(["import sys", without, *solved, *looked_at]))
    done = subprocess.run(
        [sys.executable, "sheet.py"],
        cwd=tmp_path,
        env={"PYTHONPATH": str(ROOT), "MPLBACKEND": "Agg", "HOME": str(tmp_path), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    assert len(looked_at) >= 3
