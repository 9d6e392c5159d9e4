"""What a method of a wrapper makes of its argument, known exactly: all that it can come to is read.

A method is followed through its code: what it names, what that holds and names, and so on. All of it must be
readable (`reading`): data, code written in Python, and libraries that compute (`is_pure`). Clocks, files,
other environments and whatever else is written in C are refused. The environment below is out of reach: in
its place is an object that has spaces and nothing else.

If nothing within reach has changed after any call, the next call gives the same for the same argument, for
ever. A buffer or a cache of the wrapper itself may change; then every argument is asked after every other.
"""

from __future__ import annotations

import builtins
import contextlib
import copy
import dis
import importlib
import io
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from types import BuiltinFunctionType, CodeType, FunctionType, MethodWrapperType, ModuleType
from typing import Any

import gymnasium as gym
import numpy as np

from gridworld.base.errors import InputError, in_short
from gridworld.world.mdp import Mdp
from gridworld.world.reading import (
    OF_A_CLASS,
    PLAIN,
    UnreadableError,
    cells_of,
    digest,
    held_by,
    imported_name,
    is_pure,
    refuse_hiding,
    way_of,
)

SO_UNKNOWN = (
    ", so its effect on the task is not exactly known; leave it out, or make it a function of its argument "
    "alone"
)
_IMPURE = {  # of what is built in
    *("open", "input", "eval", "exec", "compile", "__import__", "globals", "locals", "vars", "id"),
}
_BY_NAME = {"getattr", "hasattr", "setattr", "delattr", "__dict__"}  # who may come to any attribute
# What leaves a step to chance, as messages of `UnreadableError` begin; and modules that have it.
_CHANCE = ("time.", "posix.urandom", "numpy.random.", "a SystemRandom", "datetime.")
_OF_CHANCE = {"time", "os", "secrets", "uuid", "datetime", "numpy"}
_NO_CHANCE = (
    "time.sleep",
    "numpy.random.seed",
    "numpy.random.RandomState.",
    "numpy.random._generator.Generator.",
)
_MAKING = {"__init__", "__new__", "__post_init__", "__init_subclass__", "__set_name__", "__del__"}
_CODE = (FunctionType, staticmethod, classmethod, property)
_OF_ITS_OWN = {"_observation_space", "_action_space"}  # what Gymnasium's properties show of a wrapper
_SPACES = ("observation_space", "action_space")
_ABSENT = "absent"
_MOST_PLACES = 20_000
_MOST_IN_TURN = 100  # arguments, up to which every one is asked after every other


