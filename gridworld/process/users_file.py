"""Opening a file that the user named, relative to the folder that the program was started in."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike
from typing import BinaryIO

from gridworld.process.console.command_line import users_folder


@contextmanager
def open_users_file(path: str | PathLike[str]) -> Iterator[BinaryIO | None]:
    """Open a file for reading, without waiting for whoever writes into a pipe.

    Yields:
        The file; None for a pipe or a device, which need not end.

    Raises:
        OSError: it cannot be opened.
        ValueError: the path is none.
    """
    with open(users_folder() / path, "rb", opener=_without_waiting) as file:
        yield file if stat.S_ISREG(os.fstat(file.fileno()).st_mode) else None


def _without_waiting(path: str, flags: int) -> int:
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))
