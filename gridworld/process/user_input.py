"""What a user names: a file, an .npz of numpy's, a class or function of their own by its import path."""

from __future__ import annotations

import importlib
import io
import os
import stat
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from os import PathLike
from typing import TYPE_CHECKING, Any, BinaryIO

from gridworld.errors import InputError, install_command
from gridworld.process.console import users_folder
from gridworld.process.memory_budget import check_memory

if TYPE_CHECKING:
    from numpy.typing import NDArray

DAMAGED = (  # what numpy and zipfile raise for a file that is none of theirs
    *(OSError, ValueError, TypeError, LookupError, ArithmeticError, EOFError, SyntaxError, MemoryError),
    *(RuntimeError, struct.error, zipfile.BadZipFile, zlib.error, tokenize.TokenError),
)
COPIES = 3  # the file, its arrays, and what is computed while they are checked
_EXTRAS = {"sb3_contrib": ("sb3-contrib", "contrib")}  # of modules: the package, and what installs it


@contextmanager
def open_users_file(path: str | PathLike[str]) -> Iterator[BinaryIO | None]:
    """Open a file, relative to the folder that the program was started in; None for a pipe or a device.

    Raises `OSError` where it cannot be opened, `ValueError` for a path that is none.
    """
    with open(
        users_folder() / path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK)
    ) as file:
        yield file if stat.S_ISREG(os.fstat(file.fileno()).st_mode) else None


def npz_bytes(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """Arrays as the content of a file, uncompressed, in their order: the same arrays make the same bytes."""
    import numpy as np  # here, since `train.py --help` does not need it

    content = io.BytesIO()
    np.savez(content, **dict[str, Any](arrays))
    return content.getvalue()


def npz_arrays(
    where: object, content: bytes | memoryview, kind: str, most: int | None = None
) -> dict[str, NDArray[Any]]:
    """Read all arrays of an .npz from its content, and nothing pickled; else an `InputError`.

    Args:
        where: the file, for messages; and `kind`, what it must be.
        most: bytes that they may have in memory, for a file that may be compressed. None: as many as the
            file has, which then must not be.
    """
    import numpy as np

    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            infos = archive.infolist()
        size = sum(info.file_size for info in infos)
        # What is compressed, or there twice, could grow in reading.
        if most is None and (size > len(content) or any(info.compress_type for info in infos)):
            raise ValueError("its members are larger than itself")
        if most is not None and size > most:
            raise ValueError(f"its arrays have {size / 2**20:,.0f} MiB, more than {most / 2**20:,.0f}")
        check_memory(where, COPIES * size)
        with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
            return {name: arrays[name] for name in arrays.files}
    except InputError:
        raise
    except DAMAGED as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{where}: not {kind} that can be read ({reason})") from None


def imported(where: str, path: Any) -> Any:
    """Import what a path in the setting `where` names; None where its module has no such name."""
    module, _, name = str(path).rpartition(".")
    try:
        return getattr(importlib.import_module(module), name, None)
    except ModuleNotFoundError as error:
        if error.name in _EXTRAS:
            package, extra = _EXTRAS[error.name]
            raise InputError(f"{where}={path}: needs {package}; {install_command(extra)}") from None
        raise InputError(
            f"{where}={path}: there is no module {error.name}; is the folder that it is in on PYTHONPATH?"
        ) from None
    except (ValueError, TypeError):  # no path at all
        return None
    except Exception as error:  # a module of the user's own may raise anything
        what = f"{module} cannot be imported ({type(error).__name__}: {error})"
        raise InputError(f"{where}={path}: {what}") from error
