"""Copies of an environment's state, and keys that are equal where states are.

A state is what the attributes of the environment hold, everything that they refer to included. Left out are
its random generators: whoever enumerates an environment refuses a step that draws from them.

Attributes are copied by pickle, which is four times as fast as `copy.deepcopy`. What cannot change or cannot
be copied (spaces, functions, modules) is kept as it is.
"""

from __future__ import annotations

import hashlib
import io
import marshal
import pickle
import random
import sys
from collections import deque
from collections.abc import Collection
from enum import Enum
from types import BuiltinFunctionType, FunctionType, ModuleType
from typing import Any

import gymnasium as gym
import numpy as np

GENERATORS = (np.random.Generator, np.random.RandomState, random.Random)
_KEPT = (
    gym.Space,
    gym.envs.registration.EnvSpec,
    FunctionType,
    BuiltinFunctionType,
    ModuleType,
    *GENERATORS,
)
_PLAIN = frozenset({int, float, str, bool, bytes, type(None)})
_CONTAINERS = (list, tuple, dict, set, frozenset, deque, bytearray)
_OF_ITS_RANDOMNESS = ("_np_random", "_np_random_seed")
_SHORT = 16  # numbers; a position is the same whether it is a tuple or an array


class Snapshots:
    """Takes copies of the state of an unwrapped environment, always the same one; puts them back."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        self._env = env
        self._kept: dict[int, Any] = {}  # by id

    def take(self) -> bytes:
        """A copy of the state. Equal copies are of equal states; equal states may have several."""
        buffer = io.BytesIO()
        _Pickler(buffer, self._env, self._kept).dump(vars(self._env))
        return buffer.getvalue()

    def put_back(self, snapshot: bytes) -> None:
        """Make a copy, or rather a copy of it, the environment's state."""
        unpickler = _Unpickler(io.BytesIO(snapshot), self._kept)
        attributes = vars(self._env)
        attributes.clear()
        attributes.update(unpickler.load())

    def key(self, without: Collection[str] = ()) -> bytes:
        """A digest of the state, 16 bytes, but for some attributes; TypeError where it cannot be compared."""
        attributes = {name: value for name, value in self._attributes() if name not in without}
        return _digest(_Reader(self._env).read(attributes))

    def keys(self) -> dict[str, bytes]:
        """A digest of each attribute."""
        return {name: _digest(_Reader(self._env).read(value)) for name, value in self._attributes()}

    def _attributes(self) -> list[tuple[str, Any]]:
        return [each for each in vars(self._env).items() if each[0] not in _OF_ITS_RANDOMNESS]


def key_of(value: Any) -> bytes:
    """A digest, 16 bytes, of an observation."""
    return _digest(_Reader(None).read(value))


def random_states(env: gym.Env[Any, Any] | None = None) -> list[Any]:
    """The states of all generators that a step may draw from: the environment's, and those that all share."""
    torch = sys.modules.get("torch")
    shared = [] if torch is None else [torch.get_rng_state().numpy().tobytes()]
    shared += [random.getstate(), generator_state(np.random.mtrand._rand)]
    if env is None:
        return shared
    sources = [env, *(each for each in vars(env).values() if isinstance(each, (gym.Space, *GENERATORS)))]
    found = [getattr(each, "_np_random", each) for each in sources]
    return shared + [generator_state(each) for each in found if isinstance(each, GENERATORS)]


def generator_state(generator: Any) -> Any:
    """Where a generator of `GENERATORS` is, as a value to compare."""
    if isinstance(generator, random.Random):
        return generator.getstate()
    if isinstance(generator, np.random.Generator):
        return repr(generator.bit_generator.state)
    state = generator.get_state(legacy=False)["state"]
    return state["key"].tobytes(), state["pos"]


def _digest(value: Any) -> bytes:
    # Version 2 of the format writes equal values alike; later ones refer back to the same object.
    return hashlib.blake2b(marshal.dumps(value, 2), digest_size=16).digest()


def _kept(number: int) -> Any:
    """What a copy says in place of an object that is kept as it is; `_Unpickler` reads it."""
    raise NotImplementedError


class _Pickler(pickle.Pickler):
    def __init__(self, file: io.BytesIO, env: Any, kept: dict[int, Any]) -> None:
        super().__init__(file, protocol=5)
        self._env, self._kept_by_id = env, kept

    def reducer_override(self, obj: Any) -> Any:
        local = isinstance(obj, type) and "<locals>" in obj.__qualname__
        if obj is not _kept and (obj is self._env or local or isinstance(obj, _KEPT)):
            self._kept_by_id[id(obj)] = obj
            return _kept, (id(obj),)
        return NotImplemented


class _Unpickler(pickle.Unpickler):
    def __init__(self, file: io.BytesIO, kept: dict[int, Any]) -> None:
        super().__init__(file)
        self._kept_by_id = kept

    def find_class(self, module: str, name: str) -> Any:
        ours = (module, name) == (_kept.__module__, _kept.__name__)
        return self._kept_by_id.__getitem__ if ours else super().find_class(module, name)


class _Reader:
    """Reads a value into nested tuples of plain ones; an object met again is its place in the order."""

    def __init__(self, env: Any) -> None:
        self._met: dict[int, tuple[int, Any]] = {} if env is None else {id(env): (0, env)}

    def read(self, value: Any) -> Any:
        kind = type(value)
        if kind in _PLAIN:
            return value
        if kind is tuple:
            return tuple([self.read(each) for each in value])
        if isinstance(value, np.generic):
            return self.read(value.item())
        if isinstance(value, Enum):
            return kind.__qualname__, value.name
        if isinstance(value, np.ndarray):
            return self._read_array(value)
        if isinstance(value, type):
            return value.__module__, value.__qualname__
        if isinstance(value, _KEPT):
            return type(value).__qualname__, getattr(value, "__qualname__", "")
        return self._read_mutable(value, kind)

    def _read_array(self, value: np.ndarray[Any, Any]) -> Any:
        if value.dtype.hasobject or (value.ndim == 1 and value.size <= _SHORT):
            return self.read(tuple(value.tolist()))
        return value.dtype.str, value.shape, value.tobytes()

    def _read_mutable(self, value: Any, kind: type) -> Any:
        if id(value) in self._met:
            return "again", self._met[id(value)][0]
        self._met[id(value)] = len(self._met), value  # which keeps it, so that ids stay apart
        if kind is list:
            return tuple([self.read(each) for each in value])
        if kind is dict:
            return tuple([(self.read(name), self.read(value[name])) for name in _in_order(value)])
        if kind in (set, frozenset):
            return tuple(sorted((self.read(each) for each in value), key=repr))
        if hasattr(value, "__dict__") and not isinstance(value, _CONTAINERS):
            return kind.__qualname__, self.read(object.__getstate__(value))
        made_by = value.__reduce_ex__(4)
        return made_by if isinstance(made_by, str) else self.read(tuple(map(_listed, made_by)))


def _in_order(names: dict[Any, Any]) -> list[Any]:
    """Sorted where they can be: attributes are set in any order."""
    try:
        return sorted(names)
    except TypeError:
        return list(names)


def _listed(part: Any) -> Any:
    """The items that `__reduce_ex__` gives as an iterator."""
    return list(part) if hasattr(part, "__next__") else part
