"""Writing files whole or not at all."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from numpy.typing import NDArray


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A path beside `path` to write to; it takes `path`'s place if the block ends well, else it is gone.

    Neither of them is written through where it is a symbolic link: the one is made anew, the other replaced.
    An `OSError` names `path`.
    """
    part = _beside(path, "part")
    with _named_for(path, part):
        part.unlink(missing_ok=True)
        os.close(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666))
        try:
            yield part
            os.replace(part, path)
        finally:
            part.unlink(missing_ok=True)


@contextmanager
def replacing_folder(folder: Path) -> Iterator[Path]:
    """A new folder beside `folder` to fill; it takes its place if the block ends well, else it is gone.

    Where `folder` is a symbolic link, the link is replaced. An `OSError` names `folder` or what is in it.
    """
    new, old = _beside(folder, "part"), _beside(folder, "old.part")
    with _named_for(folder, new):
        folder.parent.mkdir(parents=True, exist_ok=True)
        remove(new)
        remove(old)
        new.mkdir()
        try:
            yield new
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
                with suppress(OSError):
                    remove(path)


def _beside(path: Path, kind: str) -> Path:
    """Of this process alone; what a killed one leaves of it is found by the ending `.part`."""
    return path.with_name(f".{path.name}.{os.getpid()}.{kind}")


@contextmanager
def _named_for(path: Path, part: Path) -> Iterator[None]:
    """An `OSError` of the block tells of `path`, where it tells of nothing or of `part`."""
    try:
        yield
    except OSError as error:
        where = Path(os.fsdecode(error.filename or part))
        if where.is_relative_to(part):
            error.filename = str(path / where.relative_to(part))
        raise


def remove(path: Path) -> None:
    """Take away a file or a folder, or a link to one; nothing, where there is none."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write UTF-8."""
    with replacing(path) as part:
        part.write_text(text, encoding="utf-8")


def write_bytes(path: Path, content: bytes) -> None:
    """Write what is encoded already."""
    with replacing(path) as part:
        part.write_bytes(content)


def write_json(path: Path, content: Any) -> None:
    """Write readable JSON; NaN and infinities are refused with a ValueError, since JSON has none."""
    write_text(path, json.dumps(content, indent=2, allow_nan=False) + "\n")


def write_array(path: Path, array: NDArray[Any]) -> None:
    """Write NumPy's own format; `numpy.load` reads it without unpickling anything."""
    import numpy as np  # here, since `train.py --help` gets by without it

    with replacing(path) as part, part.open("wb") as file:  # given a path, NumPy would add .npy to it
        np.save(file, array, allow_pickle=False)
