"""The whole state of a model, found by walking its object graph rather than by a list of names.

From the model, every attribute of every object is followed down to values that can be written to a file and
put back: numbers, text, arrays, tensors, generators, optimisers, and containers of these. Each has a path,
`policy.q_net.q_net.0.weight`. What is neither such a value nor an object made of such values (an iterator, an
open file, a C structure) could hide state, so a model that has one is refused before training begins.

What classes of one's own and their functions hold is among it, and what has changed in the libraries' classes
since training started (`snapshot.class_state`). Not looked for are global variables of the module that a
class of one's own is from, what only they lead to, and attributes of the libraries' functions.
"""

from __future__ import annotations

import enum
import functools
import random
import types
from collections import deque
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gridworld.agents.sb3.snapshot.class_state import ClassState, Put, cannot_put, parts_of_function
from gridworld.agents.sb3.snapshot.value_codec import ValueCodec
from gridworld.errors import InputError
from gridworld.storage.serialization import State, StateError

_CODE = (
    *(type, types.FunctionType, types.BuiltinFunctionType, types.ModuleType, types.MethodType),
    *(types.MethodWrapperType, types.WrapperDescriptorType, types.GenericAlias, functools.partial, np.ufunc),
)
_FIXED = (np.dtype, torch.device, torch.dtype, torch.layout, slice, range, enum.Enum)  # and immutable
_CHANCE = (np.random.Generator, np.random.RandomState, random.Random, torch.Generator)
_LEAVES = (Tensor, np.ndarray, torch.optim.Optimizer, *_CHANCE, *_FIXED)


class ObjectGraph:
    """The values and objects of a model, by their paths. `constants` are made by whoever builds it.

    `roots` are the model, by the path "", and what is saved with it.
    """

    def __init__(
        self, roots: dict[str, Any], constants: list[Any], values: ValueCodec, classes: ClassState
    ) -> None:
        self.leaves: dict[str, tuple[Any, Put]] = {}
        self.objects: dict[str, str] = {}  # path: class
        self.same: dict[str, str] = {}  # path: that of the same array, tensor or container
        self._values = values
        self._classes = classes
        self._constants = {id(constant) for constant in constants}
        self._holders: dict[str, Any] = {}
        self._seen: dict[int, str] = {}
        self._looked_at: set[int] = set()  # classes
        self._keep: list[Any] = []  # what was made for looking, so that its id stays its own
        for path, root in roots.items():
            self._visit(root, path, cannot_put)

    def state(self) -> State:
        """Every value, and what the whole is made of."""
        found: State = {path: self._values.write(value, path) for path, (value, _) in self.leaves.items()}
        return {"values": found, "count": len(found), "objects": self.objects, "same": self.same}

    def restore(self, state: State) -> None:
        """Put every value where it was.

        Args:
            state: of `state`.

        Raises:
            StateError: this model is made otherwise.
        """
        if state["objects"] != self.objects:
            differing = sorted(set(state["objects"].items()) ^ set(self.objects.items()))
            raise StateError(f"the model is made otherwise, {differing[0][0] or 'its class'} to begin with")
        values, same = state["values"], state["same"]
        if len(values) != state["count"]:
            raise StateError(f"the model has {state['count']} values, not {len(values)}")
        for path in self.leaves.keys() - values.keys() - same.keys():
            holder, _, name = path.rpartition(".")
            delattr(self._holder(holder), name)
        for path, value in values.items():
            if path in self.leaves:
                now, put = self.leaves[path]
                self._values.put(value, now, put, path, shared=path in self.same)
            else:
                self._add(path, self._values.read(value, path))
        for path, original in same.items():
            if self.same.get(path) != original:
                holder, _, name = original.rpartition(".")
                self._add(path, getattr(self._holder(holder), name))

    def _holder(self, path: str) -> Any:
        if path not in self._holders:
            raise StateError(f"{path} is not there to take a value")
        return self._holders[path]

    def _add(self, path: str, value: Any) -> None:
        holder, _, name = path.rpartition(".")
        if not name.isidentifier():
            raise StateError(f"{path} has no place in this model")
        setattr(self._holder(holder), name, value)

    def _visit(self, value: Any, path: str, put: Put) -> None:
        if id(value) in self._constants:
            return
        if self._values.is_plain(value) or isinstance(value, _LEAVES) or _has_state(value):
            self._leaf(value, path, put)
        elif isinstance(value, torch.distributions.Distribution):
            return  # of the last forward pass; the next one makes another before it is asked
        elif id(value) in self._seen:
            return
        else:
            self._seen[id(value)] = path
            self._keep.append(value)
            for name, child, put_child in self._parts(value, path, put):
                self._visit(child, f"{path}.{name}" if path else name, put_child)

    def _leaf(self, value: Any, path: str, put: Put) -> None:
        if isinstance(value, Tensor) and value.grad_fn is not None:
            raise _hidden(path, value, "it hangs on others by a graph")
        if isinstance(value, np.ndarray) and value.dtype.hasobject:
            raise _hidden(path, value, "it holds objects")
        mutable = not isinstance(value, (bool, int, float, str, tuple, np.generic, type(None), *_FIXED))
        if mutable and id(value) in self._seen:
            self.same[path] = self._seen[id(value)]
            return
        if mutable:
            self._seen[id(value)] = path
            self._keep.append(value)
        self.leaves[path] = value, put
        if isinstance(value, Tensor):
            self._holders[path] = value
        if isinstance(value, Tensor) and value.grad is not None:
            self._visit(value.grad, f"{path}.grad", functools.partial(setattr, value, "grad"))

    def _parts(self, value: Any, path: str, put: Put) -> Iterator[tuple[str, Any, Put]]:
        """(name, value, what puts another there) of everything that an object or container holds."""
        if isinstance(value, _CODE):
            self._holders[path] = value
            yield from self._parts_of_class(value, path) if isinstance(value, type) else _parts_of_code(value)
            return
        kind = type(value)
        self.objects[path] = f"{kind.__module__}.{kind.__qualname__}"
        if isinstance(value, dict):
            if not all(isinstance(key, str) for key in value):
                raise _hidden(path, value, "its keys are not text")
            self.objects[path] += f" of {','.join(value)}"
            yield from (
                (key, child, functools.partial(value.__setitem__, key)) for key, child in value.items()
            )
        elif isinstance(value, list | tuple | deque):
            self.objects[path] += f" of {len(value)}"
            for index, child in enumerate(value):
                yield str(index), child, _putter(value, index, put)
        elif isinstance(value, set | frozenset):
            raise _hidden(path, value, "it holds objects in no order")
        if hasattr(value, "__dict__"):
            self._holders[path] = value
            derived = getattr(kind, "derived", ())
            for name, child in vars(value).items():
                if name not in derived:
                    yield name, child, functools.partial(setattr, value, name)
            yield from self._parts_of_class(kind, path)
        elif not isinstance(value, dict | list | tuple | deque):
            slots = [name for c in kind.__mro__ for name in _slots(c)]
            if not slots and kind is not object:
                raise _hidden(path, value, "what it holds cannot be seen")
            for name in slots:
                if hasattr(value, name):
                    yield name, getattr(value, name), functools.partial(setattr, value, name)

    def _parts_of_class(self, kind: type, path: str) -> Iterator[tuple[str, Any, Put]]:
        """What a class keeps for all its objects, each class once."""
        for base, parts in self._classes.parts(kind, self._looked_at):
            holder = f"<{base.__qualname__}>"
            self._holders[f"{path}.{holder}" if path else holder] = base
            for name, value, put in parts:
                yield f"{holder}.{name}", value, put


