"""What an environment holds: the attributes of all its layers, copied together and put back.

The layers are an environment's wrappers and itself. Neutral wrappers (`known`) are left out; all others hold
state like the environment does. Attributes that are large and never change are left in place; everything
else is in one pickle, so that what is the same object stays the same object. Spaces, code, and what only
draws or waits are kept as they are. A random generator that is held when the search begins is replaced by
the one that takes every outcome. The environment gets back its own attributes in the end.
"""

from __future__ import annotations

import collections
import contextlib
import io
import itertools
import math
import random
import types
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import gymnasium as gym
import numpy as np

from gridworld.base.errors import InputError, in_short
from gridworld.world.door import known
from gridworld.world.door.attributes import (
    attributes,
    generators_of,
    holders_of,
    layers_of,
    own_spaces,
    random_states,
    set_attributes,
    shared_with,
    spaces_in,
    state_of,
)
from gridworld.world.door.copies import ATOMS, Anew, Copier, Reader, Recorder
from gridworld.world.door.counters import NUMBERS, Counter, Key, Unread
from gridworld.world.door.uniform import Uniform

Env = gym.Env[Any, Any]
_CODE = (type, types.ModuleType, types.FunctionType, types.BuiltinFunctionType, np.ufunc)
KEPT = (gym.Space, gym.envs.registration.EnvSpec, *_CODE)
_SMALL, _LARGE = 1024, 256  # bytes of all copies, up to which all is copied; beyond it, of one attribute
_PLAIN = frozenset({list, tuple, dict, set, frozenset, collections.deque})


class Changed(Exception):  # noqa: N818
    """Attributes that were left in place have changed: the search begins again with copies of them."""

    def __init__(self, found: Sequence[tuple[int, str]]) -> None:
        super().__init__(found)
        self.found = found


