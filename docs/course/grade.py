"""Mark notebooks of a lab sheet: points and one sentence for each exercise, by exact ground truth.

Of several notebooks it prints a table, and writes points.csv and a file of feedback per student.
A notebook runs in a process of its own, with limits on time and memory and no others: mark the work of people
whom you do not trust in a container without the solutions.
Exit code: 0 if all notebooks have all points, 1 if not, 2 for a mistake on the command line.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

from gridworld.base.signals import listen

if __name__ == "__main__":
    listen()  # before what takes time to import

from grading.sheet import Marked, find_sheet, grade, read_sheet

from gridworld.base.console import aligned, printable, tell
from gridworld.base.errors import InputError
from gridworld.base.safe_read import csv_text
from gridworld.commands import parser_of, run, whole

_NOT_ALL = 1  # the exit code
_COLUMNS = ("<34", ">7", "<0")  # of one notebook's results
_EXAMPLE = "example: python docs/course/grade.py 1 submissions/ --to marked"


def main(words: Sequence[str]) -> None:
    """Mark each notebook, and print and write its results as soon as it is marked."""
    options = _parser().parse_args(words)
    sheet = read_sheet(find_sheet(options.sheet))
    try:
        notebooks = find_notebooks(options.notebooks)
        if options.gradescope and len(notebooks) > 1:
            raise InputError(
                f"{len(notebooks)} notebooks were submitted, must be one: {', '.join(notebooks)}"
            )
    except InputError as error:
        if options.gradescope:  # which shows the student why
            options.gradescope.write_text(json.dumps({"score": 0, "output": str(error)}))
        raise
    several = len(notebooks) > 1
    folder = options.to or (Path("marked", sheet.name) if several else None)
    numbers = [each.title.split()[0] for each in sheet.exercises]
    columns = [f"<{max(map(len, map(printable, notebooks)))}", *(f">{len(each)}" for each in numbers), ">5"]
    if folder:
        folder.mkdir(parents=True, exist_ok=True)
        titles = [each.title for each in sheet.exercises]
        (folder / "points.csv").write_text(csv_text([["student", *titles, "total", "of"]]), "utf-8")
    if several:
        print(*aligned([["", *numbers, "total"]], columns), flush=True)

    complete = True
    for student, notebook in notebooks.items():
        marked = grade(sheet, notebook, options.seconds, options.memory * 2**30)
        results, lines = _followed(marked, show=not several)
        points = [given for _, given, _ in results]
        complete &= sum(points) == sheet.points
        lines.append(f"total: {sum(points)} of {sheet.points} points")
        row = [printable(student), *map(str, points), str(sum(points))]
        print(*aligned([row], columns) if several else lines[-1:], flush=True)
        if folder:
            with (folder / "points.csv").open("a", encoding="utf-8") as file:
                file.write(csv_text([[student, *points, sum(points), sheet.points]]))
            feedback = folder / "feedback" / f"{student}.txt"
            feedback.parent.mkdir(parents=True, exist_ok=True)
            feedback.write_text("\n".join([printable(f"{sheet.name}, {student}"), "", *lines, ""]), "utf-8")
        if options.gradescope:
            notes = "\n".join(lines[: -len(results) - 1])
            options.gradescope.write_text(json.dumps(_for_gradescope(results, notes)))
    if several:
        row = ["of", *(str(each.points) for each in sheet.exercises), str(sheet.points)]
        print(*aligned([row], columns))
    if folder:
        print(printable(f"written: {folder}/points.csv and {folder}/feedback/"))
    if sheet.missing:
        tell(f"marked on what the sheet shows, since {sheet.missing} is missing; a lecturer may mark on more")
    if not complete:
        sys.exit(_NOT_ALL)


def find_notebooks(given: Sequence[Path]) -> dict[str, Path]:
    """Notebooks by their student: the path below the folder that all are in, without `.ipynb`."""
    found: dict[Path, Path] = {}  # by the whole path, the folder that names begin in
    for path in given:
        whole_path = Path(os.path.abspath(path))
        if path.is_dir():
            inside = sorted(whole_path.rglob("*.ipynb"))
            shown = [each for each in inside if not _is_hidden(each.relative_to(whole_path))]
            if not shown:
                raise InputError(f"{path}: has no notebook (.ipynb)")
            found |= {each: whole_path for each in shown if each not in found}
        elif not path.exists():
            raise InputError(f"{path}: no such file")
        elif path.suffix != ".ipynb":
            raise InputError(f"{path}: not a notebook; must be a file .ipynb, or a folder with such files")
        else:
            found.setdefault(whole_path, whole_path.parent)
    top = os.path.commonpath(found.values())
    return {str(path.relative_to(top).with_suffix("")): path for path in found}


def _followed(marked: Iterable[str | Marked], show: bool) -> tuple[list[Marked], list[str]]:
    """The results of a notebook, and a line for each note and each result, printed as they come if `show`."""
    results: list[Marked] = []
    lines: list[str] = []
    for each in marked:
        line = each
        if not isinstance(each, str):
            results.append(each)
            exercise, points, sentence = each
            [line] = aligned([[exercise.title, f"{points}/{exercise.points}", f" {sentence}"]], _COLUMNS)
        lines.append(printable(line))
        if show:
            print(lines[-1], flush=True)
    return results, lines


def _is_hidden(path: Path) -> bool:
    """Whether Jupyter or an archive of macOS has made it: `.ipynb_checkpoints`, `__MACOSX`."""
    return any(part.startswith((".", "__MACOSX")) for part in path.parts)


def _for_gradescope(results: Sequence[Marked], notes: str) -> dict[str, object]:
    """What Gradescope reads as `results.json`."""
    tests = [
        {
            "number": exercise.title.partition(" ")[0],
            "name": exercise.title.partition(" ")[2],
            "score": points,
            "max_score": exercise.points,
            "status": "passed" if points == exercise.points else "failed",
            "output": sentence,
        }
        for exercise, points, sentence in results
    ]
    return {"output": notes, "tests": tests}


def _parser() -> argparse.ArgumentParser:
    parser = parser_of("grade", __doc__, epilog=_EXAMPLE)
    parser.prog = "grade.py"
    option = parser.add_argument
    option("sheet", metavar="SHEET", help="the number of a sheet in docs/course, or the path of its notebook")
    option(
        "notebooks", metavar="NOTEBOOKS", type=Path, nargs="+", help="students' notebooks, or folders of them"
    )
    option("--to", type=Path, metavar="FOLDER", help="for points.csv and feedback/ (marked/ if several)")
    option("--gradescope", type=Path, metavar="FILE", help="write the results of one notebook for Gradescope")
    option("--seconds", type=whole(1), default=20, help="for each cell and each exercise (default 20)")
    option("--memory", type=whole(1), default=4, help="GiB that the notebook may address (default 4)")
    return parser


if __name__ == "__main__":
    run(main)
