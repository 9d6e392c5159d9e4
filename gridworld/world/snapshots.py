"""What objects hold: copies and digests of an environment's state, and what a method could remember by.

A state is what the attributes of an environment hold, everything that they refer to included, but for its
random generators. Attributes are copied by pickle, which is four times as fast as `copy.deepcopy`. What
cannot change or cannot be copied (spaces, functions, modules) is kept as it is.

A method is a function of its argument alone if it gives the same whenever it is asked, and all that it could
remember by or draw from stays the same: attributes, and by cloudpickle also classes, defaults, closures and
globals, but for those of installed packages.
"""

from __future__ import annotations

import copy
import functools
import hashlib
import io
import marshal
import pickle
import random
import sys
import sysconfig
import threading
import weakref
from collections import deque
from collections.abc import Collection, Iterable
from enum import Enum
from types import BuiltinFunctionType, FunctionType, ModuleType, SimpleNamespace
from typing import Any

import cloudpickle
import gymnasium as gym
import numpy as np

from gridworld.errors import InputError, in_short
from gridworld.workarounds import generator_of

_GENERATORS = (np.random.Generator, np.random.RandomState, random.Random)
_KEPT = (
    *(gym.Space, gym.envs.registration.EnvSpec, FunctionType, BuiltinFunctionType, ModuleType),
    *_GENERATORS,
)
_PLAIN = frozenset({int, float, complex, str, bool, bytes, type(None)})
_REDUCED = (  # classes made of these are read as pickle reduces them
    *(int, float, complex, str, bytes, bytearray, list, tuple, dict, set, frozenset, deque),
    functools.partial,
)
_SHORT = 16  # numbers; a position is the same whether it is a tuple or an array
_TRUSTED = {
    *("gridworld", "gymnasium", "minigrid", "numpy", "sb3_contrib", "scipy", "stable_baselines3", "torch")
}
_INSTALLED = ("site-packages", "dist-packages", sysconfig.get_path("stdlib"))  # in a library's path
_DATA = (int, float, str, list, dict, set, np.ndarray, *_GENERATORS)  # of a module
_LOCKS = (type(threading.Lock()), type(threading.RLock()))
_CACHED = type(functools.lru_cache(lambda: None))
_CALLS = 1000  # at least
SO_UNKNOWN = (
    ", so its effect on the task is not exactly known; leave it out, or make it a function of its argument "
    "alone"
)


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
        """A digest of the state, but for some attributes; TypeError where it cannot be compared."""
        return digest(self._attributes(without), self._env)

    def keys(self, without: Collection[str] = ()) -> dict[str, bytes]:
        """A digest of each attribute."""
        return {name: digest(value, self._env) for name, value in self._attributes(without).items()}

    def _attributes(self, without: Collection[str]) -> dict[str, Any]:
        left_out = {"_np_random", "_np_random_seed", *without}
        return {name: value for name, value in vars(self._env).items() if name not in left_out}


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


def digest(value: Any, *known: Any) -> bytes:
    """16 bytes, equal for equal values; an object met again is a place in the order; `known` are not read."""
    found: list[Any] = []
    waiting = [value]
    met = {id(each): (place, each) for place, each in enumerate(known)}  # objects are kept: ids stay apart
    while waiting:
        value = waiting.pop()
        kind = type(value)
        if kind in _PLAIN:
            found.append(value)
        elif kind is tuple:
            found.append((None, len(value)))
            waiting.extend(value)
        elif id(value) in met:
            found.append(("again", met[id(value)][0]))
        elif isinstance(value, np.generic):
            plain = value.item()
            waiting.append(repr(plain) if isinstance(plain, np.generic) else plain)
        elif (label := _label(value, kind)) is not None:
            found.append(label)
        elif isinstance(value, np.ndarray):
            waiting.append(tuple(value.tolist()))
        else:
            met[id(value)] = len(met), value
            name, parts = _parts(value, kind)
            found.append((name, len(parts)))
            waiting.extend(parts)
    # Version 2 of the format writes equal values alike; later ones refer back to the same object.
    return hashlib.blake2b(marshal.dumps(found, 2), digest_size=16).digest()


