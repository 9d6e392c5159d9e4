"""A lock on a file. The operating system lets go of it when the process ends, however that ends."""

from __future__ import annotations

import fcntl
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gridworld.errors import InputError

_SECONDS_BETWEEN_TRIES = 0.02
_FLAGS = os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK  # no link is followed, no pipe waited for


@contextmanager
def locked(path: Path, wait: float | None = None) -> Iterator[bool]:
    """Whether the lock is ours for the block; waits up to `wait` seconds, with None for ever.

    The file is made where there is none, and stays. Raises `InputError` where the file system has no locks.
    """
    while True:
        file = os.open(path, os.O_RDWR | os.O_CREAT | _FLAGS, 0o666)
        try:
            try:
                is_ours = _take(file, wait)
            except OSError as error:
                raise InputError(
                    f"{path}: this file system has no locks ({error.strerror}); choose a folder on one that "
                    "has, or have it mounted with them (Lustre: -o flock)"
                ) from None
            if is_ours and not _is_at(file, path):
                continue  # who had it before took the file away; a lock on that keeps nobody out
            yield is_ours
            return
        finally:
            os.close(file)


def is_locked(path: Path) -> bool:
    """Whether some process holds the lock now."""
    try:
        file = os.open(path, os.O_RDONLY | _FLAGS)
    except FileNotFoundError:
        return False
    try:
        fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(file)
    return False


def _is_at(file: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(file), os.lstat(path))
    except FileNotFoundError:
        return False


def _take(file: int, wait: float | None) -> bool:
    if wait is None:
        fcntl.flock(file, fcntl.LOCK_EX)
        return True
    end = time.monotonic() + wait
    while True:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() >= end:
                return False
            time.sleep(_SECONDS_BETWEEN_TRIES)
        else:
            return True
