"""Mark a student's notebook of a lab sheet: points and one sentence for each exercise, by exact ground truth.

The notebook runs in a process of its own, with limits on time and memory and no others: mark the work of
people whom you do not trust in a container without the solutions.
Exit code: 0 if the notebook has all points, 1 if not, 2 for a mistake on the command line.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from gridworld.base.console import aligned, printable
from gridworld.base.signals import listen

if __name__ == "__main__":
    listen()  # before what takes time to import

from grading.sheet import find_sheet, grade

from gridworld.commands import parser_of, run, whole

_NOT_ALL = 1  # the exit code
_COLUMNS = ("<34", ">7", "<0")


def main(words: Sequence[str]) -> None:
    """Print a row per exercise as it is marked, and the total."""
    options = _parser().parse_args(words)
    points = most = 0
    for each in grade(find_sheet(options.sheet), options.solution, options.seconds, options.memory * 2**30):
        if isinstance(each, str):
            print(printable(each), flush=True)
            continue
        exercise, given, sentence = each
        points, most = points + given, most + exercise.points
        row = [exercise.title, f"{given}/{exercise.points}", f" {sentence}"]
        print(printable(*aligned([row], _COLUMNS)), flush=True)
    print(f"total: {points} of {most} points")
    if points < most:
        sys.exit(_NOT_ALL)


def _parser() -> argparse.ArgumentParser:
    parser = parser_of("grade", __doc__)
    parser.prog = "grade.py"
    option = parser.add_argument
    option("sheet", metavar="SHEET", help="the number of a sheet in docs/course, or the path of its notebook")
    option("solution", metavar="SOLUTION", type=Path, help="the student's notebook")
    option("--seconds", type=whole(1), default=20, help="for each cell and each exercise (default 20)")
    option("--memory", type=whole(1), default=4, help="GiB that the notebook may address (default 4)")
    return parser


if __name__ == "__main__":
    run(main)
