"""Atomic writes to folders that are this process's alone.

A file or folder is written whole or not at all, and durably where that is asked for: after a power cut, a
file that was renamed into its place may be empty, or its name may be the old one, since the disk has a file's
content once the file is synced, and its name once the folder is. What is half written has a name of its own
beside the path, with the process that is at it. Each process removes what killed ones left where it writes.

A process that is at work in a folder holds a lock in it (`locked`), which the operating system releases when
the process ends, however it ends. A lock is on a file, not on its name. If somebody deletes the folder and
begins anew at the same path, the new process locks another file, and the old one would write into a folder
that is not its own any more. So whoever writes by path calls `check_ours`, as all functions here do.

The folder `top` that a user named may be a link, since that is the user's. A link in it may be anybody's, and
lead to any folder of the reader's: the functions `..._inside` go through none.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import re
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from filelock import FileLock, Timeout

from gridworld.errors import FolderLostError, InputError
from gridworld.storage.safe_read import check_no_link, open_ordinary

if TYPE_CHECKING:
    from numpy.typing import NDArray

_SECONDS_BETWEEN_TRIES = 0.02
_NOT_SYNCED = (errno.EINVAL, errno.ENOTSUP, errno.ENOSYS)  # where a file system cannot sync a folder
_NO_LOCKS = (errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS)
_HOST = os.uname().nodename
_PART = re.compile(rf"\..+\.{re.escape(_HOST)}\.(\d+)\.(old\.)?part", re.DOTALL)

_held: dict[Path, int] = {}  # the lock files in this process's folders, and their inodes
_tidied: set[str] = set()  # folders, by this process


@contextmanager
def locked(path: Path, wait: float | None = None) -> Iterator[bool]:
    """Take the lock for the block, and yield whether that was possible.

    Args:
        path: the lock's file. It is made where there is none, and stays.
        wait: seconds; None waits for ever.

    Raises:
        InputError: the file system has no locks, or the file is a link.
        FolderLostError: see `check_ours`.
    """
    check_ours(path)
    check_no_link(path)
    lock = FileLock(path, timeout=-1 if wait is None else wait, fallback_to_soft=False)
    try:
        lock.acquire(poll_interval=_SECONDS_BETWEEN_TRIES)
    except Timeout:
        yield False
        return
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise
        raise InputError(
            f"{path}: this file system has no locks ({error.strerror}); choose a folder on one that has, or "
            "have it mounted with them (Lustre: -o flock)"
        ) from None
    try:
        with noted(path):
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
def noted(path: Path) -> Iterator[None]:
    """Let `check_ours` look after the folder of a lock's file that exists; nobody is kept out."""
    where = Path(os.path.abspath(path))
    before = _held.get(where)
    with open_ordinary(path) as file:  # while it is open, no other file gets its inode
        _held[where] = os.fstat(file.fileno()).st_ino
        try:
            yield
        finally:
            if before is None:
                del _held[where]


def check_ours(path: Path) -> None:
    """Check, before a write by path, that the folder is still this process's, if it ever was.

    Raises:
        FolderLostError: its lock file was removed or replaced.
    """
    for folder in Path(os.path.abspath(path)).parents if _held else ():
        if locks := [lock for lock in _held if lock.parent == folder]:
            for lock in locks:
                if not os.path.lexists(lock) or os.lstat(lock).st_ino != _held[lock]:
                    raise FolderLostError(
                        f"{folder}: is no longer this process's, {lock.name} in it was removed or replaced "
                        "while it was at work there; it ends and writes nothing more"
                    )
            return  # of nested folders: if the innermost is there, so are the others


@contextmanager
def replacing(path: Path, durable: bool = False) -> Iterator[Path]:
    """Replace a file atomically: the block writes to a path beside it, which then takes its place.

    If the block raises, the file stays as it was. A symbolic link is replaced and not followed.

    Args:
        path: the file.
        durable: a power cut leaves the old content or the new one.

    Raises:
        FolderLostError: the folder is no longer this process's.
        OSError: it names `path`, not the path beside it.
    """
    with _beside(path) as part:
        try:
            yield part
            if durable:
                _sync(part)
            check_ours(path)
            os.replace(part, path)
        finally:
            part.unlink(missing_ok=True)
        if durable:
            sync_folder(path.parent)


@contextmanager
def replacing_folder(folder: Path) -> Iterator[Path]:
    """Replace a folder as a whole: the block fills a new one beside it, which then takes its place.

    If the block raises, the folder stays as it was. Raises as `replacing` does.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    with _beside(folder) as new:
        old = new.with_suffix(".old.part")
        new.mkdir()
        try:
            yield new
            check_ours(folder)
            if os.path.lexists(folder):
                folder.rename(old)
            new.rename(folder)
            remove_path(old)
        finally:
            shutil.rmtree(new, ignore_errors=True)


@contextmanager
def _beside(path: Path) -> Iterator[Path]:
    """A free path that only this process writes to; an `OSError` about it names `path`."""
    check_ours(path)
    part = path.with_name(f".{path.name}.{_HOST}.{os.getpid()}.part")
    try:
        if (folder := os.path.abspath(path.parent)) not in _tidied:
            _tidied.add(folder)
            tidy(path.parent)
        remove_path(part)
        yield part
    except OSError as error:
        where = Path(os.fsdecode(error.filename or part))
        if where.is_relative_to(part):
            error.filename = str(path / where.relative_to(part))
        raise


def tidy(folder: Path) -> None:
    """Remove what processes of this machine had half written that are not there any more."""
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


def write_array(path: Path, array: NDArray[Any]) -> None:
    """Write numpy's own format; `numpy.load` reads it without unpickling anything."""
    import numpy as np  # here, since `train.py --help` does not need it

    with replacing(path) as part, part.open("wb") as file:  # given a path, NumPy would add .npy to it
        np.save(file, array, allow_pickle=False)


def sync(files: Iterable[Path], folder: Path) -> None:
    """Make files survive a power cut, in this order, as far as they exist, then all names in `folder`."""
    for path in files:
        with contextlib.suppress(FileNotFoundError):
            _sync(path)
    sync_folder(folder)


def sync_folder(folder: Path) -> None:
    """Make the names in a folder survive a power cut, as far as the file system can do that."""
    with contextlib.suppress(PermissionError):  # who may write to a folder need not be allowed to list it
        try:
            _sync(folder)
        except OSError as error:
            if error.errno not in _NOT_SYNCED:
                raise


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
    check_ours(path)
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def make_inside(top: Path, *names: str) -> Path:
    """Make the folder `top`/names[0]/... and those between; refuses a link below `top`."""
    path = _inside(top, names)
    check_ours(path)
    path.mkdir(parents=True, exist_ok=True)
    return path


def remove_inside(top: Path, *names: str) -> None:
    """Remove what is at `top`/names[0]/..., if anything; refuses a link on the way to it."""
    remove_path(_inside(top, names[:-1]) / names[-1])


def names_inside(top: Path, *names: str) -> list[str]:
    """The sorted names in the folder `top`/names[0]/..., if there is one; refuses a link below `top`."""
    path = _inside(top, names)
    return sorted(os.listdir(path)) if path.is_dir() else []


def check_no_links(top: Path, *names: str) -> None:
    """Refuse a folder to be written in that is reached through a link below `top`, or holds one."""
    for name in names_inside(top, *names):
        check_no_link(top.joinpath(*names, name))


def _inside(top: Path, names: Iterable[str]) -> Path:
    path = top
    for name in names:
        path = path / name
        check_no_link(path)
    return path
