"""What Python objects hold: copies of an environment's state, and digests that are equal where states are.

A state is what the attributes of the environment hold, everything that they refer to included, but for its
random generators. Attributes are copied by pickle, which is four times as fast as `copy.deepcopy`. What
cannot change or cannot be copied (spaces, functions, modules) is kept as it is.
"""

from __future__ import annotations

import copy
import dis
import functools
import hashlib
import io
import marshal
import pickle
import random
import sys
from collections import deque
from collections.abc import Collection, Iterable, Iterator
from enum import Enum
from types import BuiltinFunctionType, CodeType, FunctionType, GeneratorType, MethodType, ModuleType
from typing import Any

import gymnasium as gym
import numpy as np

from gridworld.errors import InputError, in_short

GENERATORS = (np.random.Generator, np.random.RandomState, random.Random)
_SPEC = gym.envs.registration.EnvSpec
_KEPT = (gym.Space, _SPEC, FunctionType, BuiltinFunctionType, ModuleType, *GENERATORS)
_PLAIN = frozenset({int, float, complex, str, bool, bytes, type(None)})
_NUMBERS_AND_TEXTS: tuple[type, ...] = (
    int,
    float,
    complex,
    str,
    bytes,
    bytearray,
)  # and classes made of them
_REDUCED = (*_NUMBERS_AND_TEXTS, list, tuple, dict, set, frozenset, deque, functools.partial)
_OF_ITS_RANDOMNESS = ("_np_random", "_np_random_seed")
_SHORT = 16  # numbers; a position is the same whether it is a tuple or an array
_MOST_READ = 20_000  # objects that a deep reader follows
_LIBRARIES = {
    *sys.stdlib_module_names,
    *("gymnasium", "gridworld", "minigrid", "numpy", "sb3_contrib", "scipy", "stable_baselines3", "torch"),
} - {"__main__"}
_REFERENCES = {  # that a deep reader follows
    MethodType: ("__self__", "__func__"),
    BuiltinFunctionType: ("__self__",),
    staticmethod: ("__func__",),
    classmethod: ("__func__",),
    property: ("fget", "fset"),
}


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
        attributes = vars(self._env)
        attributes.clear()
        attributes.update(_Unpickler(io.BytesIO(snapshot), self._kept).load())

    def key(self, without: Collection[str] = ()) -> bytes:
        """A digest of the state, 16 bytes, but for some attributes; TypeError where it cannot be compared."""
        return Reader([self._env]).digest({k: v for k, v in self._attributes() if k not in without})

    def keys(self) -> dict[str, bytes]:
        """A digest of each attribute."""
        return {name: Reader([self._env]).digest(value) for name, value in self._attributes()}

    def _attributes(self) -> list[tuple[str, Any]]:
        return [each for each in vars(self._env).items() if each[0] not in _OF_ITS_RANDOMNESS]


def key_of(value: Any) -> bytes:
    """A digest, 16 bytes, of an observation."""
    return Reader().digest(value)


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


class AnotherEnvError(Exception):
    """An environment is referred to that is not one of those known."""