class Layers:
    """The layers of an environment, the outermost first, and copies of what they hold.

    Args:
        where: what messages call the environment.
        env: it is changed, and left as it was by `restored`.
        branching: the generator in place of every other.
        keeps_shared: whether objects that its modules and classes hold are kept as they are.
        keeps_views: whether an array that shows another's memory does so in copies, too.
    """

    def __init__(
        self, where: str, env: Env, branching: Any, keeps_shared: bool = True, keeps_views: bool = False
    ) -> None:
        self._where, self.branching, self.keeps_views = where, branching, keeps_views
        self.layers: list[Any] = []
        self._chain = chain = list[Any]()  # without the neutral ones
        for layer in layers_of(env):
            if not known.is_neutral(layer):
                self.layers.append(layer)
                chain.append(layer)
            elif known.records(layer) and not all(map(known.steps_once, self.layers)):
                chain.append(known.Recorded(layer.env))
        self.env: Any = self.layers[0]
        self.reset_options = known.reset_options(self.env, has_layers=self.env is not env)
        self.base: Any = self.layers[-1]
        holders = holders_of(dict.fromkeys(kind for layer in self.layers for kind in type(layer).__mro__))
        found = shared_with(holders) if keeps_shared else []
        self.shared = {id(each): each for each in found}  # kept as they are
        self.met_shared = set[int]()
        self.fixed: dict[Any, Any] = {id(each): each for each in (*chain, branching)} | self.shared
        self._known = self.fixed  # and what is within attributes that are left in place
        self._left: list[dict[str, Any]] = [{} for _ in self.layers]  # in place, by layers
        self._names: dict[tuple[str, ...], int] = {}  # of attributes that are copied: their numbers in copies
        self._digest_left = b""
        self.read: set[Key] = set()  # attributes that something has read,
        self.clocked: set[Key] = set()  # and those that have one value at each time
        self._counters: list[dict[str, Counter]] = [{} for _ in self.layers]  # numbers that nothing has read
        self._compares_forms = False  # whether what a stand-in was made from counts in a copy
        # Those that cannot be replaced, with their states.
        self._generators = [(each, state_of(each)) for _, each in generators_of(holders)]
        self.is_adopting = False
        self.ordinary: set[Any] = set(_PLAIN)  # classes whose objects are copied, unless they are known

    @contextmanager
    def restored(self) -> Iterator[None]:
        """Work on copies; in the end every layer holds the very objects that it held."""
        before = [(layer, attributes(layer)) for layer in self.layers]
        values = [each for layer, held in before for each in (*held.values(), *own_spaces(layer))]
        spaces = {id(space): (space, vars(space).get("_np_random")) for space in spaces_in(values)}.values()
        self._random = random_states()
        self._shared_before = self._shared_content(self.shared)
        try:
            self._adopt()
            for space, _ in spaces:
                vars(space)["_np_random"] = self.branching
            with known.patched(self.base, self.branching):
                yield
        finally:
            for layer, held in before:
                set_attributes(layer, held)
            for key in self._changed_shared():
                set_attributes(self.shared[key], self._load(self._shared_before[key]))
            for space, generator in spaces:
                vars(space)["_np_random"] = generator

    def check_generators(self) -> None:
        """Refuse draws from generators that cannot be replaced."""
        if random_states() != self._random or any(
            state_of(each) != state for each, state in self._generators
        ):
            raise InputError(
                f"{self._where}: it draws from another generator than self.np_random (numpy's or "
                "Python's own), so its outcomes cannot be enumerated; draw from self.np_random"
            )

    def _adopt(self) -> None:
        """Put copies in place of everything, and the generator that branches in place of every other."""
        self.is_adopting = True
        held = [attributes(layer) for layer in self.layers]
        self._check_closures(held)
        try:
            copy = self._load(self.dump([list(each.items()) for each in held]))
        except Exception as error:
            raise self._uncopied(held, error) from error
        finally:
            self.is_adopting = False
        for layer, items in zip(self.layers, copy, strict=True):
            set_attributes(layer, dict(items))
        for outer, inner in itertools.pairwise(self._chain):
            outer.env = inner
        if isinstance(self.base, gym.Env):
            self.base._np_random = self.branching
        if getattr(self.base, "render_mode", None) == "human":
            self.base.render_mode = None

    def _check_closures(self, held: list[dict[str, Any]]) -> None:
        """Refuse a function that holds an object which an attribute holds too, and which has copies here."""
        cells = [
            (name, cell.cell_contents)
            for each in held
            for name, value in each.items()
            if isinstance(value, types.FunctionType)
            for cell in value.__closure__ or ()
            if not isinstance(cell.cell_contents, gym.Env)
        ]
        recorder = Recorder(self)
        with contextlib.suppress(Exception):  # which copying raises again
            recorder.dump(held if cells else None)
        met = {id(each) for each in recorder.met}
        if shared := next((name for name, content in cells if id(content) in met), None):
            raise InputError(
                f"{self._where}: its attribute {shared} is a function that holds an object of another "
                "attribute; make it a method"
            )

    def _uncopied(self, held: list[dict[str, Any]], error: Exception) -> InputError:
        if isinstance(error, InputError):
            return error
        for each in held:
            for name, value in each.items():
                try:
                    self.dump(value)
                except Exception as reason:
                    return InputError(
                        f"{self._where}: its attribute {name} cannot be copied ({in_short(reason)}); hold "
                        "numbers, lists, numpy arrays or plain objects"
                    )
        return InputError(f"{self._where}: its attributes cannot be copied ({in_short(error)})")

    def leave(self, changing: set[tuple[int, str]], series: Sequence[Sequence[dict[Any, Any]]]) -> None:
        """Leave in place what is not known to change: single values, and what is large if all of it is.

        A stand-in takes the place of each number that changes and that nothing has read so far; `series`
        has the numbers in some episodes, after the reset and each step.
        """
        self._left, self._known = [{} for _ in self.layers], self.fixed
        self._counters = [{} for _ in self.layers]
        for number, name in changing - self.read:
            values = [[now[number, name] for now in each if (number, name) in now] for each in series]
            is_clock = (number, name) in self.clocked
            counter = self._counters[number][name] = Counter((number, name), values, is_clock)
            *outer, layer = self.layers[: number + 1]
            counter.is_limit = known.is_limit(layer) and name == "_elapsed_steps"
            counter.only_cuts = counter.is_limit and all(map(known.steps_once, outer))
            self._keep(counter.blank)
        most = _LARGE if len(self.take()) > _SMALL else math.inf
        self._left = [
            {
                name: value
                for name, value in attributes(layer).items()
                if (number, name) not in changing
                and (type(value) in ATOMS or id(value) in self.fixed or len(self.dump(value)) > most)
            }
            for number, layer in enumerate(self.layers)
        ]
        self._digest_left = self._content_left()
        recorder = Recorder(self)
        for value in itertools.chain.from_iterable(left.values() for left in self._left):
            recorder.dump(value)
        # One object stays one, wherever it is held.
        self._known = self.fixed | {id(each): each for each in recorder.met}

    def _content_left(self) -> bytes:
        return self.dump(self._left, self.fixed)

    def changed_left(self) -> list[tuple[int, str]]:
        """All that was left in place, if some of it has changed after all."""
        if self._content_left() == self._digest_left:
            return []
        return [(number, name) for number, left in enumerate(self._left) for name in left]

    def check_left(self) -> None:
        """Raise `Changed` if what was left in place has changed."""
        if found := self.changed_left():
            raise Changed(found)

    def take(self, without: Sequence[str] = (), with_counts: bool = False) -> bytes:
        """A copy of the state. Equal copies are of equal states; equal states may have several."""
        parts, layers = [], self._held(without, with_counts)
        for held in layers:
            names = tuple(held)
            if names not in self._names:
                self._names[names] = len(self._names)
            parts.append([self._names[names], *held.values()])
        return self._dumped(parts, layers)

    def _held(self, without: Sequence[str], with_counts: bool = False) -> list[dict[str, Any]]:
        held = []
        for layer, left, counters in zip(self.layers, self._left, self._counters, strict=True):
            found = attributes(layer)
            for name, value in left.items():
                now = found.pop(name, Changed)
                if now is not value and not (type(now) is type(value) in ATOMS and now == value):
                    raise Changed([(self.layers.index(layer), name)])
            for name, counter in () if with_counts else counters.items():
                if name in found and (type(found[name]) in NUMBERS or type(found[name]) is Unread):
                    found[name] = counter.blank
            held.append({name: found[name] for name in sorted(found) if name not in without})
        return held

    def put(self, copy: bytes, time: int | None = 0) -> None:
        """Make a copy the state of all layers, before a step after so many; None: before a reset."""
        names = list(self._names)
        for layer, left, counters, (number, *values) in zip(
            self.layers, self._left, self._counters, self._load(copy), strict=True
        ):
            held = dict(zip(names[number], values, strict=True)) | left
            for name, counter in counters.items():
                if time is not None and type(held.get(name)) is Unread:
                    held[name] = counter.fresh(time)
            set_attributes(layer, held)

    @property
    def counters(self) -> list[Counter]:
        """What is known of numbers that change, and that nothing has read."""
        return [counter for each in self._counters for counter in each.values() if not counter.is_clock]

    @property
    def clocks(self) -> list[Counter]:
        """What is known of those that something reads, and that have one value at each time."""
        return [counter for each in self._counters for counter in each.values() if counter.is_clock]

    def note_read(self, found: set[Key], has_clocks: bool) -> None:
        """Take attributes that something has read as state, as clocks if there may be such."""
        for number, name in found:
            counter = self._counters[number][name]
            is_clock = has_clocks and not counter.is_clock and counter.is_regular and len(counter.kinds) == 1
            (self.clocked if is_clock else self.read).add((number, name))

    def check_counters(self, time: int) -> None:
        """Note how numbers that are counted have changed in a reset, or in that step."""
        for layer, counters in zip(self.layers, self._counters, strict=True):
            held = attributes(layer) if counters else {}
            for name, counter in counters.items():
                counter.check(held.get(name), time)

    def numbers(self) -> dict[tuple[int, str], Any]:
        """The attributes that are numbers."""
        return {
            (number, name): value
            for number, layer in enumerate(self.layers)
            for name, value in attributes(layer).items()
            if type(value) in NUMBERS
        }

    def uncertain(self) -> set[Key]:
        """The stand-ins of which it is not known that they do no more than cut episodes."""
        clocks = {counter.key for counter in self.clocks if counter.asked is not None}
        return clocks or {counter.key for counter in self.counters if not counter.only_cuts}

    def check_shared(self) -> None:
        """Begin anew if an object that is kept for its modules and classes has changed: then it is state."""
        if self._changed_shared():
            raise Anew(keeps_shared=False)

    def _shared_content(self, keys: Iterable[int]) -> dict[int, bytes]:
        """What these of the shared objects hold, by their ids; without those that cannot be copied."""
        found, met = {}, self.met_shared.copy()
        for key in keys:
            with contextlib.suppress(Exception):  # of anybody's
                found[key] = self.dump(attributes(self.shared[key]), self.fixed)
        self.met_shared = met  # without what they hold of each other
        return found

    def _changed_shared(self) -> list[int]:
        """Those that an attribute was, and that hold something else than before."""
        watched = self.met_shared & self._shared_before.keys()
        now = self._shared_content(watched)
        return [key for key in watched if now.get(key) != self._shared_before[key]]

    def everything(self, *more: Any) -> bytes:
        """A copy of every attribute, and of `more`; what cannot be copied raises whatever it raises."""
        self._compares_forms = True
        try:
            return self.dump([*more, *map(attributes, self.layers)], self.fixed)
        finally:
            self._compares_forms = False

    def names(self) -> list[str]:
        """The names of all attributes."""
        return [name for layer in self.layers for name in attributes(layer)]

    def values(self, ignore: Sequence[str] = ()) -> dict[tuple[int, str], bytes]:
        """A copy of each attribute that is not left in place, by the number of its layer and its name."""
        found = {}
        for number, held in enumerate(self._held(ignore)):
            for name, value in held.items():
                found[number, name] = self._dumped(value, [{name: value}])
        return found

    def _dumped(self, thing: Any, held: list[dict[str, Any]]) -> bytes:
        """A copy of what some layers hold; refuses an attribute that cannot be copied."""
        try:
            return self.dump(thing)
        except Exception as error:  # whatever the classes in it raise
            raise self._uncopied(held, error) from error

    def dump(self, thing: Any, known_objects: dict[Any, Any] | None = None) -> bytes:
        """A copy of something that may hold the layers, in which what is known is kept as it is."""
        buffer = io.BytesIO()
        Copier(buffer, self, self._known if known_objects is None else known_objects).dump(thing)
        return buffer.getvalue()

    def _load(self, copy: bytes) -> Any:
        return Reader(io.BytesIO(copy), self._known, self.branching).load()

    def _keep(self, thing: Any) -> int:
        self.fixed[id(thing)] = self._known[id(thing)] = thing
        return id(thing)

    def reference(self, thing: Any) -> Any:
        """What stands in a copy for an object that is kept as it is; None for any other."""
        kind = type(thing)
        if kind is Uniform:
            return "drawn", *thing.parts()
        if kind is Unread:
            counter = thing.counter
            return (*counter.key, thing.form) if self._compares_forms else self._keep(counter.blank)
        if isinstance(thing, KEPT) or known.is_kept(kind):
            return self._keep(thing)
        if isinstance(thing, np.random.Generator):
            if not self.is_adopting:
                raise InputError(
                    f"{self._where}: reset() or step() makes another np_random, whose draws cannot be "
                    "enumerated; draw from self.np_random, and leave seeding to super().reset(seed=seed)"
                )
            return id(self.branching)
        if isinstance(thing, np.random.RandomState | random.Random):
            self._generators.append((thing, state_of(thing)))
            return self._keep(thing)
        if kind is np.ndarray and self.is_adopting:
            return self._keep(thing) if not thing.flags.writeable and thing.base is None else None
        self.ordinary.add(kind)
        return None
