"""Atomic writes: a file or folder is written whole or not at all, and durably where that is asked for.

After a power cut, a file that was renamed into its place may be empty, or its name may be the old one: the
disk has a file's content once the file is synced, and its name once the folder is.

What is half written has a name of its own beside the path, and a lock by which others see that somebody is at
it. Each process removes what killed ones left where it writes first.

Whatever writes raises `FolderLostError` where the folder is no longer this process's (see `file_lock`).
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import re
import threading
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gridworld.errors import FolderLostError
from gridworld.storage.file_lock import check_ours, is_at
from gridworld.storage.symlinks import remove_path
from gridworld.storage.system_calls import OPENS_FOLDERS, TO_SYNC, open_carefully, take_lock

if TYPE_CHECKING:
    from numpy.typing import NDArray

_NOT_SYNCED = (errno.EINVAL, errno.ENOTSUP, errno.ENOSYS)  # where a file system cannot sync a folder
_PART = re.compile(r"\..+\.\d+\.(old\.)?part", re.DOTALL)
_tidied: set[str] = set()  # folders, by this process


@contextlib.contextmanager
def replacing(path: Path, durable: bool = False) -> Iterator[Path]:
    """Replace a file atomically: the block writes to a path beside it, which then takes its place.

    If the block raises, the file stays as it was. Where one of the paths is a symbolic link, it is replaced
    and not followed.

    Args:
        path: the file.
        durable: a power cut leaves the old content or the new one.

    Raises:
        FolderLostError: the folder is no longer this process's.
        OSError: it names `path`, not the path beside it.
    """
    check_ours(path)
    part = _beside(path, "part")
    with _named_for(path, part):
        _tidy_once(path.parent)
        with _at_work_on(part):
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


@contextlib.contextmanager
def replacing_folder(folder: Path) -> Iterator[Path]:
    """Replace a folder as a whole: the block fills a new one beside it, which then takes its place.

    If the block raises, the folder stays as it was. Where `folder` is a symbolic link, the link is replaced.

    Raises:
        FolderLostError: the folder above is no longer this process's.
        OSError: it names `folder`, or what is in it.
    """
    check_ours(folder)
    new, old = _beside(folder, "part"), _beside(folder, "old.part")
    with _named_for(folder, new):
        folder.parent.mkdir(parents=True, exist_ok=True)
        _tidy_once(folder.parent)
        remove_path(old)
        with _at_work_on(new, is_folder=True):
            try:
                yield new
                check_ours(folder)
                if os.path.lexists(folder):
                    folder.rename(old)
                try:
                    new.rename(folder)
                except OSError:
                    if os.path.lexists(old):
                        old.rename(folder)
                    raise
            finally:
                for path in (new, old):
                    with contextlib.suppress(OSError, FolderLostError):
                        remove_path(path)


def _beside(path: Path, kind: str) -> Path:
    """A name that no other process uses. `tidy` finds what a killed process leaves."""
    return path.with_name(f".{path.name}.{os.getpid()}.{kind}")


@contextlib.contextmanager
def _at_work_on(part: Path, is_folder: bool = False) -> Iterator[None]:
    """Make an empty file or folder that `tidy` leaves alone during the block."""
    with contextlib.ExitStack() as opened:
        while True:
            remove_path(part)
            part.mkdir() if is_folder else part.touch(exist_ok=False)
            if not OPENS_FOLDERS:
                break
            with contextlib.suppress(FileNotFoundError):
                file = _open(part)
                opened.callback(os.close, file)
                with contextlib.suppress(OSError):  # of a file system without locks
                    take_lock(file, wait=True)
                if is_at(file, part):  # it was not tidied up before it was locked
                    break
        yield


def _open(part: Path) -> int:
    return open_carefully(part, os.O_RDONLY if part.is_dir() else os.O_RDWR)


def _tidy_once(folder: Path) -> None:
    if (where := os.path.abspath(folder)) not in _tidied:
        _tidied.add(where)
        tidy(folder)


@contextlib.contextmanager
def _named_for(path: Path, part: Path) -> Iterator[None]:
    """Let an `OSError` of the block name `path` where it names nothing or `part`."""
    try:
        yield
    except OSError as error:
        where = Path(os.fsdecode(error.filename or part))
        if where.is_relative_to(part):
            error.filename = str(path / where.relative_to(part))
        raise


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
    file = open_carefully(path, TO_SYNC)
    try:
        os.fsync(file)
    finally:
        os.close(file)


@contextlib.contextmanager
def in_background(work: Callable[[], None]) -> Iterator[None]:
    """Run `work`, which waits for a disk, in another thread beside the block; raises what it raises."""
    failures: list[BaseException] = []

    def attempt() -> None:
        try:
            work()
        except BaseException as error:
            failures.append(error)

    thread = threading.Thread(target=attempt, name="sync")
    thread.start()
    try:
        yield
    finally:
        thread.join()
    for failure in failures:
        raise failure


def make_folder(folder: Path) -> None:
    """Make a folder and those above it that are missing; they survive a power cut."""
    if not folder.is_dir():
        make_folder(folder.parent)
        folder.mkdir(exist_ok=True)
        sync_folder(folder.parent)


def tidy(folder: Path) -> None:
    """Remove what killed processes had half written; what somebody is at work on is locked."""
    for path in folder.glob(".*.part"):
        if OPENS_FOLDERS and _PART.fullmatch(path.name) and not path.is_symlink():  # those are nobody's
            with contextlib.suppress(OSError), contextlib.ExitStack() as opened:
                file = _open(path)
                opened.callback(os.close, file)
                if take_lock(file):
                    remove_path(path)


def write_text(path: Path, text: str, durable: bool = False) -> None:
    """Write UTF-8; `durable` as for `replacing`."""
    with replacing(path, durable) as part:
        part.write_text(text, encoding="utf-8")


def write_bytes(path: Path, content: bytes, durable: bool = False) -> None:
    """Write bytes; `durable` as for `replacing`."""
    with replacing(path, durable) as part:
        part.write_bytes(content)


def write_json(path: Path, content: Any, durable: bool = False) -> None:
    """Write indented JSON; `durable` as for `replacing`.

    Raises:
        ValueError: NaN or an infinity is in it, which JSON does not have.
    """
    write_text(path, json_text(content), durable)


def json_text(content: Any) -> str:
    """The text that `write_json` writes."""
    return json.dumps(content, indent=2, allow_nan=False) + "\n"


def write_array(path: Path, array: NDArray[Any]) -> None:
    """Write numpy's own format; `numpy.load` reads it without unpickling anything."""
    import numpy as np  # here, since `train.py --help` does not need it

    with replacing(path) as part, part.open("wb") as file:  # given a path, NumPy would add .npy to it
        np.save(file, array, allow_pickle=False)