def _label(value: Any, kind: type) -> Any:
    """What stands for a value whose parts are no state; None: they are."""
    if isinstance(value, Enum):
        return kind.__qualname__, value.name
    if isinstance(value, type):
        return value.__module__, value.__qualname__
    if isinstance(value, _KEPT):
        return kind.__qualname__, getattr(value, "__qualname__", "")
    if isinstance(value, np.ndarray):
        is_short = value.dtype.hasobject or (value.ndim == 1 and value.size <= _SHORT)
        return None if is_short else (value.dtype.str, value.shape, value.tobytes())
    return None


def _parts(value: Any, kind: type) -> tuple[Any, Collection[Any]]:
    """The parts of an object, and what tells it from others with the same; a list is read like a tuple."""
    if kind is list:
        return None, value
    if kind is dict:
        try:
            names = sorted(value)  # attributes are set in any order
        except TypeError:
            names = list(value)
        return "dict", [part for name in names for part in (name, value[name])]
    if kind in (set, frozenset):
        return "set", sorted(value, key=digest)
    if hasattr(value, "__dict__") and not isinstance(value, _REDUCED):
        return kind.__qualname__, (object.__getstate__(value),)
    made_by = value.__reduce_ex__(4)
    items = (made_by,) if isinstance(made_by, str) else made_by
    return kind.__qualname__, [list(each) if hasattr(each, "__next__") else each for each in items]


def random_states(env: gym.Env[Any, Any] | None = None) -> list[Any]:
    """The states of all generators that a step may draw from: the environment's, and those that all share."""
    torch = sys.modules.get("torch")
    shared = [] if torch is None else [torch.get_rng_state().numpy().tobytes()]
    numpys = np.random.get_state(legacy=False)["state"]
    shared += [random.getstate(), (numpys["key"].tobytes(), numpys["pos"])]
    held = [] if env is None else [env, *vars(env).values()]
    found = [generator_of(each) or each for each in held]
    return shared + [_generator_state(each) for each in found if isinstance(each, _GENERATORS)]


def _generator_state(generator: Any) -> Any:
    if isinstance(generator, random.Random):
        return generator.getstate()
    if isinstance(generator, np.random.Generator):
        return repr(generator.bit_generator.state)
    state = generator.get_state(legacy=False)["state"]
    return state["key"].tobytes(), state["pos"]


def same(one: Any, other: Any) -> bool:
    """Whether two observations, actions or rewards are equal, dictionaries of arrays included."""
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    return np.array_equal(np.asarray(one), np.asarray(other))


