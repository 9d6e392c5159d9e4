"""Copies and digests of an environment's state.

A state is what the attributes of an environment hold, everything that they refer to included, but for its
random generators. Attributes are copied by pickle, which is four times as fast as `copy.deepcopy`. Spaces and
code are kept as they are: they are read once, and must stay what they were.
"""

from __future__ import annotations

import io
import pickle
import random
import sys
from collections.abc import Collection, Sequence
from types import BuiltinFunctionType, FunctionType, ModuleType
from typing import Any

import gymnasium as gym
import numpy as np

from gridworld.world.reading import GENERATORS, UnreadableError, digest, generator_state

_KEPT = (gym.Space, gym.envs.registration.EnvSpec, FunctionType, BuiltinFunctionType, ModuleType, *GENERATORS)


class Snapshots:
    """Takes copies of the state of an unwrapped environment, always the same one; puts them back."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        self._env = env
        self._kept: dict[int, Any] = {}  # by id
        self._read: dict[int, tuple[Any, bytes]] = {}  # what was kept, and a digest of it
        self._generators: dict[int, Any] = {}  # in what was kept

    def take(self) -> bytes:
        """A copy of the state. Equal copies are of equal states; equal states may have several."""
        buffer = io.BytesIO()
        _Pickler(buffer, self._env, self._kept).dump(vars(self._env))
        return buffer.getvalue()

    def put_back(self, snapshot: bytes) -> None:
        """Make a copy, or rather a copy of it, the environment's state."""
        attributes = vars(self._env)
        attributes.clear()
        attributes.update(_Unpickler(io.BytesIO(snapshot), self._kept).load())

    def key(self, without: Collection[str] = ()) -> bytes:
        """A digest of the state, but for some attributes; UnreadableError where it cannot be compared."""
        attributes = self._attributes(without)
        try:
            return self._digest([part for item in attributes for part in item])
        except UnreadableError:
            for name, value in attributes:
                try:
                    self._digest(value)
                except UnreadableError as error:
                    raise UnreadableError(f"its {name} holds {error}") from None
            raise

    def keys(self, without: Collection[str] = ()) -> dict[str, bytes]:
        """A digest of each attribute."""
        return {name: self._digest(value) for name, value in self._attributes(without)}

    def random_states(self) -> list[tuple[Any, Any]]:
        """The generators anywhere in the state, with their states."""
        found = {id(each): each for each in self._kept.values() if type(each) in GENERATORS}
        return [(each, generator_state(each)) for each in (found | self._generators).values()]

    def changed(self) -> Any:
        """Something of what is kept as it is that changed all the same; None if nothing did."""
        for value, before in self._read.values():
            if digest(value, [self._env], self._generators) != before:
                return value
        return None

    def _digest(self, value: Any) -> bytes:
        return digest(value, [self._env], self._generators, self._kept_value)

    def _kept_value(self, value: Any) -> tuple[Any, Sequence[Any]]:
        if id(value) not in self._read:
            self._read[id(value)] = value, digest(value, [self._env], self._generators)
        return "kept", self._read[id(value)][1:]

    def _attributes(self, without: Collection[str]) -> list[tuple[str, Any]]:
        left_out = {"_np_random", "_np_random_seed", *without}
        return [(name, value) for name, value in sorted(vars(self._env).items()) if name not in left_out]


def _kept(number: int) -> Any:
    """What a copy says in place of an object that is kept as it is; `_Unpickler` reads it."""
    raise NotImplementedError


class _Pickler(pickle.Pickler):
    def __init__(self, file: io.BytesIO, env: Any, kept: dict[int, Any]) -> None:
        super().__init__(file, protocol=5)
        self._env, self._kept_by_id = env, kept

    def reducer_override(self, obj: Any) -> Any:  # three times as fast as `persistent_id`
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


def random_states() -> list[Any]:
    """The states of the generators that all share."""
    torch = sys.modules.get("torch")
    found = [] if torch is None else [torch.get_rng_state().numpy().tobytes()]
    numpys = np.random.get_state(legacy=False)["state"]
    return [*found, random.getstate(), (numpys["key"].tobytes(), numpys["pos"])]
