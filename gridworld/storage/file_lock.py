"""Locks on files. The operating system releases one when the process ends, however it ends.

A lock is on a file, not on its name. If somebody deletes the folder and begins anew at the same path, the new
process locks another file, and the old one would write into a folder that is not its own any more. So whoever
writes by path calls `check_ours` first.
"""

from __future__ import annotations

import contextlib
import math
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gridworld.errors import FolderLostError, InputError
from gridworld.storage.system_calls import open_carefully, take_lock

_SECONDS_BETWEEN_TRIES = 0.02

Held = dict[str, int]  # paths of lock files, and their inodes: in use as long as somebody has the file open

_held: Held = {}  # by this process, or by the one that it works for
_files: set[int] = set()  # the descriptors of this process's own


def _leave_to_parent() -> None:
    """In a fork: close the files, with which the locks would outlive the parent. The fork works for it."""
    while _files:
        os.close(_files.pop())


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_leave_to_parent)


@contextmanager
def locked(path: Path, wait: float | None = None, shared: bool = False) -> Iterator[bool]:
    """Take the lock for the block, and yield whether that was possible.

    Args:
        path: the lock's file. It is made where there is none, and stays.
        wait: seconds; None waits for ever.
        shared: keep out only those who want it for themselves.

    Raises:
        InputError: the file system or the operating system has no locks.
        FolderLostError: see `check_ours`.
    """
    check_ours(path)
    while True:
        file = open_carefully(path, os.O_RDWR | os.O_CREAT)
        try:
            try:
                is_ours = _take(file, wait, shared)
            except OSError as error:
                raise InputError(
                    f"{path}: this file system has no locks ({error.strerror}); choose a folder on one that "
                    "has, or have it mounted with them (Lustre: -o flock)"
                ) from None
            if wait is None and not is_ours:
                raise InputError(
                    f"{path}: another process has this lock, and the system has none that are shared; wait "
                    "until that has ended"
                )
            if is_ours and not is_at(file, path):
                continue  # who had it before took the file away; a lock on that keeps nobody out
            with _noted(path, file) if is_ours else contextlib.nullcontext():
                yield is_ours
            return
        finally:
            os.close(file)


def check_ours(path: Path) -> None:
    """Check, before a write by path, that the folder is still this process's, if it ever was.

    Of nested folders that it holds, only the innermost is checked: if it is there, so are the others.

    Raises:
        FolderLostError: its lock file was removed or replaced.
    """
    where = os.path.abspath(path)
    above = [(*os.path.split(lock), inode) for lock, inode in tuple(_held.items())]
    above = [each for each in above if where.startswith(each[0] + os.sep)]
    innermost = max((folder for folder, _, _ in above), key=len, default="")
    for folder, name, inode in above:
        if folder == innermost and _inode(os.path.join(folder, name)) != inode:
            raise FolderLostError(
                f"{folder}: is no longer this process's, {name} in it was removed or replaced while it was "
                "at work there; it ends and writes nothing more"
            )


def held() -> Held:
    """The locks that this process holds, for its workers' `work_for`."""
    return dict(_held)


def work_for(holder: Held) -> None:
    """Treat the locks of another process, for which this one works, as held by this one too."""
    _held.update(holder)


@contextmanager
def _noted(path: Path, file: int) -> Iterator[None]:
    where, before = os.path.abspath(path), dict(_held)
    _held[where] = os.fstat(file).st_ino
    _files.add(file)
    try:
        yield
    finally:
        _files.discard(file)
        if where in before:  # a shared one, which this process has twice
            _held[where] = before[where]
        else:
            del _held[where]


def _inode(path: str) -> int | None:
    try:
        return os.lstat(path).st_ino
    except (FileNotFoundError, NotADirectoryError):
        return None


def is_locked(path: Path) -> bool:
    """Whether any process holds the lock now."""
    try:
        file = open_carefully(path, os.O_RDONLY)
    except FileNotFoundError:
        return False
    try:
        return not take_lock(file, shared=True)
    finally:
        os.close(file)


def is_at(file: int, path: Path) -> bool:
    """Whether an open file is the one that a path names now."""
    try:
        return os.path.samestat(os.fstat(file), os.lstat(path))
    except FileNotFoundError:
        return False


def _take(file: int, wait: float | None, shared: bool) -> bool:
    """False: not within that time, or, where one cannot wait for it, a lock that somebody shares."""
    if wait is None:
        if take_lock(file, shared, wait=True):
            return True
        wait = 0 if shared else math.inf
    end = time.monotonic() + wait
    while not take_lock(file, shared):
        if time.monotonic() >= end:
            return False
        time.sleep(_SECONDS_BETWEEN_TRIES)
    return True
