"""What a power cut, or a disk, made of a run's manifest, for who goes on with the run.

A checkpoint has a copy of the manifest as it was then. One that cannot be read any more, or is not what was
sealed, is taken from the newest checkpoint that has one. A run of which nothing was saved never began.
"""

from __future__ import annotations

import json
import os
import stat
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from gridworld.checkpoint import Checkpoints
from gridworld.data_files import LARGEST_JSON, read_bytes, read_object
from gridworld.errors import InputError
from gridworld.files import json_text
from gridworld.run import MANIFEST, Run, check_is_run, read_run
from gridworld.terminal import printable

_KEYS = {"status", "config", "layout", "seal"}


def run_to_go_on(folder: Path) -> Run:
    """The run in a folder, which says so if its manifest is the copy in a checkpoint.

    Raises `InputError` where there is no run, or its manifest is damaged and there is no copy.
    """
    check_is_run(folder)
    run = Run(folder)
    try:
        run = read_run(folder)
        if run.manifest.get("seal") == run.seal():
            return run
        fault = f"{run.manifest_file}: was changed or damaged since the run began"
    except InputError as error:
        fault = str(error)
    if not stat.S_ISREG(os.lstat(run.manifest_file).st_mode):
        raise InputError(fault)
    if not is_begun(folder):
        raise InputError(f"{run.manifest_file}: is empty, and nothing of the run was saved; begin it again")
    for path, manifest in _copies(folder):
        print(printable(f"{fault}; goes by the copy in {path.relative_to(folder)}"), file=sys.stderr)
        run.manifest = manifest
        return run
    raise InputError(f"{fault}; put back a good copy, no checkpoint has one")


def manifest_of(folder: Path) -> dict[str, Any]:
    """The manifest of a run, or the newest checkpoint's copy; empty where there is no run.

    Raises `InputError` where it cannot be read and there is no copy.
    """
    file = folder / MANIFEST
    if not os.path.lexists(file):
        return {}
    try:
        manifest = read_object(file)
    except InputError:
        if not is_begun(folder):
            return {}
        for _, manifest in _copies(folder):
            return manifest
        raise
    if not manifest:
        raise InputError(f"{file}: is empty")
    return manifest


def is_begun(folder: Path) -> bool:
    """Whether there is a run: a manifest, or at least a result or a checkpoint beside what is left of one."""
    run = Run(folder)
    if not os.path.lexists(run.manifest_file):
        return False
    try:
        if read_bytes(run.manifest_file, LARGEST_JSON).strip(b"\0"):
            return True
    except InputError:
        return True
    if any(path.exists() and path.stat().st_size for path in (run.summary_file, run.model_file)):
        return True
    return any(isinstance(state, dict) for _, state in Checkpoints(folder).states())


def _copies(folder: Path) -> Iterator[tuple[Path, dict[str, Any]]]:
    """Newest first, each as that of a run that was interrupted."""
    for path, state in Checkpoints(folder).states():
        text = state.get("manifest") if isinstance(state, dict) else None
        if not isinstance(text, str) or len(text) > LARGEST_JSON:
            continue
        run = Run(folder)
        try:
            manifest = json.loads(text)
            json_text(manifest)  # not all that Python reads can be written
        except (ValueError, RecursionError):
            continue
        if isinstance(manifest, dict) and manifest.keys() >= _KEYS:
            run.manifest = manifest
            if manifest["seal"] == run.seal():
                yield path, manifest | {"status": "interrupted"}
