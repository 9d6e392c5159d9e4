"""Atomic writes: a file, a folder or a log's record is there whole or not at all, durably where asked for.

After a power cut, a file that was renamed into its place may be empty, or its name may be the old one, since
the disk has a file's content once the file is synced, and its name once the folder is. What is half written
has a name of its own beside the path, `.NAME.PROCESS.part`.

A process that is at work in a folder holds a lock in it (`locked`), which the operating system releases when
the process ends, however it ends.

A mark of a log is the file's name, its length and the SHA-256 of its content. A run that continues from a
checkpoint truncates its logs to the checkpoint's marks: no record is there twice, and none is missing.

The folder `top` that a user named may be a link, since that is the user's. A link in it may be anybody's, and
lead to any folder of the reader's: `inside` goes through none.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import hashlib
import json
import os
import re
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, BinaryIO, cast

from filelock import FileLock, Timeout

from gridworld.base.errors import FolderLostError
from gridworld.base.safe_read import check_no_link, open_ordinary

_SECONDS_BETWEEN_TRIES = 0.02
_PIECE = 1 << 20  # bytes of a log that are read at once
_PART = re.compile(r"\..+\.(\d{1,9})\.(old\.)?part", re.DOTALL)


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

    If the block raises, the file stays as it was, and an `OSError` names it. A symbolic link is replaced and
    not followed. Where that is to be `durable`, a power cut leaves the old content or the new one.
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
    except OSError as error:
        return error.errno == errno.EPERM  # it is another user's
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


class AppendLog:
    """An append-only file that is open for writing. Nothing is buffered: readers see each record at once.

    It is a new file, or with a `mark`, which `holds` has checked, an existing one truncated to that. The file
    also is the witness that the folder is still this process's: if somebody deleted it, and began anew at the
    same path, whatever writes here raises `FolderLostError`.
    """

    def __init__(self, path: Path, mark: dict[str, Any] | None = None) -> None:
        self.path = path
        self._file: BinaryIO
        if mark is None:
            path.unlink(missing_ok=True)  # it may be a link or a pipe
            self._file = cast("BinaryIO", path.open("w+b", buffering=0))
        else:
            self._file = open_ordinary(path, "r+b")
        self.length = 0 if mark is None else mark["length"]  # bytes that are in it
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
            raise FolderLostError(f"{self.path}: was deleted or replaced during the run, which stops here")


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
