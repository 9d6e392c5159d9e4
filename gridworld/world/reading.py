"""What values hold, read exactly: equal digests are of equal values, and what may hide something is refused.

A value is read by what its class is made of, whatever the class says when it is compared. Classes written in
C are read if they are listed here; a class that says itself how it is pickled or copied is refused.
"""

from __future__ import annotations

import array
import datetime
import decimal
import fractions
import functools
import hashlib
import marshal
import operator
import random
import sys
from collections import Counter, OrderedDict, defaultdict, deque, namedtuple
from collections.abc import Callable, Iterable, Sequence
from enum import Enum
from types import (
    BuiltinFunctionType,
    ClassMethodDescriptorType,
    CodeType,
    FunctionType,
    GetSetDescriptorType,
    MappingProxyType,
    MemberDescriptorType,
    MethodDescriptorType,
    MethodType,
    MethodWrapperType,
    ModuleType,
    SimpleNamespace,
    WrapperDescriptorType,
)
from typing import Any

import gymnasium as gym
import numpy as np

GENERATORS = frozenset({np.random.Generator, np.random.RandomState, random.Random})
PLAIN = frozenset({int, float, complex, str, bool, bytes, type(None), type(Ellipsis)})
_BUILT_IN = (list, dict, set, frozenset, tuple, int, float, complex, str, bytes)  # and what derives from them
_REDUCED = (  # read as pickle reduces them, which is exact; what derives from them is refused
    *(range, slice, bytearray, deque, OrderedDict, defaultdict, Counter, array.array, SimpleNamespace),
    *(decimal.Decimal, fractions.Fraction, datetime.date, datetime.time, datetime.datetime),
    *(datetime.timedelta, datetime.timezone, functools.partial),
    *(operator.itemgetter, operator.attrgetter, operator.methodcaller),
    type(vars(namedtuple("_Named", "field"))["field"]),  # a field's descriptor
)
_HIDING = ("__reduce_ex__", "__reduce__", "__getstate__", "__setstate__", "__deepcopy__")
_CACHED = type(functools.lru_cache(lambda: None))
OF_A_CLASS = (MethodDescriptorType, WrapperDescriptorType, ClassMethodDescriptorType)  # functions in C
_SHORT = 16  # numbers; a position is the same whether it is a tuple or an array
# Libraries whose code is a function of its arguments, but for what is left out again.
_PURE = {
    *("abc", "array", "bisect", "builtins", "cmath", "collections", "copy", "cv2", "dataclasses", "decimal"),
    *("enum", "fractions", "functools", "itertools", "math", "numbers", "numpy", "operator", "scipy"),
    *("statistics", "string", "types", "typing", "_operator", "_functools", "_collections", "_bisect"),
    *("_statistics", "gymnasium.core", "gymnasium.spaces"),
}
_IMPURE = {"numpy.random", "scipy.stats"}

Way = Callable[[Any], tuple[Any, Sequence[Any]]]  # of a value: what stands for its kind, and its parts


class UnreadableError(TypeError):
    """A value that may hold more than can be read; says what it is, as an object of a sentence."""


def is_pure(module: Any) -> bool:
    """Whether all that a module's code does is a function of its arguments."""
    parts = str(module).split(".")
    names = {parts[0], ".".join(parts[:2])}
    return bool(names & _PURE) and not names & _IMPURE


def imported_name(value: Any) -> str | None:
    """The dotted name under which a function or class is found in its module; None: it is not found."""
    name = getattr(value, "__qualname__", None) or getattr(value, "__name__", None)
    own = getattr(value, "__module__", None)
    for module in ("numpy", "scipy.special") if isinstance(value, np.ufunc) else (own,):
        found = sys.modules.get(str(module))
        for part in str(name).split("."):
            found = getattr(found, "__dict__", {}).get(part)
        if found is value or getattr(found, "__func__", None) is value:
            return f"{module}.{name}"
    return None


