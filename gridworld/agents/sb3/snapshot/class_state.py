"""State that classes and functions share between instances: attributes, and the defaults of arguments.

A class of one's own is looked at as any object is. The libraries' classes hold a good deal that is none of
training's business, so of these only what has changed since training started counts.
"""

from __future__ import annotations

import enum
import functools
import inspect
import types
from collections.abc import Callable, Iterator
from typing import Any

from gridworld.storage.serialization import StateError

_LIBRARIES = ("builtins", "collections", "abc", "typing", "numpy", "torch", "gymnasium", "stable_baselines3")
_KNOWN = frozenset((*_LIBRARIES, "gridworld", "sb3_contrib", "enum", "functools"))

Put = Callable[[Any], None]
Part = tuple[str, Any, Put]


def is_known(module: str) -> bool:
    """Whether a module, by its name, is ours or one of the libraries'."""
    return module.partition(".")[0] in _KNOWN


def cannot_put(value: Any) -> None:
    """What puts another value where none can be."""
    raise StateError("it cannot be replaced")


class ClassState:
    """Knows the libraries' classes as they were when each was first met, which is when training starts."""

    def __init__(self) -> None:
        self._before: dict[type, dict[str, Any]] = {}

    def parts(self, kind: type, looked_at: set[int]) -> Iterator[tuple[type, list[Part]]]:
        """Every class in the order of inheritance, and what it holds that counts, but for those looked at."""
        for base in kind.__mro__:
            if id(base) in looked_at:
                continue
            looked_at.add(id(base))
            if not is_known(base.__module__):
                yield base, list(_held(base))
            elif base.__module__ != "builtins":
                yield base, self._changed(base)

    def _changed(self, base: type) -> list[Part]:
        held = vars(base)
        if base not in self._before:
            self._before[base] = {name: _copied(value) for name, value in held.items()}
            return []
        before = self._before[base]
        return [
            (name, value, functools.partial(setattr, base, name))
            for name, value in list(held.items())
            if not _is_hidden(name, value) and not (name in before and _is_same(before[name], value))
        ]


def _copied(value: Any) -> Any:
    """With containers of its own, and the same objects in them."""
    if isinstance(value, dict):
        return {key: _copied(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [_copied(inner) for inner in value]
    return value


def _is_same(before: Any, value: Any) -> bool:
    if isinstance(value, dict) and isinstance(before, dict):
        return list(before) == list(value) and all(map(_is_same, before.values(), value.values()))
    if isinstance(value, list | tuple | set | frozenset) and isinstance(before, list):
        return len(before) == len(value) and all(map(_is_same, before, value))
    if isinstance(value, bool | int | float | str | bytes):
        return type(before) is type(value) and repr(before) == repr(value)
    return before is value


def _is_hidden(name: str, value: Any) -> bool:
    """Whether it is a class's own machinery."""
    return (
        name.startswith(("__", "_abc_"))
        or isinstance(value, type)
        or inspect.isroutine(value)
        or inspect.isdatadescriptor(value)
    )


def _held(base: type) -> Iterator[Part]:
    if issubclass(base, enum.Enum):
        return
    for name, value in list(vars(base).items()):
        for function in _functions(value):
            yield name, function, cannot_put
        if not _is_hidden(name, value):
            yield name, value, functools.partial(setattr, base, name)


def _functions(value: Any) -> list[types.FunctionType]:
    """Those that a class's attribute stands for."""
    if isinstance(value, classmethod | staticmethod):
        value = value.__func__
    found = (value.fget, value.fset, value.fdel) if isinstance(value, property) else (value,)
    return [function for function in found if isinstance(function, types.FunctionType)]


def parts_of_function(function: types.FunctionType) -> Iterator[Part]:
    """The variables that it closes over and, unless it is a library's, its attributes and defaults."""
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        try:
            content = cell.cell_contents
        except ValueError:  # nothing is in it yet
            continue
        if name != "__class__":
            yield f"<{name}>", content, functools.partial(setattr, cell, "cell_contents")
    if is_known(function.__module__ or ""):
        return
    for name, value in list(vars(function).items()):
        if not name.startswith("__"):
            yield name, value, functools.partial(setattr, function, name)
    code, defaults = function.__code__, function.__defaults__ or ()
    first = code.co_argcount - len(defaults)
    for index, value in enumerate(defaults):
        yield f"({code.co_varnames[first + index]})", value, functools.partial(_put_default, function, index)
    keywords = function.__kwdefaults__ or {}
    for name, value in keywords.items():
        yield f"({name})", value, functools.partial(keywords.__setitem__, name)


def _put_default(function: types.FunctionType, index: int, value: Any) -> None:
    defaults = list(function.__defaults__ or ())
    defaults[index] = value
    function.__defaults__ = tuple(defaults)