class Reader:
    """Reads values into a list of plain ones; an object met again is its place in the order.

    `known` are objects that are not read. A `deep` reader also follows what functions, classes, modules and
    generators could remember by, libraries excepted; other environments are an `AnotherEnvError`, or skipped.
    """

    def __init__(self, known: Iterable[Any] = (), deep: bool = False, skips_envs: bool = False) -> None:
        self.is_complete = True
        self._found: list[Any] = []
        self._deep, self._skips_envs = deep, skips_envs
        # Objects are kept, so that ids stay apart.
        self._met: dict[int, tuple[int, Any]] = {id(each): (n, each) for n, each in enumerate(known)}

    def digest(self, *values: Any) -> bytes:
        """16 bytes, equal for equal values."""
        self._read(values)
        # Version 2 of the format writes equal values alike; later ones refer back to the same object.
        return hashlib.blake2b(marshal.dumps(self._found, 2), digest_size=16).digest()

    def _read(self, waiting: Iterable[Any]) -> None:
        waiting = list(waiting)
        while waiting:
            value = waiting.pop()
            kind = type(value)
            if kind in _PLAIN:
                self._found.append(value)
            elif kind is tuple:
                self._found.append((None, len(value)))
                waiting.extend(value)
            elif id(value) in self._met:
                self._found.append(("again", self._met[id(value)][0]))
            elif isinstance(value, np.generic):
                plain = value.item()
                waiting.append(repr(plain) if isinstance(plain, np.generic) else plain)
            elif self._deep:
                if len(self._met) >= _MOST_READ:
                    self.is_complete = False
                    return
                self._met[id(value)] = len(self._met), value
                self._add(*self._followed(value, kind), waiting)
            elif (label := _label(value, kind)) is not None:
                self._found.append(label)
            elif isinstance(value, np.ndarray):
                waiting.append(tuple(value.tolist()))
            else:
                self._met[id(value)] = len(self._met), value
                self._add(*_parts(value, kind), waiting)

    def _add(self, label: Any, parts: Collection[Any], waiting: list[Any]) -> None:
        self._found.append((label, len(parts)))
        waiting.extend(parts)

    def _followed(self, value: Any, kind: type) -> tuple[Any, Collection[Any]]:
        """What a deep reader reads of a value, and follows."""
        name = kind.__qualname__
        if isinstance(value, gym.Env):
            if self._skips_envs:
                return "environment", ()
            raise AnotherEnvError
        if isinstance(value, GENERATORS):
            return repr(generator_state(value)), ()
        if isinstance(value, gym.Space):
            return repr(value), () if self._skips_envs else (value._np_random,)
        if isinstance(value, np.ndarray):
            objects = value.dtype.hasobject
            label = value.dtype.str, value.shape, b"" if objects else value.tobytes()
            return label, (value.tolist(),) if objects else ()
        if isinstance(value, FunctionType):
            return value.__qualname__, () if _is_library(value) else list(_of_function(value))
        if isinstance(value, GeneratorType):
            frame = value.gi_frame
            return name, () if frame is None else (frame.f_lasti, dict(frame.f_locals))
        if isinstance(value, ModuleType):
            return value.__name__, () if _is_library(value) else list(_of_module(value))
        if isinstance(value, type):
            return value.__qualname__, () if _is_library(value) else list(vars(value).values())
        if kind in (dict, set, frozenset):  # in their own order, which may be a memory too
            return name, [part for each in value.items() for part in each] if kind is dict else list(value)
        for kinds, references in _REFERENCES.items():
            if isinstance(value, kinds):
                return name, [getattr(value, each, None) for each in references]
        try:
            _, parts = _parts(value, kind)
        except Exception:  # what cannot be read is known by its text
            return repr(value), ()
        return name, [*parts, *(() if kind is list or _is_library(kind) else (kind,))]


def _label(value: Any, kind: type) -> Any:
    """What stands for a value whose parts are no state; None: they are."""
    if isinstance(value, Enum):
        return kind.__qualname__, value.name
    if isinstance(value, type):
        return value.__module__, value.__qualname__
    if isinstance(value, _KEPT):
        return kind.__qualname__, getattr(value, "__qualname__", "")
    if isinstance(value, np.ndarray) and not (
        value.dtype.hasobject or (value.ndim == 1 and value.size <= _SHORT)
    ):
        return value.dtype.str, value.shape, value.tobytes()
    return None


def _parts(value: Any, kind: type) -> tuple[Any, Collection[Any]]:
    """The parts of an object, and what tells it from others with the same; a list is read like a tuple."""
    if kind is list:
        return None, value
    if kind is dict:
        return "dict", [part for name in _in_order(value) for part in (name, value[name])]
    if kind in (set, frozenset):
        return "set", sorted(value, key=key_of)
    if hasattr(value, "__dict__") and not isinstance(value, _REDUCED):
        return kind.__qualname__, (object.__getstate__(value),)
    made_by = value.__reduce_ex__(4)
    items = (made_by,) if isinstance(made_by, str) else made_by
    return kind.__qualname__, [list(each) if hasattr(each, "__next__") else each for each in items]


