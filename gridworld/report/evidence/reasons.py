"""Why runs are not certified, as far as somebody who can tell was asked."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from gridworld.errors import InputError
from gridworld.report.evidence.grouping import Group
from gridworld.report.evidence.run_reader import Evidence


@dataclass(frozen=True)
class Reason:
    """Why one run is not certified.

    Attributes:
        cause: in about four words.
        change: the word for the command line to try; "" where there is none.
    """

    cause: str
    change: str = ""


Reasons = Mapping[Path, Reason]  # by the run's folder


def reasons(
    groups: Iterable[Group], ask: Callable[[Path], Reason | None], most: int
) -> tuple[Reasons, list[str]]:
    """Ask why runs are not certified.

    Args:
        groups: their runs, of which the first seed of each comes before the second of any.
        ask: tells the reason of the run in a folder; None: it cannot. Raises `InputError` where a file of
            the run keeps it from that.
        most: how many to ask about.

    Returns:
        The reasons, and a sentence for each run that cannot be asked about.
    """
    found, untold = {}, []
    for run in itertools.islice(_in_turn([_uncertified(group) for group in groups]), most):
        try:
            if (reason := ask(run.folder)) is not None:
                found[run.folder] = reason
        except InputError as error:
            untold.append(f"{run.folder}: is not diagnosed; {error}")
    return found, untold


def _uncertified(group: Group) -> list[Evidence]:
    return [run for run in group.runs if not run.certified]


def _in_turn(columns: list[list[Evidence]]) -> Iterator[Evidence]:
    for row in itertools.zip_longest(*columns):
        yield from (run for run in row if run is not None)


def most_common(group: Group, found: Reasons) -> str:
    """The most common cause of a group's runs that are not certified, with its count; "" without any."""
    causes = Counter(found[run.folder].cause for run in _uncertified(group) if run.folder in found)
    if not causes:
        return ""
    cause, count = causes.most_common(1)[0]
    return f"{cause} ({count} of {causes.total()})"
