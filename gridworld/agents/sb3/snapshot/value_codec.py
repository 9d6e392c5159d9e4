"""A model's values as parts of a state, and back: to the last bit, type included.

What a state has no word for is a dict of one key that says what it is: {"tuple": [...]}, {"scalar": array},
{"rows": states, ...} for an array whose rows are rows of the observation table, which is then as small as the
states' numbers are.
"""

from __future__ import annotations

import enum
import random
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gridworld.envs.observations import ObservationTable
from gridworld.process.memory_budget import check_memory
from gridworld.storage.rng_state import generator_state, plain_state, set_generator_state, set_plain_state
from gridworld.storage.serialization import StateError, filled

_NUMBERS = (bool, int, float, str)
_FEW_ROWS = 256  # are written as they are
_PIECE = 1024  # rows looked up at a time, which stay in the processor's cache


class ValueCodec:
    """Knows the observation table, whose rows fill replay buffers."""

    def __init__(self, observation: ObservationTable) -> None:
        self._observation = observation
        self._row: tuple[int, ...] = observation.space.shape or ()
        self._sorted: tuple[NDArray[Any], NDArray[np.intp]] | None = None

    def is_plain(self, value: Any) -> bool:
        """Whether it is a number, text, or a container of such and of arrays."""
        kind = type(value)
        if value is None or kind in _NUMBERS or isinstance(value, np.generic) or kind is bytes:
            return True
        if kind in (list, tuple, deque, set, frozenset):
            return all(map(self._is_item, value))
        if isinstance(value, dict):
            return all(type(key) in _NUMBERS for key in value) and all(map(self._is_item, value.values()))
        return False

    def _is_item(self, value: Any) -> bool:
        if isinstance(value, np.ndarray):
            return not value.dtype.hasobject
        return self.is_plain(value)

    def write(self, value: Any, path: str) -> Any:
        """Write a value as a part of a state, to be saved before training goes on: arrays are not copied.

        Args:
            value: a value.
            path: where it is, for messages.
        """
        kind = type(value)
        if value is None or kind in _NUMBERS:
            return value
        if isinstance(value, np.ndarray):
            return self._write_array(value)
        if isinstance(value, Tensor):
            return {"tensor": value.detach().cpu().numpy()}
        if isinstance(value, np.generic):
            return {"scalar": np.array(value)}
        if kind is list:
            return [self.write(item, path) for item in value]
        if isinstance(value, dict):
            pairs = [[key, self.write(item, path)] for key, item in value.items()]
            return {"pairs": pairs}
        if kind is deque:
            return {"deque": [self.write(item, path) for item in value], "maxlen": value.maxlen}
        if kind in (tuple, set, frozenset):
            items = sorted(value, key=repr) if kind is not tuple else value
            return {kind.__name__: [self.write(item, path) for item in items]}
        if kind is bytes:
            return {"bytes": value.hex()}
        if isinstance(value, enum.Enum):
            return {"fixed": f"{type(value).__name__}.{value.name}"}
        return self._write_thing(value, path)

    def _write_thing(self, value: Any, path: str) -> Any:
        if isinstance(value, np.random.Generator):
            return {"random": generator_state(value)}
        if isinstance(value, np.random.RandomState):
            return {"random": plain_state(value.get_state(legacy=False))}
        if isinstance(value, random.Random):
            return {"random": self.write(value.getstate(), path)}
        if isinstance(value, torch.Generator):
            return {"random": value.get_state().numpy().copy()}
        if isinstance(value, torch.optim.Optimizer):
            return {"optimizer": self.write(value.state_dict(), path)}
        if hasattr(type(value), "get_state"):
            return {"state": value.get_state()}
        return {"fixed": repr(value)}

    def read(self, value: Any, path: str) -> Any:
        """Make the value anew that was written; `path` is for messages."""
        if value is None or type(value) in _NUMBERS or isinstance(value, np.ndarray):
            return value
        if isinstance(value, list):
            return [self.read(item, path) for item in value]
        kind, *_ = value
        content = value[kind]
        if kind == "rows":
            return self._read_rows(content, value["shape"])
        if kind == "tensor":
            return torch.from_numpy(content)
        if kind == "scalar":
            return content[()]
        if kind == "bytes":
            return bytes.fromhex(content)
        if kind == "pairs":
            return {key: self.read(item, path) for key, item in content}
        if kind in ("tuple", "set", "frozenset", "deque"):
            items = [self.read(item, path) for item in content]
            if kind == "deque":
                return deque(items, maxlen=value["maxlen"])
            return {"tuple": tuple, "set": set, "frozenset": frozenset}[kind](items)
        raise StateError(f"{path} is not there to take a {kind}")

    def put(self, value: Any, now: Any, put: Callable[[Any], None], path: str, shared: bool) -> None:
        """Replace `now` by what was written: in its place where others may hold on to it, else anew."""
        kind = next(iter(value)) if isinstance(value, dict) else ""
        if kind == "fixed":
            if self.write(now, path) != value:
                raise StateError(f"{path} must be {self.write(now, path)}, is {value}")
        elif kind in ("random", "optimizer", "state"):
            self._put_thing(value[kind], now, path)
        elif isinstance(now, Tensor):
            self._put_tensor(value, now, path)
        else:
            new = self.read(value, path)
            if isinstance(now, np.ndarray) and isinstance(new, np.ndarray):
                if new.shape != now.shape or new.dtype != now.dtype:
                    raise StateError(f"{path} must be {now.dtype} {now.shape}, is {new.dtype} {new.shape}")
                put(new)
            elif isinstance(now, dict) and isinstance(new, dict):
                now.clear()
                now.update(new)
            elif isinstance(now, deque | list) and type(new) is type(now):
                now.clear()
                now.extend(new)
            else:
                put(new)

    def _put_tensor(self, value: Any, now: Tensor, path: str) -> None:
        array = value.get("tensor") if isinstance(value, dict) else None
        new = torch.from_numpy(array) if isinstance(array, np.ndarray) else None
        if new is None or new.shape != now.shape or new.dtype != now.dtype:
            raise StateError(f"{path} must be a tensor of {now.dtype} {tuple(now.shape)}")
        now.data.copy_(new)

    def _put_thing(self, content: Any, now: Any, path: str) -> None:
        if isinstance(now, np.random.Generator):
            set_generator_state(now, content)
        elif isinstance(now, np.random.RandomState):
            set_plain_state(now, content)
        elif isinstance(now, random.Random):
            now.setstate(self.read(content, path))
        elif isinstance(now, torch.Generator):
            now.set_state(torch.from_numpy(content))
        elif isinstance(now, torch.optim.Optimizer):
            self._put_optimizer(content, now, path)
        else:
            now.set_state(content)

    def _put_optimizer(self, content: Any, now: torch.optim.Optimizer, path: str) -> None:
        new = self.read(content, path)
        parameters = [parameter for group in now.param_groups for parameter in group["params"]]
        for number, entries in new["state"].items():
            for name, entry in entries.items():
                if isinstance(entry, Tensor) and entry.ndim and entry.shape != parameters[number].shape:
                    raise StateError(f"{path}: {name} must have the shape {tuple(parameters[number].shape)}")
        now.load_state_dict(new)

    def _write_array(self, array: NDArray[Any]) -> Any:
        rows = self._as_rows(array)
        return array if rows is None else {"rows": rows, "shape": list(array.shape)}

    def _as_rows(self, array: NDArray[Any]) -> NDArray[Any] | None:
        """The states (n,) whose observations the array begins with and has nothing else in it, if it does."""
        width = len(self._row)
        if not width or array.dtype != self._observation.space.dtype or array.shape[-width:] != self._row:
            return None
        flat = array.reshape(-1, *self._row)
        if len(flat) < _FEW_ROWS or not array.flags.c_contiguous:
            return None
        count = -(-filled(flat) // (flat[0].nbytes or 1))
        states = np.empty(count, dtype=np.min_scalar_type(self._observation.num_states - 1))
        for start in range(0, count, _PIECE):
            rows = flat[start : min(start + _PIECE, count)]
            found = self._find(rows)
            if found is None:
                return None
            states[start : start + len(rows)] = found
        return states

    def _find(self, rows: NDArray[Any]) -> NDArray[Any] | None:
        if self._observation.kind == "one_hot":
            states = rows.argmax(axis=1)
        else:
            if self._sorted is None:
                table = _as_bytes(self._observation.table())
                order = np.argsort(table)
                self._sorted = table[order], order
            table, order = self._sorted
            states = order[np.minimum(np.searchsorted(table, _as_bytes(rows)), len(order) - 1)]
        return states if self._observation.rows(states).tobytes() == rows.tobytes() else None

    def _read_rows(self, states: Any, shape: Any) -> NDArray[Any]:
        count = int(np.prod(shape[: len(shape) - len(self._row)]))
        if tuple(shape[len(shape) - len(self._row) :]) != self._row or len(states) > count:
            raise StateError("rows of observations must have the observation's shape")
        if len(states) and int(states.max()) >= self._observation.num_states:
            raise StateError(f"states must be below {self._observation.num_states}")
        row = np.zeros(self._row, dtype=self._observation.space.dtype)
        check_memory("the observations in its checkpoint", count * row.nbytes)
        array = np.zeros((count, *self._row), dtype=row.dtype)
        self._observation.rows(states.astype(np.int64), out=array[: len(states)])
        return array.reshape(shape)


def _as_bytes(rows: NDArray[Any]) -> NDArray[Any]:
    flat = np.ascontiguousarray(rows).reshape(len(rows), -1)
    return flat.view(np.dtype((np.void, flat.dtype.itemsize * flat.shape[1])))[:, 0]