def digest(
    value: Any,
    known: Iterable[Any] = (),
    generators: dict[int, Any] | None = None,
    kept: Way | None = None,
    kinds: bool = False,
) -> bytes:
    """16 bytes, equal for equal values.

    An object met again is a place in the order. `known` are objects that are not read. The states of random
    generators are read, or the generators put into `generators`. What `kept` says stands for spaces and code.
    Only with `kinds` numbers of different types, lists, tuples and short arrays differ that hold the same.
    """
    found: list[Any] = []
    waiting = [value]
    met = {id(each): (place, each) for place, each in enumerate(known)}  # objects are held: ids stay apart
    while waiting:
        value = waiting.pop()
        kind = type(value)
        if kinds and kind is not list and (kind is tuple or issubclass(kind, np.ndarray | np.generic)):
            found.append(str(getattr(value, "dtype", "tuple")))
        if kind in PLAIN:
            found.append(value)
        elif kind is tuple:
            found.append((None, len(value)))
            waiting.extend(value)
        elif issubclass(kind, np.generic):
            waiting.append(_scalar(value))
        elif id(value) in met:
            found.append(("again", met[id(value)][0]))
        else:
            met[id(value)] = len(met), value
            way = _WAYS.get(kind) or way_of(kind, value)
            if generators is not None and kind in GENERATORS:
                generators[id(value)] = value
                found.append(kind.__name__)
            else:
                name, parts = kept(value) if kept is not None and way in _OF_KEPT else way(value)
                found.append((name, len(parts)))
                waiting.extend(parts)
    # Version 2 of the format writes equal values alike; later ones refer back to the same object.
    return hashlib.blake2b(marshal.dumps(found, 2), digest_size=16).digest()


def way_of(kind: type, value: Any) -> Way:
    """How values of a class are read; refuses one whose values may hide something."""
    if kind not in _WAYS:
        derived = (way for base, way in _DERIVED if issubclass(kind, base))
        _WAYS[kind] = next(derived, None) or _by_layout(kind, value)
    return _WAYS[kind]


def _by_layout(kind: type, value: Any) -> Way:
    if is_pure(kind.__module__) and is_pure(imported_name(value)):  # a function written in C
        return _imported
    name, base = _label(kind), next((each for each in _BUILT_IN if issubclass(kind, each)), object)
    refuse_hiding(value, base)
    if base is object:
        try:
            object.__reduce_ex__(value, 4)
        except TypeError:
            raise _unreadable(value, ", which cannot be read") from None

    def held(value: Any) -> list[Any]:  # in its dictionary and slots
        state = object.__getstate__(value)
        return [part for each in (state if type(state) is tuple else (state,)) for part in _sorted(each)]

    if kind is list:
        return lambda value: (None, value)
    if base is object:
        return lambda value: (name, held(value))
    contents = _CONTENTS.get(base) or base.__getnewargs__  # type: ignore[attr-defined]
    if kind is base:
        return lambda value: (name, contents(value))
    return lambda value: (name, [tuple(contents(value)), *held(value)])


def refuse_hiding(value: Any, base: type = object) -> None:
    """Refuse a value that is pickled or copied otherwise than those of a base class."""
    kind = type(value)
    if own := [each for each in _HIDING if getattr(kind, each, None) is not getattr(base, each, None)]:
        raise _unreadable(value, f", whose {own[0]} may hide what it holds")


def _unreadable(value: Any, why: str) -> UnreadableError:
    module, name = (getattr(value, each, None) for each in ("__module__", "__qualname__"))  # of a function
    return UnreadableError(f"{module}.{name}" if module and name else f"a {type(value).__qualname__}{why}")


def _sorted(attributes: dict[str, Any] | None) -> list[Any]:  # attributes are set in any order
    return [part for name in sorted(attributes or ()) for part in (name, (attributes or {})[name])]


_CONTENTS: dict[type, Any] = {
    list: lambda value: [*list.__iter__(value)],
    tuple: lambda value: [*tuple.__iter__(value)],
    dict: lambda value: [part for item in dict.items(value) for part in item],
    set: lambda value: sorted(set.__iter__(value), key=digest),
    frozenset: lambda value: sorted(frozenset.__iter__(value), key=digest),
}


def _label(kind: type) -> Any:
    """What a class is called; one that is not found under its name is itself only."""
    return kind.__module__, kind.__qualname__, 0 if imported_name(kind) else id(kind)


def _imported(value: Any) -> tuple[Any, Sequence[Any]]:
    if (name := imported_name(value)) is None:
        raise _unreadable(value, ", which cannot be read")
    return name, ()