def _in_order(names: dict[Any, Any]) -> list[Any]:
    """Sorted where they can be: attributes are set in any order."""
    try:
        return sorted(names)
    except TypeError:
        return list(names)


def _is_library(value: Any) -> bool:
    name = value.__name__ if isinstance(value, ModuleType) else value.__module__
    return str(name or "").partition(".")[0] in _LIBRARIES


def _of_function(function: FunctionType) -> Iterator[Any]:
    yield from (function.__defaults__, function.__kwdefaults__, vars(function), function.__code__.co_code)
    for cell in function.__closure__ or ():
        try:
            yield cell.cell_contents
        except ValueError:  # it has no value yet
            yield None
    for name in sorted(_globals_of(function.__code__)):
        yield function.__globals__.get(name)


def _globals_of(code: CodeType) -> set[str]:
    names = {str(each.argval) for each in dis.get_instructions(code) if each.opname == "LOAD_GLOBAL"}
    return names.union(*(_globals_of(each) for each in code.co_consts if isinstance(each, CodeType)))


def _of_module(module: ModuleType) -> Iterator[Any]:
    """Its data: what it imports and defines may be anything."""
    for value in list(vars(module).values()):
        if isinstance(value, (int, float, str, list, dict, set, np.ndarray, *GENERATORS)):
            yield value if not isinstance(value, dict) or "__name__" not in value else None


_CALLS = 1000  # at least
SO_UNKNOWN = (
    ", so what it makes of the task is not exactly known; "
    "leave it out, or make it a function of its argument alone"
)


def asked(where: str, owner: Any, method: str, arguments: list[Any], chain: Iterable[Any] = ()) -> list[Any]:
    """What a method of `owner` makes of (copies of) each argument; refuses what is no function of it alone.

    `chain` are the environments that it may refer to; `where` is what messages call the environment.
    """
    name, ask = f"{method}() of {type(owner).__name__}", getattr(owner, method)

    def all_of(order: list[Any]) -> list[Any]:
        return [copy.deepcopy(ask(copy.deepcopy(each))) for each in order]

    try:
        found = all_of(arguments)
        before = remembered(where, name, owner, chain)
        for order in [*[-1] * (1 + _CALLS // max(1, len(arguments))), 1]:  # backwards, at last forwards
            again = all_of(arguments[::order])[::order]
            for argument, one, other in zip(arguments, found, again, strict=True):
                if not same(one, other):
                    raise InputError(
                        f"{where}: {name} does not always give the same for {str(argument)[:50]}{SO_UNKNOWN}"
                    )
    except InputError:
        raise
    except Exception as error:  # it may be anybody's
        raise InputError(f"{where}: {name} raised {in_short(error)}") from error
    if remembered(where, name, owner, chain) != before:
        raise InputError(f"{where}: {name} keeps a memory or draws random numbers{SO_UNKNOWN}")
    return found


def same(one: Any, other: Any) -> bool:
    """Whether two observations, actions or rewards are equal, dictionaries of arrays included."""
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    return np.array_equal(np.asarray(one), np.asarray(other))


def alike(one: Any, other: Any, without: Iterable[str] = ()) -> bool:
    """Whether two objects of one class hold the same values and functions, but for some attributes."""
    if type(one) is not type(other):
        return False
    digests = set()
    for each in (one, other):
        reader = Reader([each], deep=True, skips_envs=True)
        digests.add(reader.digest(*((k, v) for k, v in sorted(vars(each).items()) if k not in without)))
        if not reader.is_complete:
            return False
    return len(digests) == 1


def remembered(where: str, name: str, owner: Any, chain: Iterable[Any] = ()) -> list[Any]:
    """Whatever a method of `owner` could change or draw from, to compare; refuses other environments."""
    known = [*chain, owner]
    held = {key: value for key, value in vars(owner).items() if key != "env"}
    generators = [each.np_random for each in known if isinstance(each, gym.Env)]
    try:
        digest = Reader(known, deep=True).digest(generators, held, *type(owner).__mro__)
    except AnotherEnvError:
        raise InputError(f"{where}: {name} looks into an environment{SO_UNKNOWN}") from None
    return [digest, *random_states()]
