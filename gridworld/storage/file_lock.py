"""Locks on files, by `filelock`. The operating system releases one when the process ends, however it ends.

A lock is on a file, not on its name. If somebody deletes the folder and begins anew at the same path, the new
process locks another file, and the old one would write into a folder that is not its own any more. So whoever
writes by path calls `check_ours` first.
"""

from __future__ import annotations

import errno
import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from gridworld.errors import FolderLostError, InputError

_SECONDS_BETWEEN_TRIES = 0.02
_NO_LOCKS = (errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS)

_held: dict[Path, int] = {}  # the lock files in this process's folders, and their inodes


@contextmanager
def locked(path: Path, wait: float | None = None) -> Iterator[bool]:
    """Take the lock for the block, and yield whether that was possible.

    Args:
        path: the lock's file. It is made where there is none, and stays.
        wait: seconds; None waits for ever.

    Raises:
        InputError: the file system has no locks.
        FolderLostError: see `check_ours`.
    """
    check_ours(path)
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


@contextmanager
def noted(path: Path) -> Iterator[None]:
    """Let `check_ours` look after the folder of a lock's file that exists; nobody is kept out."""
    where = Path(os.path.abspath(path))
    before = _held.get(where)
    file = os.open(path, os.O_RDONLY | os.O_NOFOLLOW)  # while it is open, no other file gets its inode
    _held[where] = os.fstat(file).st_ino
    try:
        yield
    finally:
        os.close(file)
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
                if _inode(lock) != _held[lock]:
                    raise FolderLostError(
                        f"{folder}: is no longer this process's, {lock.name} in it was removed or replaced "
                        "while it was at work there; it ends and writes nothing more"
                    )
            return  # of nested folders: if the innermost is there, so are the others


def is_locked(path: Path) -> bool:
    """Whether any process holds the lock now. It is enough to be allowed to read the file."""
    try:
        file = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    except FileNotFoundError:
        return False
    try:
        fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(file)
    return False


def _inode(path: Path) -> int | None:
    try:
        return os.lstat(path).st_ino
    except (FileNotFoundError, NotADirectoryError):
        return None
