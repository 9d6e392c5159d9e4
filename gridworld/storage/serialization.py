"""Serialisation of a run's state without pickle.

A state is a tree of dicts (with strings for keys), lists, numbers, strings, booleans, None and numpy arrays.
As bytes it is

    magic | SHA-256 of the rest | length of the JSON | JSON | the arrays' bytes, one after the other

where the JSON has {"@": number} for an array. Zeros at an array's end are left out: a replay buffer is mostly
zeros for long. Reading checks everything before it allocates; nothing in such a file is run, unpickled or
trusted. The checksum is needed: most flipped bits in an array would pass for good numbers.
"""

from __future__ import annotations

import hashlib
import json
import math
import struct
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gridworld.process.memory_budget import BudgetError, check_memory
from gridworld.storage.safe_read import AS_JSON

State = dict[str, Any]

MAGIC = b"gridworld state\x01"
_ARRAY = "@"
_CODES = ("?", "f2", "f4", "f8", *(f"{kind}{size}" for kind in "iu" for size in (1, 2, 4, 8)))
_DTYPES = {np.dtype(code).str for code in _CODES}
_NONSENSE = (ValueError, TypeError, LookupError, RecursionError, MemoryError, struct.error, zlib.error)
_HEAD = len(MAGIC) + 32
_MOST_DIMENSIONS = 16
_MOST_JSON = 1 << 26  # bytes
_MOST_PACKED = 1 << 28
_MOST_MEMORY = 1 << 38
_PLAIN = frozenset((bool, int, float, str))
_SAMPLE = 1 << 10  # bytes in each of about four places of an array
_WORTH_IT = 0.85  # of its size
_ZLIB_HEADER = b"\x78\x01"
_CHUNK = 1 << 16
_ZEROS = bytes(_CHUNK)


class StateError(ValueError):
    """Not a state, only a part of one, or the state of another object."""


def encode(state: State, compress: bool = False) -> list[bytes | memoryview]:
    """Encode a state.

    Args:
        state: the tree.
        compress: with zlib, up to 256 MiB; slower and smaller.

    Returns:
        The bytes in pieces, to be written one after the other; arrays are not copied.

    Raises:
        TypeError: something in it is not part of a state.
    """
    arrays: list[NDArray[Any]] = []
    tree = _fold(state, arrays, (None, "state"))
    stored = [_without_zeros(array) for array in arrays]
    table = [[a.dtype.str, list(a.shape), len(data)] for a, data in zip(arrays, stored, strict=True)]
    text = json.dumps({"arrays": table, "state": tree}, separators=(",", ":")).encode()
    pieces: list[bytes | memoryview] = [struct.pack("<Q", len(text)), text, *stored]
    if compress and sum(map(len, pieces)) <= _MOST_PACKED:
        pieces = [b"z", *_packed(pieces)]
    else:
        pieces.insert(0, b"-")
    checksum = hashlib.sha256()
    for piece in pieces:
        checksum.update(piece)
    return [MAGIC, checksum.digest(), *pieces]


def decode(data: bytes, name: object = "a state") -> State:
    """Decode the bytes of a state.

    Memory is used only for what is not zero in its arrays.

    Args:
        data: what `encode` returned, in one piece.
        name: whose state it is, for the error's sentence.

    Raises:
        StateError: they are no such bytes.
        BudgetError: it would take more memory than the budget.
    """
    if data[: len(MAGIC)] != MAGIC:
        raise StateError("it does not begin as a state does")
    body = memoryview(data)[_HEAD:]
    if hashlib.sha256(body).digest() != data[len(MAGIC) : _HEAD]:
        raise StateError("its checksum is wrong")
    try:
        body = _unpacked(body)
        (length,) = struct.unpack_from("<Q", body)
        if length > min(_MOST_JSON, len(body) - 8):
            raise StateError("its parts do not fit together")
        check_memory(name, AS_JSON * length)
        content = json.loads(bytes(body[8 : 8 + length]))
        arrays = _read_arrays(content["arrays"], body[8 + length :], name)
        state = _unfold(content["state"], arrays)
    except (StateError, BudgetError):
        raise
    except _NONSENSE as error:
        raise StateError(f"its content makes no sense ({type(error).__name__})") from None
    if not isinstance(state, dict):
        raise StateError("its content is no state")
    return state


def same(one: Any, other: Any) -> bool:
    """Whether two states are the same to the last bit."""
    if isinstance(one, np.ndarray) or isinstance(other, np.ndarray):
        return (
            isinstance(one, np.ndarray)
            and isinstance(other, np.ndarray)
            and (one.dtype, one.shape) == (other.dtype, other.shape)
            and one.tobytes() == other.tobytes()
        )
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(same(value, other[key]) for key, value in one.items())
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(map(same, one, other))
    return type(one) is type(other) and (one == other or (one != one and other != other))


@contextmanager
def fitting() -> Iterator[None]:
    """Raise `StateError` for whatever goes wrong in the block, which sets an object to a state."""
    try:
        yield
    except StateError:
        raise
    except (
        *(ArithmeticError, AttributeError, LookupError, MemoryError),
        *(RuntimeError, TypeError, ValueError),
    ) as error:
        raise StateError(f"{type(error).__name__}: {error}") from error


