"""A run's state as bytes without pickle, and the state of random generators.

A state is a tree of dicts (with strings for keys), lists, numbers, strings, booleans, None and numpy arrays.
As bytes it is what `numpy.savez` writes: a zip with an array in each member, named by its place in the tree,
and one of JSON, `state.json`, which has {"@": member} for an array. The zip has a checksum of each member,
which is needed: most flipped bits in an array would pass for good numbers.
"""

from __future__ import annotations

import io
import json
import random
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gridworld.base.errors import InputError
from gridworld.base.safe_read import AS_JSON
from gridworld.base.user_input import BudgetError, check_memory, npz_arrays

State = dict[str, Any]

_TREE = "state.json"
_ARRAY = "@"
_KINDS = "bfiu"  # of arrays, as numpy abbreviates them
_PLAIN = frozenset((bool, int, float, str))
_MOST = 1 << 38  # bytes of arrays


class StateError(ValueError):
    """Not a state, only a part of one, or the state of another object."""


def encode(state: State, compress: bool = False) -> memoryview:
    """Encode a state, compressed or not; a `TypeError` where something in it is not part of a state."""
    arrays: dict[str, NDArray[Any]] = {}
    tree = json.dumps(_fold(state, arrays, "state"), separators=(",", ":"))
    method = zipfile.ZIP_DEFLATED if compress else zipfile.ZIP_STORED
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        archive.writestr(zipfile.ZipInfo(_TREE), tree)
        for name, array in arrays.items():
            # `ZipInfo` by name alone has no time: the same state, the same bytes.
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), npy_bytes(array), method, compresslevel=1)
    return content.getbuffer()


def decode(data: bytes | memoryview, name: object = "a state") -> State:
    """Decode the bytes of a state, or raise `StateError`; `name` says whose it is, for a `BudgetError`."""
    try:
        members: dict[str, Any] = npz_arrays(name, data, "a state", _MOST)
        tree = members.pop(_TREE)
        check_memory(name, AS_JSON * len(tree))
        state = json.loads(tree, object_hook=partial(_array_or_mapping, members))
    except BudgetError:
        raise
    except InputError as error:
        raise StateError(str(error).removeprefix(f"{name}: ")) from None
    except (ValueError, TypeError, LookupError, RecursionError) as error:
        raise StateError(f"its content is invalid ({type(error).__name__})") from None
    if not isinstance(state, dict):
        raise StateError("its content is not a state")
    return state


@contextmanager
def fitting() -> Iterator[None]:
    """Raise `StateError` for whatever goes wrong in the block, which sets an object to a state."""
    try:
        yield
    except StateError:
        raise
    except Exception as error:
        raise StateError(f"{type(error).__name__}: {error}") from error


def fill(target: NDArray[Any], value: Any, where: str) -> None:
    """Copy an array of a state into `target`; a `StateError` where shape or dtype differ names `where`."""
    if not isinstance(value, np.ndarray) or value.shape != target.shape or value.dtype != target.dtype:
        found = f"{value.dtype} {value.shape}" if isinstance(value, np.ndarray) else type(value).__name__
        raise StateError(f"{where} must be {target.dtype} {target.shape}, is {found}")
    target[...] = value


def npy_bytes(array: NDArray[Any]) -> bytes:
    """An array in numpy's own format; `numpy.load` reads it without unpickling anything."""
    content = io.BytesIO()
    np.lib.format.write_array(content, np.asarray(array, order="C"), allow_pickle=False)
    return content.getvalue()


def _fold(node: Any, arrays: dict[str, NDArray[Any]], where: str) -> Any:
    if node is None or type(node) in _PLAIN:
        return node
    if isinstance(node, dict):
        if not all(type(key) is str and key != _ARRAY for key in node):
            raise TypeError(f"{where}: a state's keys are strings")
        return {key: _fold(value, arrays, f"{where}.{key}") for key, value in node.items()}
    if isinstance(node, list):
        return [_fold(value, arrays, f"{where}[{index}]") for index, value in enumerate(node)]
    if isinstance(node, np.ndarray):
        if node.dtype.kind not in _KINDS:
            raise TypeError(f"{where}: arrays of {node.dtype} are not part of a state")
        while where in arrays:  # where a key has a dot
            where += "_"
        arrays[where] = node
        return {_ARRAY: where}
    raise TypeError(f"{where}: a {type(node).__name__} is not part of a state")


def _array_or_mapping(arrays: dict[str, Any], node: dict[str, Any]) -> Any:
    if _ARRAY not in node:
        return node
    if len(node) != 1 or not isinstance(array := arrays[node[_ARRAY]], np.ndarray):
        raise ValueError
    return array


def independent_generator(seed: int) -> np.random.Generator:
    """The generator of the seed's first spawned child (`numpy.random.SeedSequence.spawn`).

    It is independent of `np.random.default_rng(seed)`. Where both an environment and who acts in it draw, one
    of them takes this one; else actions, slips and starts would depend on each other.
    """
    return np.random.default_rng(np.random.SeedSequence(seed).spawn(1)[0])


def generator_state(generator: np.random.Generator) -> State:
    """The state of one of numpy's generators."""
    return dict(generator.bit_generator.state)


def set_generator_state(generator: np.random.Generator, state: State) -> None:
    """Set a generator to the state of another of its kind; else a `ValueError`."""
    generator.bit_generator.state = state


def global_state() -> State:
    """The state of the global generators, Python's and numpy's."""
    version, numbers, gauss = random.getstate()
    return {
        "python": {"version": version, "numbers": np.array(numbers, dtype=np.uint32), "gauss": gauss},
        "numpy": np.random.get_state(legacy=False),
    }


def set_global_state(state: State) -> None:
    """Set the global generators to a state; a `ValueError` where it is not theirs."""
    python = state["python"]
    random.setstate((python["version"], tuple(map(int, python["numbers"])), python["gauss"]))
    np.random.set_state(state["numpy"])
