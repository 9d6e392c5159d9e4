"""Atomic writes: a file or folder is there whole or not at all, and durably where that is asked for.

After a power cut, a file that was renamed into its place may be empty, or its name may be the old one, since
the disk has a file's content once the file is synced, and its name once the folder is. What is half written
has a name of its own beside the path, `.NAME.PROCESS.part`.

A process that is at work in a folder holds a lock in it (`locked`), which the operating system releases when
the process ends, however it ends.

The folder `top` that a user named may be a link, since that is the user's. A link in it may be anybody's, and
lead to any folder of the reader's: `inside` goes through none.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import re
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from gridworld.storage.safe_read import check_no_link, open_ordinary

_SECONDS_BETWEEN_TRIES = 0.02
_PART = re.compile(r"\..+\.(\d+)\.(old\.)?part", re.DOTALL)


@contextmanager
def locked(path: Path, wait: float) -> Iterator[bool]:
    """Take the lock for the block, and yield whether that was possible within `wait` seconds.

    The lock's file is made where there is none, and stays. Raises `InputError` where it is a link.
    """
    check_no_link(path)
    lock = FileLock(path, timeout=wait, fallback_to_soft=False)
    try:
        lock.acquire(poll_interval=_SECONDS_BETWEEN_TRIES)
    except Timeout:
        yield False
        return
    try:
        yield True
    finally:
        lock.release()


def is_locked(path: Path) -> bool:
    """Whether any process holds the lock now. It is enough to be allowed to read the file."""
    if not os.path.lexists(path):
        return False
    with open_ordinary(path) as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False


@contextmanager
def replacing(path: Path, durable: bool = False) -> Iterator[Path]:
    """Replace a file atomically: the block writes to a path beside it, which then takes its place.

    If the block raises, the file stays as it was. A symbolic link is replaced and not followed.

    Args:
        path: the file.
        durable: a power cut leaves the old content or the new one.

    Raises:
        OSError: it names `path`, not the path beside it.
    """
    part = _part_of(path)
    try:
        remove_path(part)
        yield part
        if durable:
            _sync(part)
        os.replace(part, path)
    except OSError as error:
        error.filename = str(path)
        raise
    finally:
        with contextlib.suppress(OSError):
            part.unlink()
    if durable:
        sync_folder(path.parent)


@contextmanager
def replacing_folder(folder: Path) -> Iterator[Path]:
    """Replace a folder as a whole: the block fills a new one beside it, which then takes its place.

    If the block raises, the folder stays as it was.
    """
    new = _part_of(folder)
    old = new.with_suffix(".old.part")
    try:
        tidy(folder.parent)
        for leftover in (new, old):
            remove_path(leftover)
        new.mkdir(parents=True)
        yield new
        if os.path.lexists(folder):
            folder.rename(old)
        new.rename(folder)
        remove_path(old)
    except OSError as error:
        error.filename = str(error.filename or folder).replace(str(new), str(folder))
        raise
    finally:
        shutil.rmtree(new, ignore_errors=True)


def _part_of(path: Path) -> Path:
    return path.with_name(f".{path.name}.{os.getpid()}.part")


def tidy(folder: Path) -> None:
    """Remove what processes that are not there any more left half written."""
    for path in folder.glob(".*.part"):
        if (found := _PART.fullmatch(path.name)) and not _is_alive(int(found[1])):
            remove_path(path)


def _is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:  # it is another user's
        pass
    return True


def write_text(path: Path, text: str, durable: bool = False) -> None:
    """Write UTF-8; `durable` as for `replacing`."""
    write_bytes(path, text.encode(), durable)


def write_bytes(path: Path, content: bytes | memoryview, durable: bool = False) -> None:
    """Write bytes; `durable` as for `replacing`."""
    with replacing(path, durable) as part:
        part.write_bytes(content)


def write_json(path: Path, content: Any, durable: bool = False) -> None:
    """Write indented JSON; `durable` as for `replacing`. NaN and infinities are a `ValueError`."""
    write_text(path, json.dumps(content, indent=2, allow_nan=False) + "\n", durable)


def sync(files: Iterable[Path], folder: Path) -> None:
    """Make files survive a power cut, in this order, as far as they exist, then all names in `folder`."""
    for path in files:
        with contextlib.suppress(FileNotFoundError):
            _sync(path)
    sync_folder(folder)


def sync_folder(folder: Path) -> None:
    """Make the names in a folder survive a power cut, as far as the file system lets this process do so."""
    with contextlib.suppress(OSError):
        _sync(folder)


def _sync(path: Path) -> None:
    file = os.open(path, os.O_RDONLY | os.O_NOFOLLOW)
    try:
        os.fsync(file)
    finally:
        os.close(file)


def make_folder(folder: Path) -> None:
    """Make a folder and those above it that are missing; they survive a power cut."""
    if not folder.is_dir():
        make_folder(folder.parent)
        folder.mkdir(exist_ok=True)
        sync_folder(folder.parent)


def remove_path(path: Path) -> None:
    """Remove the file, folder or link (not what it leads to) at a path, if there is one."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def inside(top: Path, *names: str) -> Path:
    """The path `top`/names[0]/...; refuses a link on the way, and at its end."""
    path = top
    for name in names:
        path = path / name
        check_no_link(path)
    return path


def check_no_links(top: Path, *names: str) -> None:
    """Refuse a folder to be written in that is reached through a link below `top`, or holds one."""
    folder = inside(top, *names)
    for path in sorted(folder.iterdir()) if folder.is_dir() else ():
        check_no_link(path)
