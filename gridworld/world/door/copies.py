"""Copies of what layers hold, by pickle: what is kept as it is is named, and the rest taken apart."""

from __future__ import annotations

import copyreg
import enum
import functools
import io
import pickle
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np

from gridworld.world.door.attributes import attributes, is_library, kind_of, set_attributes
from gridworld.world.door.uniform import Uniform

if TYPE_CHECKING:
    from gridworld.world.door.layers import Layers

ATOMS = frozenset({type(None), bool, int, float, complex, str, bytes, *np.sctypeDict.values()})
_CONTAINERS = (list, tuple, dict, set, frozenset, np.ndarray)  # whose own reduction holds their items


class Anew(BaseException):  # which an environment's `except Exception` does not catch
    """Copies have to be made in another way, so that a search begins anew; `how`: see `Layers`."""

    def __init__(self, **how: bool) -> None:
        super().__init__(how)
        self.how = how


class Copier(pickle.Pickler):
    """Copies what is not known; what is, a list or a dictionary too, is named by its number."""

    def __init__(self, file: io.BytesIO, held: Layers, known_objects: dict[Any, Any]) -> None:
        super().__init__(file, protocol=5)
        self._held, self._known = held, known_objects
        self._views: dict[int, list[Any]] = {}  # arrays by that whose memory they show

    def persistent_id(self, obj: Any) -> Any:
        kind = type(obj)
        if kind in ATOMS:
            return None
        if (key := id(obj)) in self._known:
            if key in self._held.shared:
                self._held.met_shared.add(key)
            return key
        return None if kind in self._held.ordinary else self._held.reference(obj)

    def reducer_override(self, obj: Any) -> Any:
        if isinstance(obj, np.ndarray):
            if self._held.keeps_views:
                return _parts_of_view(obj) if isinstance(obj.base, np.ndarray) else NotImplemented
            views = self._views.setdefault(id(obj if obj.base is None else obj.base), [])
            if any(np.may_share_memory(obj, each) for each in views):
                raise Anew(keeps_views=True)  # two arrays of one memory, which a copy has to hold once
            views.append(obj)
        elif _is_taken_apart(kind_of(obj)):
            held = attributes(obj)
            if self._held.is_adopting and isinstance(obj, gym.Env):  # which would make a generator when asked
                held["_np_random"] = self._held.branching
            return _new, (type(obj),), held, None, None, set_attributes
        return NotImplemented


class Recorder(Copier):
    """Notes every object within what it is given."""

    def __init__(self, held: Layers) -> None:
        super().__init__(io.BytesIO(), held, held.fixed)
        self.met: list[Any] = []

    def persistent_id(self, obj: Any) -> Any:
        found = super().persistent_id(obj)
        if found is None and type(obj) not in ATOMS:
            self.met.append(obj)
        return found


class Reader(pickle.Unpickler):
    def __init__(self, file: io.BytesIO, known_objects: dict[Any, Any], branching: Any) -> None:
        super().__init__(file)
        self._known, self._branching = known_objects, branching

    def persistent_load(self, key: Any) -> Any:
        if isinstance(key, tuple):  # a number drawn in an earlier step, which nothing may compare any more
            return Uniform.of_earlier(self._branching, *key[1:])
        return self._known[key]


def _parts_of_view(view: np.ndarray[Any, Any]) -> Any:
    """What makes a view again, on a copy of the array whose memory it shows."""
    base: Any = view.base
    offset = view.__array_interface__["data"][0] - base.__array_interface__["data"][0]
    return np.ndarray, (view.shape, view.dtype, base, offset, view.strides)


_new: Any = vars(copyreg)["__newobj__"]  # which pickle knows as a call of __new__


@functools.lru_cache(1024)
def _is_taken_apart(kind: Any) -> bool:
    """Whether its instances are copied attribute by attribute: their own way may leave something out.

    And `__getattr__`, which pickle asks of an object that has no attributes yet, may never come to an end.
    """
    if issubclass(kind, enum.Enum):  # which pickle keeps as its class's member
        return False
    if issubclass(kind, gym.Env):
        return True
    ways = ("__getstate__", "__reduce__", "__reduce_ex__", "__getattr__")
    has_its_own = any(getattr(kind, name, None) is not getattr(object, name, None) for name in ways)
    return has_its_own and not (is_library(kind.__module__) or issubclass(kind, _CONTAINERS))
