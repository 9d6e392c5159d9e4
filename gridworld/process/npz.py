"""Numpy's .npz: a zip of plain arrays. Nothing in it is pickled, and nothing pickled is read.

`numpy.load(path)` opens one. The same arrays make the same bytes.
"""

from __future__ import annotations

import io
import tokenize
import zipfile
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gridworld.errors import InputError
from gridworld.process.memory_budget import check_memory

DAMAGED = (  # what numpy and zipfile raise for a file that is none of theirs
    *(OSError, ValueError, TypeError, KeyError, IndexError, EOFError, SyntaxError, MemoryError),
    *(RuntimeError, zipfile.BadZipFile, zlib.error, tokenize.TokenError),
)

COPIES = 3  # the file, its arrays, and what is computed while they are checked


def npz_bytes(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """Arrays as the content of a file, uncompressed, in their order."""
    content = io.BytesIO()
    np.savez(content, **dict[str, Any](arrays))
    return content.getvalue()


def npz_arrays(where: object, content: bytes, kind: str, most: int | None = None) -> dict[str, NDArray[Any]]:
    """Read all arrays.

    Args:
        where: the file, for messages.
        content: of the file.
        kind: what the file must be, for messages.
        most: bytes that they may have in memory, for a file that may be compressed. None: as many as the
            file has, which then must not be.

    Raises:
        InputError: it is no such file, or its arrays would take more than `most` or the memory budget.
    """
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