class _Below(gym.Env[Any, Any]):
    """What a method finds in place of the environment below: spaces, and of a world here its tables.

    It notes what else was looked for.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        spaces = {name: getattr(env, name) for name in _SPACES}
        held = object.__getattribute__(self, "__dict__")
        held.update(copy.deepcopy(spaces), looked_for=[])
        if isinstance(mdp := getattr(env.unwrapped, "mdp", None), Mdp):  # which never changes
            held.update(mdp=mdp)

    def __getattribute__(self, name: str) -> Any:
        held = object.__getattribute__(self, "__dict__")
        if name == "unwrapped" and "mdp" in held:
            return self
        if name not in (*_SPACES, "mdp") or name not in held:
            held["looked_for"].append(name)
            raise AttributeError(name)
        return held[name]

    def __setattr__(self, name: str, value: Any) -> None:
        getattr(self, name)


class Reach:
    """All that a method of an environment or a wrapper can come to.

    `known` are objects that it may refer to and that are not read, `held` is read besides. What cannot be
    read is refused with an InputError. With `skips` only chance is; the rest is left out, as are packages
    other than the owner's.
    """

    def __init__(
        self,
        where: str,
        owner: Any,
        method: str,
        known: Sequence[Any] = (),
        held: Mapping[str, Any] | None = None,
        skips: bool = False,
    ) -> None:
        self._known = [owner, *known]  # not read
        self._owner, self._by_name = owner, False
        self.names = {method, *_OF_ITS_OWN}
        self._met: dict[int, Any] = {id(each): each for each in self._known}
        self._modules: list[Mapping[str, Any]] = []
        self._classes: dict[tuple[int, bool], tuple[Mapping[str, Any], bool]] = {}
        self._places: dict[tuple[int, str], tuple[Mapping[str, Any], str]] = {}  # what may be changed
        self._waiting: list[Any] = []
        self._package = type(owner).__module__.partition(".")[0] if skips else None
        for name in held or ():
            self._look_up(held or {}, name)
        self._class(type(owner), is_called=False)
        try:
            self._follow()
            if skips:
                self._places = {key: at for key, at in self._places.items() if self._is_readable(*at)}
        except UnreadableError as error:
            called = f"{method}() of {type(owner).__name__}"
            raise InputError(f"{where}: {called} refers to {error}{SO_UNKNOWN}") from None

    def _is_readable(self, place: Mapping[str, Any], name: str) -> bool:
        try:
            return bool(digest(place.get(name), self._known))
        except UnreadableError:
            if isinstance(place.get(name), Iterator) and not isinstance(place.get(name), io.IOBase):
                raise
            return False

    def content(self, is_outside: bool = False) -> bytes:
        """A digest of what may be changed; of the owner's own attributes or not."""
        mine = vars(self._owner)
        values = [
            place.get(name, _ABSENT)
            for place, name in self._places.values()
            if not (is_outside and place is mine)
        ]
        return digest(values, self._known)

    def _follow(self) -> None:
        size = -1
        while size != len(self._places):
            size = len(self._places)
            if size > _MOST_PLACES:
                raise UnreadableError(f"more than {_MOST_PLACES:,} names")
            for place, name in list(self._named()):
                self._look_up(place, name)
            while self._waiting:
                try:
                    self._visit(self._waiting.pop())
                except UnreadableError as error:
                    is_chance = str(error).startswith(_CHANCE) and not str(error).startswith(_NO_CHANCE)
                    if self._package is None or is_chance:
                        raise

    def _named(self) -> Iterator[tuple[Mapping[str, Any], str]]:
        """Every place where a name that is used may be meant."""
        shows = ("render", "_render", "close") if self._package else ()  # what is no part of a step
        names = sorted(name for name in self.names if not name.startswith(shows))
        mine: Any = vars(self._owner)
        yield from ((mine, name) for name in [*names, *(mine if self._by_name else ())] if name != "env")
        yield from ((module, name) for module in self._modules for name in [*names, "__getattr__"])
        for held, is_called in self._classes.values():
            special = [name for name in held if name.startswith("__") and isinstance(held[name], _CODE)]
            left_out = () if is_called else _MAKING
            yield from ((held, name) for name in [*names, *special] if name not in left_out)

    def _look_up(self, place: Mapping[str, Any], name: str) -> None:
        key = id(place), name
        if key not in self._places:
            self._places[key] = place, name
            self._waiting.append(place.get(name))

    def _visit(self, value: Any) -> None:
        kind = type(value)
        if kind in PLAIN or issubclass(kind, np.generic) or id(value) in self._met:
            return
        self._met[id(value)] = value
        if isinstance(value, gym.Env):
            raise UnreadableError("another environment")
        if isinstance(value, ModuleType):
            if self._is_left_out(value.__name__) and not is_pure(value.__name__):
                return
            self._modules.append(vars(value))
        elif isinstance(value, type):
            self._class(value, is_called=True)
        elif kind is FunctionType:
            self._function(value)
        elif kind in OF_A_CLASS or (kind in (BuiltinFunctionType, MethodWrapperType)):
            self._in_c(value)
        elif not is_pure(imported_name(value)):
            self._class(kind, is_called=False)
            self._waiting.extend(way_of(kind, value)(value)[1])

    def _is_left_out(self, module: Any) -> bool:
        top = str(module).partition(".")[0]
        return is_pure(module) or (self._package not in (None, top) and top not in _OF_CHANCE)

    def _class(self, kind: type, is_called: bool) -> None:
        for each in kind.__mro__:
            if (id(each), is_called) not in self._classes and not self._is_left_out(each.__module__):
                self._classes[id(each), is_called] = vars(each), is_called
                self._class(type(each), is_called=False)

    def _in_c(self, value: Any) -> None:
        owner = getattr(value, "__objclass__", getattr(value, "__self__", None))
        module: Any
        if isinstance(owner, type):
            module, name = owner.__module__, f"{owner.__qualname__}.{value.__name__}"
        elif owner is None or isinstance(owner, ModuleType):
            module, name = value.__module__ or getattr(owner, "__name__", None), value.__name__
        else:
            self._waiting.append(owner)
            return
        if not is_pure(module) or (owner is builtins and name in _IMPURE):
            raise UnreadableError(f"{module}.{name}".removeprefix("builtins."))

    def _function(self, function: FunctionType) -> None:
        module = function.__globals__.get("__name__")
        is_library = self._is_left_out(module) and vars(sys.modules[str(module)]) is function.__globals__
        if is_library and imported_name(function) is not None:
            return
        if not is_library:
            self._code(function.__code__, function.__globals__)
        cells = cells_of(function)
        if isinstance(of := cells.pop("__class__", None), type):  # for `super()`
            self._class(of, is_called=False)
        if str(module).startswith("gymnasium."):  # whose functions look at its spaces
            envs = [each for each in cells.values() if isinstance(each, gym.Env)]
            self._known += envs
            self._met |= {id(each): each for each in envs}
        self._waiting += [*held_by(function)[:3], *cells.values()]

    def _code(self, code: CodeType, names: dict[str, Any]) -> None:
        """Note what code names: globals, attributes, modules, and attributes in its texts."""
        instructions = list(dis.get_instructions(code))
        for place, each in enumerate(instructions):
            name, what = each.argval, each.opname
            if isinstance(name, CodeType):
                self._code(name, names)
            elif what == "IMPORT_NAME":
                dots = "." * int(instructions[place - 2].argval)  # of `from ..package import name`
                with contextlib.suppress(ImportError):
                    package = names.get("__package__")
                    self._waiting.append(importlib.import_module(f"{dots}{name}", package))
            elif "GLOBAL" in what or what.endswith("_NAME"):
                self._by_name |= name in _BY_NAME
                self._look_up(names if name in names or not hasattr(builtins, name) else vars(builtins), name)
            elif what.endswith(("_ATTR", "_METHOD", "IMPORT_FROM")):
                self._by_name |= name in _BY_NAME
                self.names.add(name)
        self.names |= set(_words(code.co_consts))


