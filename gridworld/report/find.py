"""Finding runs: every folder at or below the given ones that holds a manifest."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path

from gridworld.run import CURVE, MANIFEST


def find_runs(paths: Sequence[Path]) -> tuple[list[Path], list[str]]:
    """Run folders in order of their names, each once, and a sentence for every path without one."""
    seen: set[tuple[int, int]] = set()
    folders: list[Path] = []
    problems = []
    for path in paths:
        if problem := _problem(path):
            problems.append(problem)
            continue
        met_before = _identity(path) in seen
        found = sorted(_below(path, seen, problems))
        folders += found
        if not found and not met_before:
            problems.append(f"{path}: holds no run, there is no {MANIFEST} in it or below it")
    return folders, problems


def _problem(path: Path) -> str | None:
    if path.is_dir():
        return None
    if path.exists():
        return f"{path}: is a file; give the folder of a run, of a sweep, or one above them"
    return f"{path}: no such folder; give the folder of a run, of a sweep, or one above them"


def _below(top: Path, seen: set[tuple[int, int]], problems: list[str]) -> Iterator[Path]:
    """Symbolic links are followed, but no real folder is entered twice, so a loop of links ends."""
    waiting = [top]
    while waiting:
        folder = waiting.pop()
        try:
            if (identity := _identity(folder)) in seen:
                continue
            seen.add(identity)
            with os.scandir(folder) as entries:
                names = [(entry.name, entry.is_dir()) for entry in entries]
        except OSError as error:
            problems.append(f"{folder}: cannot be searched ({error.strerror})")
            continue
        if any(name in (MANIFEST, CURVE) and not is_folder for name, is_folder in names):
            yield folder
        waiting += [folder / name for name, is_folder in names if is_folder]


def _identity(folder: Path) -> tuple[int, int]:
    status = folder.stat()
    return status.st_dev, status.st_ino