def filled(array: NDArray[Any]) -> int:
    """How many bytes a contiguous array has up to its last one that is not zero."""
    data = array.reshape(-1).view(np.uint8).data
    end = len(data)
    while end:
        start = max(0, end - _CHUNK)
        if bytes(data[start:end]) != _ZEROS[: end - start]:
            return start + int(np.flatnonzero(np.frombuffer(data[start:end], dtype=np.uint8))[-1]) + 1
        end = start
    return 0


def fill(target: NDArray[Any], value: Any, where: str) -> None:
    """Copy an array of a state into `target`.

    Raises:
        StateError: `value` is no array of the same shape and dtype; the sentence begins with `where`.
    """
    if not isinstance(value, np.ndarray) or value.shape != target.shape or value.dtype != target.dtype:
        found = f"{value.dtype} {value.shape}" if isinstance(value, np.ndarray) else type(value).__name__
        raise StateError(f"{where} must be {target.dtype} {target.shape}, is {found}")
    target[...] = value


def _packed(pieces: Sequence[bytes | memoryview]) -> Iterator[bytes | memoryview]:
    """The pieces in zlib's format. Weights do not get smaller, which is found out in a sample of them."""
    checksum, packer = zlib.adler32(b""), zlib.compressobj(1, zlib.DEFLATED, -zlib.MAX_WBITS)
    yield _ZLIB_HEADER
    for piece in pieces:
        checksum = zlib.adler32(piece, checksum)
        if _gets_smaller(piece):
            yield packer.compress(piece)
            continue
        as_it_is = zlib.compressobj(0, zlib.DEFLATED, -zlib.MAX_WBITS)
        # A full flush ends at a whole byte, and what follows does not refer to what was before.
        yield packer.flush(zlib.Z_FULL_FLUSH)
        yield as_it_is.compress(piece) + as_it_is.flush(zlib.Z_FULL_FLUSH)
    yield packer.flush() + struct.pack(">I", checksum)


def _gets_smaller(piece: bytes | memoryview) -> bool:
    if len(piece) < 8 * _SAMPLE:
        return True  # it takes no longer to do it
    sample = b"".join(piece[start : start + _SAMPLE] for start in range(0, len(piece), len(piece) // 4))
    return len(zlib.compress(sample, 1)) < _WORTH_IT * len(sample)


_Place = tuple[Any, object]  # the place of what it is in, and its key there


def _fold(node: Any, arrays: list[NDArray[Any]], where: _Place) -> Any:
    kind = type(node)
    if node is None or kind in _PLAIN:
        return node
    if isinstance(node, dict):
        if not all(type(key) is str and key != _ARRAY for key in node):
            raise TypeError(f"{_told(where)}: a state's keys are strings")
        return {key: _fold(value, arrays, (where, key)) for key, value in node.items()}
    if isinstance(node, list):
        return [_fold(value, arrays, (where, index)) for index, value in enumerate(node)]
    if isinstance(node, np.ndarray):
        if node.dtype.str not in _DTYPES:
            raise TypeError(f"{_told(where)}: arrays of {node.dtype} are not part of a state")
        arrays.append(node)
        return {_ARRAY: len(arrays) - 1}
    raise TypeError(f"{_told(where)}: a {kind.__name__} is not part of a state")


def _told(where: _Place) -> str:
    before, key = where
    if before is None:
        return str(key)
    return f"{_told(before)}[{key}]" if isinstance(key, int) else f"{_told(before)}.{key}"


def _without_zeros(array: NDArray[Any]) -> memoryview:
    """The array's bytes up to the last one that is not zero."""
    array = np.ascontiguousarray(array)
    return array.reshape(-1).view(np.uint8).data[: filled(array)]


def _unpacked(body: memoryview) -> memoryview:
    if bytes(body[:1]) != b"z":
        return body[1:]
    unpacker = zlib.decompressobj()
    content = unpacker.decompress(body[1:], _MOST_PACKED)
    if not unpacker.eof or unpacker.unused_data:
        raise StateError("it unfolds to more than is ever written so")
    return memoryview(content)


def _read_arrays(table: list[Any], data: memoryview, name: object) -> list[NDArray[Any]]:
    arrays, start, total = [], 0, 0
    for code, shape, stored in table:
        if code not in _DTYPES or len(shape) > _MOST_DIMENSIONS:
            raise StateError(f"it has an array of {str(code)[:20]} with {len(shape)} dimensions")
        if not all(type(number) is int and 0 <= number < 2**40 for number in [*shape, stored]):
            raise StateError("it has an array of impossible size")
        dtype = np.dtype(code)
        nbytes = math.prod(shape) * dtype.itemsize
        total += nbytes
        if total > _MOST_MEMORY or stored > nbytes or start + stored > len(data):
            raise StateError("it has more in it than fits")
        check_memory(name, total + len(data))
        whole = np.zeros(nbytes, dtype=np.uint8)
        whole[:stored] = np.frombuffer(data[start : start + stored], dtype=np.uint8)
        arrays.append(whole.view(dtype).reshape(shape))
        start += stored
    if start != len(data):
        raise StateError("it has more in it than it says")
    return arrays


def _unfold(node: Any, arrays: list[NDArray[Any]]) -> Any:
    if isinstance(node, list):
        return [_unfold(value, arrays) for value in node]
    if not isinstance(node, dict):
        return node
    if _ARRAY in node:
        index = node[_ARRAY]
        if type(index) is not int or index < 0 or len(node) != 1:
            raise StateError("it refers to an array that it does not have")
        return arrays[index]
    return {key: _unfold(value, arrays) for key, value in node.items()}
