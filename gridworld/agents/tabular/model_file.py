"""A table's model file: numpy's .npz, a zip of plain arrays, under the name that all runs have for it.

`numpy.load(path)` opens it. Nothing in it is pickled, and nothing pickled is read.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gridworld.errors import InputError
from gridworld.process.user_input import npz_arrays, npz_bytes
from gridworld.storage.safe_read import read_bytes

_ALGORITHM = "algorithm"
_SPARE_BYTES = 2**20  # for the frames around the arrays


def model_bytes(algorithm: str, arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """The content of a model file: the arrays and the algorithm's name."""
    return npz_bytes({_ALGORITHM: np.array(algorithm), **arrays})


def read_model(path: Path, algorithm: str, like: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Read the arrays of an algorithm's model file.

    Args:
        path: the file.
        algorithm: whose model it must be.
        like: arrays by the names, types and shapes that it must have.
    """
    most = _SPARE_BYTES + sum(array.nbytes for array in like.values())
    found = read_arrays(path, most, algorithm)
    if found.keys() != {_ALGORITHM, *like}:
        raise InputError(
            f"{path}: not a model of {algorithm}: must hold {sorted([_ALGORITHM, *like])}, "
            f"holds {sorted(found)[:8]}"
        )
    written_by = str(found.pop(_ALGORITHM))
    if written_by != algorithm:
        raise InputError(f"{path}: not a model of {algorithm} but of {written_by[:50]}")
    for name, expected in like.items():
        array = found[name]
        if (array.dtype, array.shape) != (expected.dtype, expected.shape):
            raise InputError(
                f"{path}: {name} is {array.dtype} {array.shape}; "
                f"{algorithm} in this world has {expected.dtype} {expected.shape}"
            )
        if not np.isfinite(array).all():
            raise InputError(f"{path}: {name} holds numbers that are not finite")
    return found


def read_arrays(path: Path, most: int, algorithm: str = "a table") -> dict[str, NDArray[Any]]:
    """Read all arrays of a model file.

    Args:
        path: the file.
        most: bytes; a larger file is refused.
        algorithm: for the message.
    """
    content = read_bytes(path, most, copies=3)  # beside it a member and the array in it
    return npz_arrays(path, content, f"a model of {algorithm}")