def _words(constants: Iterable[Any]) -> Iterator[str]:
    """Texts that may be names of attributes."""
    for each in constants:
        if isinstance(each, str):
            yield from (word for word in each.split(".") if word.isidentifier() and len(each) < 100)
        elif isinstance(each, tuple | frozenset):
            yield from _words(each)


def asked(where: str, owner: Any, method: str, arguments: Sequence[Any]) -> list[Any]:
    """What a method of a wrapper makes of (copies of) each argument; refuses what is not a function of it.

    A copy of the wrapper is asked; `where` is what messages call the environment.
    """
    name = f"{method}() of {type(owner).__name__}"
    try:
        first = _Copy(where, owner, method)
        before = first.content()
        found, changes = [], False
        for argument in arguments:
            found.append(first.ask(argument))
            changes |= first.content() != before
        if changes:
            _check_in_turn(where, owner, method, arguments, found)
    except InputError:
        raise
    except UnreadableError as error:
        raise InputError(f"{where}: {name} refers to {error}{SO_UNKNOWN}") from None
    except _MemoryError as error:
        raise InputError(f"{where}: {name} {error}{SO_UNKNOWN}") from None
    except Exception as error:  # it may be anybody's
        raise InputError(f"{where}: {name} raised {in_short(error)}") from error
    return found


class _MemoryError(Exception):
    """What a method makes of its argument may depend on more than that; says how, after the method's name."""


class _Copy:
    """A copy of a wrapper to ask, with a `_Below` in place of the environment."""

    def __init__(self, where: str, owner: Any, method: str) -> None:
        below = _Below(owner.env)
        self._below = object.__getattribute__(below, "__dict__")
        refuse_hiding(owner)
        other = copy.deepcopy(owner, {id(owner.env): below})
        self._method = getattr(other, method)
        known = [below, *(each for each in self._below.values() if isinstance(each, Mdp))]
        self.content = Reach(where, other, method, known, self._below).content

    def ask(self, argument: Any) -> Any:
        try:
            return copy.deepcopy(self._method(copy.deepcopy(argument)))
        finally:
            if looked_for := self._below["looked_for"]:
                raise _MemoryError(f"reads from the environment below it ({looked_for[0]})") from None


def _check_in_turn(where: str, owner: Any, method: str, arguments: Sequence[Any], found: list[Any]) -> None:
    """Ask a method that writes something about every argument after every other, and after a long time."""
    memory = _MemoryError("keeps memory or draws random numbers")
    if len(arguments) > _MOST_IN_TURN:
        raise memory
    expected = dict(enumerate(found))
    for before in expected:
        each, contents = _Copy(where, owner, method), dict[int, bytes]()
        outside = each.content(is_outside=True)
        for is_warm in (False, True):
            for number in [number for other in expected for number in (before, other)][:: 1 - 2 * is_warm]:
                if not same(each.ask(arguments[number]), expected[number]):
                    raise _MemoryError(f"does not always give the same for {str(arguments[number])[:50]}")
                # What it holds follows from the last argument, once it has met all.
                content = each.content()
                if is_warm and contents.setdefault(number, content) != content:
                    raise memory
        if each.content(is_outside=True) != outside:
            raise memory


def same(one: Any, other: Any) -> bool:
    """Whether two observations, actions or rewards are equal, dictionaries of arrays included."""
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    return np.array_equal(np.asarray(one), np.asarray(other))
