"""Reading a run whose manifest a power cut or a disk may have damaged.

Every checkpoint has a copy of the manifest as it was then. Where the manifest cannot be read, or is not what
was sealed, the newest checkpoint with a valid copy stands in for it. A run with an empty manifest, of which
nothing was saved, counts as never started.
"""

from __future__ import annotations

import os
import stat
from pathlib import Path

from gridworld.errors import InputError
from gridworld.process.console.terminal import tell
from gridworld.run.checkpoints import Checkpoints
from gridworld.run.folder import MANIFEST, RunFolder
from gridworld.run.manifest import check_manifest
from gridworld.run.reader import RunReader, check_is_run, read_run
from gridworld.storage.safe_read import LARGEST_JSON, as_object, read_bytes


def run_to_resume(folder: Path) -> RunReader:
    """Read a run by its manifest or a checkpoint's copy; the use of a copy is told on standard error.

    Raises:
        InputError: There is no run, or its manifest is damaged and there is no copy.
    """
    check_is_run(folder)
    try:
        return read_run(folder)
    except InputError as error:
        fault = error
    file = folder / MANIFEST
    if not stat.S_ISREG(os.lstat(file).st_mode):
        raise fault
    if not is_started(folder):
        raise InputError(f"{file}: is empty, and nothing of the run was saved; begin it again")
    run = _by_copy(folder, fault)
    if run is None:
        raise InputError(f"{fault}; no checkpoint has one")
    tell(run.manifest["error"])
    return run


def find_run(folder: Path) -> RunReader | None:
    """Read a run, if one has started, by its manifest or a checkpoint's copy.

    Returns:
        The run; by a copy, the "error" in its manifest says so. None where no run has started.

    Raises:
        InputError: The manifest is damaged and there is no copy.
    """
    if not is_started(folder):
        return None
    try:
        return read_run(folder)
    except InputError as error:
        if (run := _by_copy(folder, error)) is None:
            raise
        return run


def is_started(folder: Path) -> bool:
    """Whether a folder holds a run: a manifest, or beside an empty one at least a result or a checkpoint."""
    run = RunFolder(folder)
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


def _by_copy(folder: Path, fault: InputError) -> RunReader | None:
    """The run by the newest valid copy of its manifest, as one that was interrupted."""
    for path, state in Checkpoints(folder).states():
        text = state.get("manifest") if isinstance(state, dict) else None
        if not isinstance(text, str) or len(text) > LARGEST_JSON:
            continue
        try:
            manifest = check_manifest(as_object(text.encode(), path), path)
        except (InputError, UnicodeEncodeError):
            continue
        told = f"{fault}; goes by the copy in {path.relative_to(folder)}"
        return RunReader(folder, manifest | {"status": "interrupted", "error": told})
    return None
