"""Marking the lab sheets of a course, for `grade.py`.

`sheet` finds a sheet and how it is marked, `work` asks a student's functions, which run in a process of their
own (`notebook`). A sheet's marking is a Python file that uses what is named here.
"""

from grading.sheet import exercise
from grading.work import Work, WrongAnswerError, numbers

__all__ = ["Work", "WrongAnswerError", "exercise", "numbers"]
