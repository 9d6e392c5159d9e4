"""Finding runs and studies: every folder at or below the given ones that holds a manifest.

The given folders may be links, since the user named them. A link in them may be a stranger's: it is not
followed, so that a report covers what is in the folder, and the search ends. A note names such links.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from gridworld.run.folder import CURVE, MANIFEST, VISITS

MOST_ENTRIES = 2_000_000  # files and folders below a given one: some seconds


@dataclass
class Found:
    """The result of a search."""

    folders: list[Path] = field(default_factory=list)  # of runs, in order of their names, each once
    problems: list[str] = field(default_factory=list)  # a sentence for every path without a run
    notes: list[str] = field(default_factory=list)  # what was passed over


def find_runs(paths: Sequence[Path]) -> Found:
    """Find the runs at or below the paths. Each is found once; nothing is read, and nothing is raised."""
    folders: dict[tuple[int, int], Path] = {}
    problems: list[str] = []
    notes: list[str] = []
    for path in paths:
        if problem := _problem(path):
            problems.append(problem)
            continue
        walk = _Walk(path)
        found = sorted(walk.folders())
        for folder in found:
            folders.setdefault(_identity(folder), folder)
        if not found:
            problems.append(f"{path}: holds no run, there is no {MANIFEST} in it or below it")
        problems += walk.problems
        notes += walk.notes()
    return Found(list(folders.values()), list(dict.fromkeys(problems)), list(dict.fromkeys(notes)))


def real_folders(path: Path) -> list[Path]:
    """The folder and those right in it, links aside."""
    try:
        with os.scandir(path) as entries:
            return [path, *sorted(path / each.name for each in entries if each.is_dir(follow_symlinks=False))]
    except OSError:
        return []


def _problem(path: Path) -> str | None:
    if path.is_dir():
        return None
    if path.exists():
        return f"{path}: is a file; give the folder of a run, of a sweep, or one above them"
    return f"{path}: no such folder; give the folder of a run, of a sweep, or one above them"


class _Walk:
    """All real folders at or below one."""

    def __init__(self, top: Path) -> None:
        self.problems: list[str] = []
        self._top = top
        self._entries = 0
        self._links: list[Path] = []  # to folders

    def folders(self) -> Iterator[Path]:
        """Those that hold a run."""
        waiting = [self._top]
        while waiting and self._entries <= MOST_ENTRIES:
            folder = waiting.pop()
            names, inner = self._look_into(folder)
            if not names.isdisjoint((MANIFEST, CURVE, VISITS)):
                yield folder
            waiting += [folder / name for name in sorted(inner, reverse=True)]
        if self._entries > MOST_ENTRIES:
            self.problems.append(
                f"{self._top}: holds more than {MOST_ENTRIES:,} files and folders, the rest was not "
                "searched; name the folders of the runs"
            )

    def _look_into(self, folder: Path) -> tuple[set[str], set[str]]:
        """The names in a folder of what is no folder, and of folders."""
        names: set[str] = set()
        inner: set[str] = set()
        try:
            with os.scandir(folder) as entries:
                for entry in itertools.islice(entries, MOST_ENTRIES + 1 - self._entries):
                    self._entries += 1
                    (inner if self._is_folder(folder, entry) else names).add(entry.name)
        except OSError as error:
            self.problems.append(f"{folder}: cannot be searched ({error.strerror})")
        return names, inner

    def notes(self) -> list[str]:
        """A sentence on links, if there are any."""
        if not self._links:
            return []
        first, more = min(self._links), len(self._links) - 1
        others = f" and {more:,} more" if more else ""
        return [
            f"{first}{others}: a link to a folder is not followed; to have its runs in the report, name it "
            "on the command line."
        ]

    def _is_folder(self, folder: Path, entry: os.DirEntry[str]) -> bool:
        try:
            if not entry.is_symlink():
                return entry.is_dir(follow_symlinks=False)
            if entry.is_dir():
                self._links.append(folder / entry.name)
        except OSError:  # a link to itself
            pass
        return False


def _identity(folder: Path) -> tuple[int, int]:
    status = folder.stat()
    return status.st_dev, status.st_ino
