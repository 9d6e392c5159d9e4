"""The attributes of objects, and the states of random generators."""

from __future__ import annotations

import enum
import functools
import hashlib
import inspect
import itertools
import pickle
import random
import sys
import types
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np

_LIBRARIES = ("gymnasium", "numpy", "pygame", "stable_baselines3", "torch", "gridworld")
_DEEP = 4  # lists in lists, objects in objects
_NOT_PLAIN = (
    *(type, types.ModuleType, types.FunctionType, types.BuiltinFunctionType, types.MethodType, property),
    *(classmethod, staticmethod, enum.Enum, gym.Env, gym.Space, np.ndarray, functools.partial),
)
GENERATORS = (np.random.Generator, np.random.RandomState, random.Random)


def layers_of(env: Any) -> list[Any]:
    """An environment's wrappers, the outermost first, and at last itself."""
    found = [env]
    while isinstance(found[-1], gym.Wrapper):
        found.append(found[-1].env)
    return found


def attributes(thing: Any) -> dict[str, Any]:
    """What an object holds, in slots too."""
    found = dict(getattr(thing, "__dict__", {}))
    for name in _slots(kind_of(thing)):
        try:
            found[name] = getattr(thing, name)
        except AttributeError:
            continue
    return found


def held_by(thing: Any, name: str = "", depth: int = _DEEP) -> Iterator[tuple[str, Any]]:
    """What an object holds, and what is held there, by their names: robot.place, robots[0].place."""
    if getattr(type(thing), "is_stand_in", False) or depth < 0:
        return
    if is_plain(thing) or isinstance(thing, GENERATORS):
        yield name, thing
    elif isinstance(thing, list | tuple | dict):
        for key, each in thing.items() if isinstance(thing, dict) else enumerate(thing):
            yield from held_by(each, f"{name}[{key!r}]", depth - 1)
    elif depth == _DEEP or not isinstance(thing, _NOT_PLAIN):
        for key, each in attributes(thing).items():
            yield from held_by(each, f"{name}.{key}" if name else key, depth - 1)


def is_plain(thing: Any) -> bool:
    """Whether a thing is made of numbers, texts and arrays."""
    if isinstance(thing, list | tuple | set | dict):
        return all(map(is_plain, thing.values() if isinstance(thing, dict) else thing))
    return thing is None or isinstance(thing, (bool, int, float, complex, str, bytes, np.generic, np.ndarray))


def differing(one: Mapping[str, Any], two: Mapping[str, Any]) -> list[str]:
    """The names with another content in one of these than in the other."""
    return sorted(name for name in one.keys() | two.keys() if one.get(name) != two.get(name))


def innermost(names: Iterable[str], inner: Sequence[str]) -> list[str]:
    """Names of attributes, or of what is held there, where that is among `inner` names."""
    found = ([one for one in inner if one.startswith((f"{name}.", f"{name}["))] or [name] for name in names)
    return list(itertools.chain.from_iterable(found))


def set_attributes(thing: Any, held: dict[str, Any]) -> None:
    """Make an object hold this and nothing else."""
    slots = _slots(kind_of(thing))
    if hasattr(thing, "__dict__"):
        vars(thing).clear()
        vars(thing).update({k: v for k, v in held.items() if k not in slots} if slots else held)
    for name in slots:
        if name in held:
            object.__setattr__(thing, name, held[name])
        elif hasattr(thing, name):
            object.__delattr__(thing, name)


@functools.lru_cache(1024)
def _slots(kind: Any) -> tuple[str, ...]:
    names = (
        name
        for each in kind.__mro__
        for name, member in vars(each).items()
        if inspect.ismemberdescriptor(member)
    )
    return tuple(name for name in names if name not in ("__dict__", "__weakref__"))


def own_spaces(layer: Any) -> list[Any]:
    """The spaces of a layer, which may be its class's."""
    return [getattr(layer, name, None) for name in ("action_space", "observation_space")]


def spaces_in(held: Any) -> Iterator[gym.Space[Any]]:
    """The spaces among some values, and within these."""
    for each in held:
        if isinstance(each, gym.Space):
            yield each
            inner = getattr(each, "spaces", ())
            yield from spaces_in(inner.values() if isinstance(inner, dict) else inner)


def random_states() -> list[Any]:
    """The states of the generators that all share."""
    torch = sys.modules.get("torch")
    found = [] if torch is None else [torch.get_rng_state().numpy().tobytes()]
    numpys: Any = np.random.get_state(legacy=False)["state"]
    return [*found, random.getstate(), (numpys["key"].tobytes(), numpys["pos"])]


def state_of(generator: Any) -> bytes:
    """The state of a random generator."""
    if isinstance(generator, random.Random):
        return hashlib.sha256(repr(generator.getstate()).encode()).digest()
    bits = getattr(generator, "bit_generator", None)
    return pickle.dumps(generator.get_state(legacy=False) if bits is None else bits.state)


def kind_of(thing: Any) -> Any:
    """Its class, of which nothing is known."""
    return type(thing)


def holders_of(kinds: Iterable[type]) -> list[Any]:
    """Classes, and the modules that they are of; without those of libraries."""
    own = [each for each in kinds if not is_library(each.__module__)]
    return [
        *own,
        *dict.fromkeys(sys.modules[each.__module__] for each in own if each.__module__ in sys.modules),
    ]


def generators_of(holders: Iterable[Any]) -> list[tuple[str, Any]]:
    """The random generators that classes and modules hold, with what they are called there."""
    held = [(each, vars(each).items()) for each in holders]
    return [
        (f"{name} of {each.__name__}", value)
        for each, items in held
        for name, value in items
        if isinstance(value, GENERATORS)
    ]


def shared_with(holders: Iterable[Any]) -> list[Any]:
    """The plain objects that classes and modules hold by a name, or in a list or dictionary.

    Code may ask of an attribute whether it is one of them.
    """
    waiting: list[Any] = [list(vars(each).values()) for each in holders]
    found: dict[int, Any] = {}
    for depth in range(_DEEP):
        inner: list[Any] = []
        for held in waiting:
            for each in held.values() if isinstance(held, dict) else held:
                if type(each) in (list, tuple, dict, set, frozenset):
                    inner.append(each)
                elif type(each) is object or (hasattr(each, "__dict__") and not isinstance(each, _NOT_PLAIN)):
                    found[id(each)] = each
        waiting = inner if depth + 1 < _DEEP else []
    return list(found.values())


def is_library(name: str) -> bool:
    """Whether a module, by its name, is Python's own or of a package that environments are made with."""
    root = name.partition(".")[0]
    return (root in sys.stdlib_module_names and root != "__main__") or root in _LIBRARIES