def _scalar(value: Any) -> Any:
    plain = value.item()
    if isinstance(plain, np.generic) or value.dtype.kind not in "biufcSU":
        return str(value.dtype), value.tobytes()
    return plain


def _array(value: Any) -> tuple[Any, Sequence[Any]]:
    if value.dtype.hasobject:
        return "objects", (value.shape, *value.ravel().tolist())
    if value.ndim == 1 and value.size <= _SHORT and value.dtype.kind in "biufcSU":
        return None, value.tolist()
    return "array", (str(value.dtype.descr), value.shape, value.tobytes())


def generator_state(generator: Any) -> Any:
    """What a generator draws next follows from; to be compared."""
    if isinstance(generator, random.Random):
        return generator.getstate()
    if isinstance(generator, np.random.Generator):
        return repr(generator.bit_generator.state)
    state = generator.get_state(legacy=False)["state"]
    return state["key"].tobytes(), state["pos"]


@functools.cache
def _code(code: CodeType) -> bytes:
    return hashlib.blake2b(marshal.dumps(code, 2), digest_size=16).digest()


def cells_of(function: FunctionType) -> dict[str, Any]:
    """What a function closes over, by its names for it."""
    found = {}
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        try:
            found[name] = cell.cell_contents
        except ValueError:  # not yet set
            found[name] = None
    return found


def held_by(function: FunctionType) -> list[Any]:
    """What a function keeps besides its code: defaults, attributes, what it closes over."""
    held = [function.__defaults__, function.__kwdefaults__, vars(function)]
    return [*held, *cells_of(function).values()]


def _function(value: Any) -> tuple[Any, Sequence[Any]]:
    name = imported_name(value)
    if name is not None and is_pure(value.__module__):
        return name, ()
    globals_of = 0 if name is not None else id(value.__globals__)
    return (value.__module__, value.__qualname__), [_code(value.__code__), globals_of, *held_by(value)]


def _builtin(value: Any) -> tuple[Any, Sequence[Any]]:
    if value.__self__ is None or isinstance(value.__self__, ModuleType):
        return _imported(value)
    return value.__name__, (value.__self__,)


def _attributes(value: Any) -> tuple[Any, Sequence[Any]]:
    return _label(type(value)), _sorted(vars(value))


def _reduced(value: Any) -> tuple[Any, Sequence[Any]]:
    made_by = value.__reduce_ex__(4)
    return _label(type(value)), [list(each) if hasattr(each, "__next__") else each for each in made_by]


_DERIVED: tuple[tuple[type, Way], ...] = (
    (Enum, lambda value: (_label(type(value)), (value.name, value.value))),
    (gym.Space, _attributes),
    (type, lambda value: ("class", _label(value))),
    (ModuleType, lambda value: (value.__name__, ())),
    (np.dtype, lambda value: (str(value), ())),
)
_WAYS: dict[type, Way] = {
    np.ndarray: _array,
    gym.envs.registration.EnvSpec: _attributes,
    FunctionType: _function,
    BuiltinFunctionType: _builtin,
    MethodWrapperType: _builtin,
    MethodType: lambda value: ("method", (value.__self__, value.__func__)),
    type(NotImplemented): lambda value: ("not implemented", ()),
    _CACHED: lambda value: ("cached", (value.__wrapped__,)),
    MappingProxyType: lambda value: ("proxy", _CONTENTS[dict](dict(value))),
    property: lambda value: ("property", (value.fget, value.fset, value.fdel)),
    staticmethod: lambda value: ("static", (value.__func__,)),
    classmethod: lambda value: ("of a class", (value.__func__,)),
    functools.cached_property: lambda value: ("kept property", (value.func,)),
}
_WAYS |= dict.fromkeys(GENERATORS, lambda value: (type(value).__name__, (generator_state(value),)))
_WAYS |= dict.fromkeys(_REDUCED, _reduced)
_WAYS |= dict.fromkeys(
    (*OF_A_CLASS, GetSetDescriptorType, MemberDescriptorType),
    lambda value: (value.__name__, (value.__objclass__,)),
)
_OF_KEPT = {_attributes, _function, _builtin}
