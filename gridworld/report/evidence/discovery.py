"""Finding runs and studies: every folder at or below the given ones that holds a manifest.

The given folders may be links, since the user named them. A link in them may be a stranger's: it is not
followed, so that a report covers what is in the folder, and the search ends. A note names such links.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
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
    problems: dict[str, None] = {}
    notes: dict[str, None] = {}
    for path in dict.fromkeys(paths):
        if not path.is_dir():
            what = "is a file" if path.exists() else "no such folder"
            problems[f"{path}: {what}; give the folder of a run, of a sweep, or one above them"] = None
            continue
        found = _search(path)
        for folder in found.folders:
            status = folder.stat()
            folders.setdefault((status.st_dev, status.st_ino), folder)
        if not found.folders:
            problems[f"{path}: holds no run, there is no {MANIFEST} in it or below it"] = None
        problems |= dict.fromkeys(found.problems)
        notes |= dict.fromkeys(found.notes)
    return Found(list(folders.values()), list(problems), list(notes))


def real_folders(path: Path) -> list[Path]:
    """The folder and those right in it, links aside."""
    try:
        with os.scandir(path) as entries:
            return [path, *sorted(path / each.name for each in entries if each.is_dir(follow_symlinks=False))]
    except OSError:
        return []


def _search(top: Path) -> Found:
    """The runs at or below one folder."""
    found = Found()
    links: list[Path] = []  # to folders
    entries = 0

    def refused(error: OSError) -> None:
        found.problems.append(f"{error.filename}: cannot be searched ({error.strerror})")

    for name, inner, files in os.walk(top, onerror=refused):
        folder = Path(name)
        if not {MANIFEST, CURVE, VISITS}.isdisjoint(files):
            found.folders.append(folder)
        entries += len(inner) + len(files)
        if entries > MOST_ENTRIES:
            found.problems.append(
                f"{top}: holds more than {MOST_ENTRIES:,} files and folders, the rest was not "
                "searched; name the folders of the runs"
            )
            break
        links += [folder / each for each in inner if (folder / each).is_symlink()]
        inner.sort()
    found.folders.sort()
    if links:
        others = f" and {len(links) - 1:,} more" if len(links) > 1 else ""
        found.notes.append(
            f"{min(links)}{others}: a link to a folder is not followed; to have its runs in the report, name "
            "it on the command line."
        )
    return found
