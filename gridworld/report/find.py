"""Finding runs: every folder at or below the given ones that holds a manifest."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path

from gridworld.run import CURVE, MANIFEST


def find_runs(paths: Sequence[Path]) -> tuple[list[Path], list[str]]:
    """Run folders in order of their names, each once, and a sentence for every path without one."""
    folders: dict[tuple[int, int], Path] = {}
    problems: list[str] = []
    for path in paths:
        if problem := _problem(path):
            problems.append(problem)
            continue
        found = sorted(_below(path, problems))
        for folder in found:
            folders.setdefault(_identity(folder), folder)
        if not found:
            problems.append(f"{path}: holds no run, there is no {MANIFEST} in it or below it")
    return list(folders.values()), list(dict.fromkeys(problems))


def _problem(path: Path) -> str | None:
    if path.is_dir():
        return None
    if path.exists():
        return f"{path}: is a file; give the folder of a run, of a sweep, or one above them"
    return f"{path}: no such folder; give the folder of a run, of a sweep, or one above them"


def _below(top: Path, problems: list[str]) -> Iterator[Path]:
    """Symbolic links are followed, but no real folder is entered twice, so a loop of links ends."""
    seen: set[tuple[int, int]] = set()
    waiting = [top]
    while waiting:
        folder = waiting.pop()
        try:
            if (identity := _identity(folder)) in seen:
                continue
            seen.add(identity)
            with os.scandir(folder) as entries:
                names = sorted(((entry.name, _is_folder(entry)) for entry in entries), reverse=True)
        except OSError as error:
            problems.append(f"{folder}: cannot be searched ({error.strerror})")
            continue
        if any(name in (MANIFEST, CURVE) and not is_folder for name, is_folder in names):
            yield folder
        waiting += [folder / name for name, is_folder in names if is_folder]


def _is_folder(entry: os.DirEntry[str]) -> bool:
    try:
        return entry.is_dir()
    except OSError:  # a link to itself
        return False


def _identity(folder: Path) -> tuple[int, int]:
    status = folder.stat()
    return status.st_dev, status.st_ino
