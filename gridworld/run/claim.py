"""Which folder a command may write to, and having it for this process alone."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from gridworld.errors import FolderLostError, InputError
from gridworld.run.folder import CHECKPOINTS, HYDRA, LOCK, MANIFEST, SWEEP_JSON, RunFolder, shown
from gridworld.run.reader import read_run
from gridworld.storage.atomic_write import check_ours, locked, make_folder, remove_inside, tidy
from gridworld.storage.safe_read import check_no_link


def check_inside(path: Path, key: str) -> None:
    """Refuse a relative path that leads out of the current folder; `key` is the option that has it."""
    normal = os.path.normpath(path)
    if os.path.isabs(normal) or normal.split(os.sep)[0] not in (os.curdir, os.pardir):
        return
    if normal == os.curdir:
        raise InputError(f"{key}={path}: is the current folder; name one in it, e.g. runs/mine")
    raise InputError(
        f"{key}={path}: leads out of the current folder; if that is meant, say {os.path.abspath(path)}"
    )


def check_writable(folder: Path, key: str) -> None:
    """Refuse a folder that cannot be made, where there is none, or written to."""
    existing = next(path for path in (folder, *folder.parents) if path.exists())
    if not existing.is_dir():
        raise InputError(f"{folder}: cannot be made, {existing} is a file; choose another {key}")
    if not os.access(existing, os.W_OK | os.X_OK):
        raise InputError(f"{folder}: cannot be written, {existing} is read-only; choose another {key}")


def check_free(folder: Path, key: str = "hydra.run.dir") -> None:
    """Refuse a folder that cannot be written, or holds a finished run, a sweep or other runs.

    An unfinished run in it is accepted here: whether it is the same one is checked with the settings.
    """
    try:
        is_finished = read_run(folder).is_finished
    except InputError:  # there is none, or its manifest is damaged
        is_finished = False
    if is_finished:
        longer = f", or make that run longer by {RunFolder(folder).resume_command()} total_timesteps=..."
        can_be_longer = any(folder.glob(f"{CHECKPOINTS}/*"))
        raise InputError(
            f"{folder}: holds a run already; choose another folder{longer if can_be_longer else ''}"
        )
    if (folder / SWEEP_JSON).exists():
        raise InputError(f"{folder}: is the folder of a sweep; choose another {key}")
    if used := next(folder.glob(f"*/{MANIFEST}"), None):
        raise InputError(f"{folder}: holds other runs, {used.parent} for one; name a new folder in it")
    check_no_link(folder / CHECKPOINTS)
    check_writable(folder, key)


@contextlib.contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """Hold a run's folder for this process; an `InputError` if another process holds it."""
    with locked(folder / LOCK, wait=0) as is_ours:
        if not is_ours:
            raise InputError(f"{shown(folder)}: another process is at work in it; wait for it or stop it")
        yield


@contextlib.contextmanager
def claimed(folder: Path) -> Iterator[None]:
    """Make a run's folder and hold it for this process; afterwards, undo that where no run was started.

    Raises:
        InputError: another process holds the folder.
        OSError: the folder could not be made; or one of the block, which then names the folder.
    """
    make_folder(folder.parent)
    folder.mkdir(exist_ok=True)
    with alone_in(folder):
        try:
            yield
        except OSError as error:
            error.filename = error.filename or shown(folder)  # a failed write names no file
            raise
        finally:
            # Remove what Hydra wrote for a run that never started.
            with contextlib.suppress(FolderLostError, OSError):
                check_ours(folder / MANIFEST)
                if not (folder / MANIFEST).exists():
                    tidy(folder)
                    remove_inside(folder, HYDRA)
                    (folder / LOCK).unlink(missing_ok=True)
                    folder.rmdir()