def _parts_of_code(value: Any) -> Iterator[tuple[str, Any, Put]]:
    """What a function remembers: the variables it closes over, its own object, its arguments."""
    if isinstance(value, types.FunctionType):
        yield from parts_of_function(value)
    elif isinstance(value, types.MethodType):
        yield "__func__", value.__func__, cannot_put
        yield "__self__", value.__self__, cannot_put
    elif isinstance(value, functools.partial):
        yield "func", value.func, cannot_put
        yield "args", value.args, cannot_put
        yield "keywords", value.keywords, cannot_put


def _slots(kind: type) -> tuple[str, ...]:
    slots = kind.__dict__.get("__slots__", ())
    return (slots,) if isinstance(slots, str) else tuple(slots)


def _putter(container: Any, index: int, put: Put) -> Put:
    if isinstance(container, tuple):

        def replace(value: Any) -> None:
            items = [*container[:index], value, *container[index + 1 :]]
            put(type(container)(*items) if hasattr(container, "_fields") else type(container)(items))

        return replace
    return functools.partial(container.__setitem__, index)


def _has_state(value: Any) -> bool:
    """Whether it knows itself what its state is, as our own classes do."""
    kind = type(value)
    return hasattr(kind, "get_state") and hasattr(kind, "set_state") and not isinstance(value, type)


def _hidden(path: str, value: Any, why: str) -> InputError:
    kind = type(value)
    return InputError(
        f"checkpoint.every: the model cannot be saved, {path} is a {kind.__module__}.{kind.__qualname__} and "
        f"{why}; train without checkpoints by checkpoint.every=null"
    )
