"""A lab sheet: where its marking is, and the points of a student's notebook.

The marking of `lab1_values.ipynb` is `marking/lab1_values.py` next to it: a function for each exercise,
decorated with `exercise`. It asks the student's functions through `Work`, compares in its own process, and
returns a sentence for full points or raises `WrongAnswerError` for none.

Students may have the marking, to check themselves. Its dictionary `PUBLIC`, if it has one, says on what. The
values in `hidden/lab1_values.json` replace those where this file is there.
"""

from __future__ import annotations

import runpy
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from grading.work import Work, WrongAnswerError
from gridworld.base.errors import InputError, in_short
from gridworld.base.safe_read import read_object

COURSE = Path(__file__).resolve().parents[1]  # where the shipped sheets are
NOT_GRADED = "# not graded"  # how the first line of a cell begins that is not run here
_LARGEST_NOTEBOOK = 64 * 2**20  # bytes


@dataclass(frozen=True)
class Exercise:
    """An exercise of a sheet, and how it is marked."""

    title: str
    points: int
    mark: Callable[[Work], str]


def exercise(title: str, points: int) -> Callable[[Callable[[Work], str]], Exercise]:
    """Make a function the marking of an exercise.

    Args:
        title: its number and name, as in the sheet.
        points: for a right answer.

    Returns:
        A decorator. The function gets the student's `Work`, returns one sentence for full points, and raises
        `WrongAnswerError` with one sentence for none.
    """
    return lambda mark: Exercise(title, points, mark)


@dataclass(frozen=True)
class Sheet:
    """A lab sheet, ready to mark notebooks.

    Attributes:
        name: of its files, without suffix.
        missing: the file of the hidden part of its marking, if it should have one and has none.
    """

    name: str
    exercises: list[Exercise]
    missing: Path | None

    @property
    def points(self) -> int:
        """The points of a notebook in which everything is right."""
        return sum(each.points for each in self.exercises)


def find_sheet(name: str) -> Path:
    """The notebook of a sheet: a path, or the number of a shipped one."""
    if name.isdigit():
        known = sorted(COURSE.glob("lab*.ipynb"))
        found = [path for path in known if path.name.startswith(f"lab{name}_")]
        if not found:
            raise InputError(f"{name}: not a lab sheet; must be from 1 to {len(known)}, or a notebook's path")
        return found[0]
    if not name.endswith(".ipynb"):
        raise InputError(f"{name}: not a notebook; give a shipped sheet's number, or the path of a notebook")
    return Path(name)


def read_sheet(notebook: Path) -> Sheet:
    """Read the marking of a sheet, see `find_sheet`, with its hidden part where that is there."""
    path = notebook.parent / "marking" / f"{notebook.stem}.py"
    if not path.is_file():
        if not notebook.exists():
            raise InputError(f"{notebook}: no such file")
        raise InputError(f"{path}: missing; the marking of {notebook.name} must be in this file")
    try:
        names = runpy.run_path(str(path))
    except Exception as error:
        raise InputError(f"{path}: cannot be run ({in_short(error)})") from error
    exercises = [each for each in names.values() if isinstance(each, Exercise)]
    if not exercises:
        raise InputError(f"{path}: has no exercise; a function decorated with `exercise` is one")
    public, hidden = names.get("PUBLIC"), notebook.parent / "hidden" / f"{notebook.stem}.json"
    if public is None or not hidden.exists():
        return Sheet(notebook.stem, exercises, None if public is None else hidden)
    values = read_object(hidden)
    if values.keys() != public.keys():
        raise InputError(f"{hidden}: must have the keys of PUBLIC in {path}: {', '.join(public)}")
    public.update(values)
    return Sheet(notebook.stem, exercises, None)


def read_cells(notebook: Path) -> dict[int, str]:
    """The source of the code cells of a notebook that are graded, by their number among the code cells."""
    cells = read_object(notebook, _LARGEST_NOTEBOOK).get("cells")
    if not isinstance(cells, list) or not all(isinstance(cell, dict) for cell in cells):
        raise InputError(f"{notebook}: must be a Jupyter notebook of format 4, with a list of cells")
    sources = [cell.get("source", "") for cell in cells if cell.get("cell_type") == "code"]
    if not all(isinstance(source, str | list) for source in sources):
        raise InputError(f"{notebook}: has a code cell whose source is not text")
    texts = [source if isinstance(source, str) else "".join(map(str, source)) for source in sources]
    return {number: text for number, text in enumerate(texts, 1) if not text.startswith(NOT_GRADED)}


Marked = tuple[Exercise, int, str]  # its points, and the sentence that says why


def grade(sheet: Sheet, notebook: Path, seconds: float, memory: int) -> Iterator[str | Marked]:
    """Mark a student's notebook.

    Args:
        sheet: see `read_sheet`.
        notebook: the student's; one that cannot be read has no points.
        seconds: for each cell, and for each exercise.
        memory: bytes that the student's process may address.

    Yields:
        Notes on the notebook and on cells that failed, then the result of each exercise.
    """
    try:
        cells = read_cells(notebook)
    except InputError as error:
        yield str(error)
        yield from ((each, 0, "the notebook cannot be read") for each in sheet.exercises)
        return
    with Work(cells, seconds, memory) as work:
        work.begin()
        yield from (f"code cell {number} {why}" for number, why in work.failed.items())
        for each in sheet.exercises:
            yield (each, *_mark(each, work))


def _mark(each: Exercise, work: Work) -> tuple[int, str]:
    work.begin()
    try:
        return each.points, each.mark(work)
    except WrongAnswerError as error:
        return 0, str(error)
    except Exception as error:  # of plain data that has another form than the marking expects
        return 0, f"cannot be marked: the answer has another form ({in_short(error)})"
