"""Whether somebody's method is a function of its argument alone, as far as that can be found out.

It is asked for every argument again and again, in two orders. Before and after, whatever it could remember by
or draw from is looked at: attributes, classes, defaults, closures, globals, and generators of random numbers.
What draws from the operating system or the clock, once in thousands of calls, is beyond this.
"""

from __future__ import annotations

import copy
import dis
import functools
import pickle
import sys
from collections import deque
from collections.abc import Iterable, Iterator
from types import CodeType, FunctionType, MethodType, ModuleType
from typing import Any

import gymnasium as gym
import numpy as np

from gridworld.errors import InputError, in_short
from gridworld.world.sources.snapshots import GENERATORS, generator_state, random_states

_CALLS = 1000  # at least
_MOST_READ = 20_000  # objects
_LIBRARIES = {
    *sys.stdlib_module_names,
    *("gymnasium", "gridworld", "minigrid", "numpy", "sb3_contrib", "scipy", "stable_baselines3", "torch"),
} - {"__main__"}
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
    parts = []
    for each in (one, other):
        reader = _Reader([each], follows_environments=False)
        reader.read({name: value for name, value in sorted(vars(each).items()) if name not in without})
        if not reader.is_complete:
            return False
        parts.append(reader.found)
    return parts[0] == parts[1]


def remembered(where: str, name: str, owner: Any, chain: Iterable[Any] = ()) -> list[Any]:
    """Whatever a method of `owner` could change or draw from, to compare; refuses other environments."""
    reader = _Reader([*chain, owner])
    try:
        reader.read({key: value for key, value in vars(owner).items() if key != "env"})
        for kind in type(owner).__mro__:
            reader.read(kind)
    except _AnotherEnvError:
        raise InputError(f"{where}: {name} looks into an environment{SO_UNKNOWN}") from None
    return [*reader.found, *random_states()]


class _AnotherEnvError(Exception):
    """An environment is referred to that is not the one whose copy is asked."""


class _Reader:
    """Follows references, and lists what can change."""

    def __init__(self, known: Iterable[Any], follows_environments: bool = True) -> None:
        self.found: list[Any] = []
        self.is_complete = True
        self._follows = follows_environments
        self._met: dict[int, Any] = {id(each): each for each in known}
        for each in known:
            if isinstance(each, gym.Env) and follows_environments:
                self.read(each.np_random)

    def read(self, value: Any) -> None:
        if value is None or isinstance(value, bool | int | float | complex | str | bytes | np.generic):
            self.found.append(value if value == value else "nan")
        elif id(value) not in self._met:
            self.is_complete = self.is_complete and len(self._met) < _MOST_READ
            if not self.is_complete:
                return
            self._met[id(value)] = value  # which keeps it, so that ids stay apart
            for part in self._parts(value):
                self.read(part)

    def _parts(self, value: Any) -> Iterator[Any]:
        if isinstance(value, gym.Env):
            if self._follows:
                raise _AnotherEnvError
            yield "environment"
        elif isinstance(value, GENERATORS):
            yield repr(generator_state(value))
        elif isinstance(value, gym.Space):
            yield from (value._np_random, repr(value)) if self._follows else [repr(value)]
        elif isinstance(value, np.ndarray):
            yield from (
                value.tolist() if value.dtype.hasobject else (value.dtype.str, value.shape, value.tobytes())
            )
        elif isinstance(value, FunctionType):
            yield value.__qualname__
            yield from _of_function(value) if not _is_library(value.__module__) else ()
        elif isinstance(value, MethodType | staticmethod | classmethod):
            yield from (getattr(value, "__self__", None), value.__func__)
        elif isinstance(value, property):
            yield from (value.fget, value.fset)
        elif isinstance(value, functools.partial):
            yield from (value.func, value.args, value.keywords)
        elif isinstance(value, type):
            yield value.__qualname__
            yield from list(vars(value).values()) if not _is_library(value.__module__) else ()
        elif isinstance(value, ModuleType):
            yield from _of_module(value) if not _is_library(value.__name__) else ()
        elif isinstance(value, dict):
            for key, inner in value.items():
                yield from (key, inner)
        elif isinstance(value, list | tuple | set | frozenset | deque):
            yield from list(value)
        elif hasattr(value, "__dict__"):
            yield from list(vars(value).values())
            yield from () if _is_library(type(value).__module__) else [type(value)]
        else:
            yield _as_bytes(value)


def _is_library(module: str | None) -> bool:
    return (module or "").partition(".")[0] in _LIBRARIES


def _of_function(function: FunctionType) -> Iterator[Any]:
    yield from (function.__defaults__, function.__kwdefaults__, vars(function), function.__code__.co_code)
    for cell in function.__closure__ or ():
        try:
            yield cell.cell_contents
        except ValueError:  # it has no value yet
            yield None
    for name in _globals_of(function.__code__):
        yield function.__globals__.get(name)


def _globals_of(code: CodeType) -> set[str]:
    names = {str(each.argval) for each in dis.get_instructions(code) if each.opname == "LOAD_GLOBAL"}
    inner = (_globals_of(each) for each in code.co_consts if isinstance(each, CodeType))
    return names.union(*inner)


def _of_module(module: ModuleType) -> Iterator[Any]:
    """Its data: what it imports and defines may be anything."""
    for value in list(vars(module).values()):
        if isinstance(value, int | float | str | list | dict | set | np.ndarray | GENERATORS):
            yield value if not isinstance(value, dict) or "__name__" not in value else None


def _as_bytes(value: Any) -> Any:
    try:
        return pickle.dumps(value)
    except Exception:  # what cannot be written is told by its text
        return repr(value)