def asked(where: str, owner: Any, method: str, arguments: list[Any], chain: Iterable[Any] = ()) -> list[Any]:
    """What a method of `owner` makes of (copies of) each argument; refuses what is not a function of it.

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
        raise InputError(f"{where}: {name} keeps memory or draws random numbers{SO_UNKNOWN}")
    return found


class _AnotherEnvError(Exception):
    """An environment is referred to that is not one of those known."""


class _Reader(cloudpickle.Pickler):  # type: ignore[misc]
    """Writes what objects hold, and the code of `modules`.

    `known` objects are not read; other environments are refused, or `skips_envs`.
    """

    def __init__(self, write: Any, known: Iterable[Any], skips_envs: bool, modules: Collection[str]) -> None:
        super().__init__(SimpleNamespace(write=write), protocol=5)
        self._known = {id(each): place for place, each in enumerate(known)}
        self._skips_envs, self._modules = skips_envs, modules

    def persistent_id(self, obj: Any) -> Any:
        if id(obj) in self._known:
            return self._known[id(obj)]
        if isinstance(obj, FunctionType):  # by its globals: `functools.wraps` gives it another's module
            name = obj.__globals__.get("__name__", "")
            is_of_module = vars(sys.modules.get(name, object)) is obj.__globals__
            if is_of_module and name not in self._modules and obj.__module__ not in self._modules:
                return obj.__qualname__
        if isinstance(obj, type) and obj.__module__ in sys.modules and obj.__module__ not in self._modules:
            return obj.__qualname__
        if isinstance(obj, gym.Env) and not self._skips_envs:
            raise _AnotherEnvError
        if self._skips_envs and isinstance(obj, gym.Env | gym.Space):
            return repr(obj) if isinstance(obj, gym.Space) else "environment"
        return None

    def reducer_override(self, obj: Any) -> Any:
        kind = type(obj)
        if kind is _CACHED:
            return object, (), obj.__wrapped__
        if isinstance(obj, ModuleType) and obj.__name__ in self._modules:
            held = {name: value for name, value in vars(obj).items() if isinstance(value, _DATA)}
            held.pop("__builtins__", None)
            return object, (), held
        if isinstance(obj, (weakref.ref, *_LOCKS)):  # `cached_property` and `singledispatch` have them
            return object, (), obj() if isinstance(obj, weakref.ref) else repr(obj)
        if kind.__module__ in self._modules and not isinstance(obj, (type, *_REDUCED)):
            # also what its own way of being pickled hides
            return object, (), (kind, object.__getstate__(obj), obj.__reduce_ex__(pickle.HIGHEST_PROTOCOL))
        return super().reducer_override(obj)


def _users_modules(package: str) -> dict[str, ModuleType]:
    """The modules whose code is read: those that are not installed, and those of one package."""
    found = {}
    for name, module in list(sys.modules.items()):
        top = name.partition(".")[0]
        if isinstance(module, ModuleType) and top not in _TRUSTED:
            path = vars(module).get("__file__")
            if path is None:
                is_installed = not _is_made_up(module)
            else:
                is_installed = any(part in path for part in _INSTALLED)
            if name == "__main__" or not is_installed or (path and top == package):
                found[module.__name__] = module
    return found


def _is_made_up(module: ModuleType) -> bool:
    """Whether a module without a file was made by `ModuleType` and given code; Cython's have types only."""
    return module.__spec__ is None and any(isinstance(each, FunctionType) for each in vars(module).values())


def _content(owner: Any, value: Any, known: Iterable[Any], skips_envs: bool = False) -> bytes:
    """A digest of what a value holds, and of the code that it and the class of `owner` refer to."""
    found = hashlib.sha256()
    modules = _users_modules(type(owner).__module__.partition(".")[0])
    names = modules.keys() & sys.modules.keys() - cloudpickle.list_registry_pickle_by_value()
    for name in names:
        cloudpickle.register_pickle_by_value(modules[name])
    try:
        _Reader(found.update, known, skips_envs, modules.keys()).dump(value)
    finally:
        for name in names:
            cloudpickle.unregister_pickle_by_value(modules[name])
    return found.digest()


def _held(owner: Any, without: Collection[str]) -> list[tuple[str, Any]]:
    return [(name, value) for name, value in sorted(vars(owner).items()) if name not in without]


def alike(one: Any, other: Any, without: Collection[str] = ()) -> bool:
    """Whether two objects of one class hold the same values and functions, but for some attributes."""
    if type(one) is not type(other):
        return False
    pair = [(each, _held(each, without), [each]) for each in (one, other)]
    try:
        mine, theirs = (_content(*each, skips_envs=True) for each in pair)
    except Exception:  # what cannot be read may differ
        return False
    return mine == theirs


def remembered(where: str, name: str, owner: Any, chain: Iterable[Any] = ()) -> list[Any]:
    """Whatever a method of `owner` could change or draw from, to compare; refuses what cannot be read."""
    known = [*chain, owner]
    envs = [each for each in known if isinstance(each, gym.Env)]
    generators = [(env.np_random, env.action_space, env.observation_space) for env in envs]
    try:
        found = _content(owner, (generators, _held(owner, ("env",)), type(owner)), known)
    except _AnotherEnvError:
        raise InputError(f"{where}: {name} reads from an environment{SO_UNKNOWN}") from None
    except Exception as error:  # open files, generators, sockets
        cannot = f"what {name} refers to cannot be read ({in_short(error)})"
        raise InputError(f"{where}: {cannot}{SO_UNKNOWN}") from error
    return [found, *random_states()]
