"""The memory that a model takes, computed before it is built; and models without buffers."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import BaseBuffer
from torch.overrides import TorchFunctionMode

from gridworld.envs.observations import ObservationTable
from gridworld.process.memory_budget import check_memory, is_limited

CHUNK = 4096  # states a forward pass

# Beside each weight there are its gradient and what the optimiser keeps of it, or, while a file is read, the
# file, its member and the tensor in it.
_COPIES = 4
_NUMBER = 4  # bytes of a weight, and of an activation
# A pass makes of each byte of an observation: numbers of 4 bytes, scaled, and the first layer's answer.
_PIXEL_PASS, _NUMBER_PASS = 24, 2
_MAKERS = ("empty", "zeros", "ones", "full", "rand", "randn", "eye")
_NEW = ("new_empty", "new_zeros", "new_ones", "new_full")


class NoBuffer(BaseBuffer):
    """Stands where a model that is only asked would keep what it meets."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        pass

    def _get_samples(self, *arguments: Any, **options: Any) -> Any:
        raise NotImplementedError("nothing was kept")


class Weighing(TorchFunctionMode):
    """For the block: before torch makes a tensor of a network, ask whether there is memory for it."""

    def __init__(self, name: str, observation: ObservationTable) -> None:
        super().__init__()
        self._what = f"agent={name}: its network"
        self._beside = _table_size(observation)
        self._total = 0

    def __torch_function__(
        self, function: Any, types: Any, arguments: tuple[Any, ...] = (), options: Any = None
    ) -> Any:
        called = getattr(function, "__name__", "")
        if called in _MAKERS:
            self._total += _NUMBER * _count(arguments)
            check_memory(self._what, self._beside + _COPIES * self._total)
        elif called in _NEW:  # for a moment
            check_memory(self._what, self._beside + _COPIES * _NUMBER * _count(arguments[1:]))
        return function(*arguments, **(options or {}))


@contextmanager
def weighed(name: str, observation: ObservationTable) -> Iterator[None]:
    """Have a model that is built in the block keep to the memory budget, where there is one.

    Args:
        name: the agent's, for the message.
        observation: what it sees.
    """
    if not is_limited():
        yield
        return
    with Weighing(name, observation):
        yield


def check_model(model: BaseAlgorithm, name: str, observation: ObservationTable) -> None:
    """Check a model's forward pass and buffers against the memory budget.

    Args:
        model: the model.
        name: the agent's, for the message.
        observation: what it sees.
    """
    if not is_limited():
        return
    row, states = observation.space, min(observation.num_states, CHUNK)
    per_byte = _PIXEL_PASS if row.dtype == np.uint8 else _NUMBER_PASS
    layers = (each for each in model.policy.modules() if isinstance(each, torch.nn.Linear))
    widest = max((layer.out_features for layer in layers), default=0)
    each = per_byte * math.prod(row.shape or ()) * np.dtype(row.dtype).itemsize + 3 * _NUMBER * widest
    asked = f"agent={name}: its network, asked about every state"
    check_memory(asked, _table_size(observation) + states * each)
    buffers = (getattr(model, f"{kind}_buffer", None) for kind in ("replay", "rollout"))
    arrays = (array for each in buffers if each is not None for array in vars(each).values())
    kept = sum(array.nbytes for array in arrays if isinstance(array, np.ndarray))
    check_memory(f"agent={name}: its buffers", kept)


def _table_size(observation: ObservationTable) -> int:
    return 0 if observation.stored is None else observation.stored.nbytes


def _count(sizes: tuple[Any, ...]) -> int:
    """Of the numbers in a tensor of these sizes, which stand alone or in a tuple, a shape for example."""
    whole = sizes[0] if sizes and isinstance(sizes[0], tuple | list) else sizes
    return math.prod(size for size in whole if isinstance(size, int))
