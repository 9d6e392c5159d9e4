"""An append-only file: a record is in it whole or not at all, and it can be truncated to a mark.

A mark is the file's name, its length and the SHA-256 of its content. A run that continues from a checkpoint
truncates its files to the checkpoint's marks, so that no record is there twice and none is missing.
"""

from __future__ import annotations

import hashlib
import os
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, BinaryIO, cast

from gridworld.errors import FolderLostError
from gridworld.storage.safe_read import open_ordinary

_PIECE = 1 << 20  # bytes read at once


class AppendLog:
    """An append-only file that is open for writing. Nothing is buffered: readers see each record at once.

    The file also is the witness that the folder is still this process's: if somebody deleted it, and began
    anew at the same path, whatever writes here raises `FolderLostError`.

    Args:
        path: of a new file, or with `mark` of an existing one.
        mark: to which an existing file is truncated; check it by `holds` before.

    Attributes:
        length: bytes that are in it.
    """

    def __init__(self, path: Path, mark: dict[str, Any] | None = None) -> None:
        self.path = path
        self._file: BinaryIO
        if mark is None:
            if path.is_symlink() or path.is_fifo():
                path.unlink()
            self._file = cast("BinaryIO", path.open("w+b", buffering=0))
        else:
            self._file = open_ordinary(path, "r+b")
        self.length = 0 if mark is None else mark["length"]
        self._sum = _sum_of(path, self.length)
        self._truncate()

    def append(self, record: bytes) -> None:
        """Append a record; if that fails (the disk is full), the file ends with the record before."""
        self.check()
        rest = memoryview(record)
        try:
            while rest:
                rest = rest[self._file.write(rest) :]
        except BaseException:
            self._truncate()
            raise
        self.length += len(record)
        self._sum.update(record)

    def _truncate(self) -> None:
        self._file.truncate(self.length)
        self._file.seek(self.length)

    def content(self) -> bytes:
        """All records."""
        return os.pread(self._file.fileno(), self.length, 0)

    def mark(self) -> dict[str, Any]:
        """The mark of the file's present end."""
        return {"name": self.path.name, "length": self.length, "sha256": self._sum.hexdigest()}

    def sync(self) -> None:
        """Make the file survive a power cut."""
        self.check()
        os.fsync(self._file.fileno())

    def close(self) -> None:
        """Close the file."""
        if not self._file.closed:
            try:
                self.check()
            finally:
                self._file.close()

    def check(self) -> None:
        """Refuse to continue where the file at this path is not this one any more."""
        opened = os.fstat(self._file.fileno())
        if not os.path.lexists(self.path) or not os.path.samestat(os.lstat(self.path), opened):
            raise FolderLostError(f"{self.path}: was deleted or replaced during the run, which ends here")


def holds(folder: Path, mark: Any, pattern: str) -> bool:
    """Whether the file of a mark, which may be anything, is in `folder` and unchanged up to the mark.

    `pattern` says which names the file may have, as for `fnmatch`.
    """
    try:
        path = folder / mark["name"]
        if path.name != mark["name"] or not fnmatchcase(path.name, pattern):
            return False  # it leads elsewhere
        if type(mark["length"]) is not int or not 0 <= mark["length"] <= path.stat().st_size:
            return False
        return bool(_sum_of(path, mark["length"]).hexdigest() == mark["sha256"])
    except (OSError, ValueError, TypeError, KeyError):
        return False


def _sum_of(path: Path, length: int) -> hashlib._Hash:
    """Of the first `length` bytes."""
    found = hashlib.sha256()
    with open_ordinary(path) as file:
        for start in range(0, length, _PIECE):
            found.update(file.read(min(_PIECE, length - start)))
    return found
