"""One of torch's elementwise optimisers for P networks, each a parameter of its own."""

from __future__ import annotations

import contextlib
import inspect
import math
from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch import Tensor

from gridworld.base.serialization import StateError, fill
from gridworld.world.mdp import BoolArray

# Those that look at every weight by itself.
ELEMENTWISE: tuple[type[torch.optim.Optimizer], ...] = (
    *(torch.optim.Adadelta, torch.optim.Adagrad, torch.optim.Adam, torch.optim.AdamW, torch.optim.Adamax),
    *(torch.optim.NAdam, torch.optim.RAdam, torch.optim.RMSprop, torch.optim.SGD),
)
_SMALLEST = math.ulp(0.0)  # a denormal number


class Optimizer:
    """Steps on gradients that are clipped by each network's norm, as Stable-Baselines3 clips them.

    Each row of the weights (P, W) is a parameter, and one that makes no step has no gradient: torch skips it.
    So every run has its own count of steps, and its numbers are those of an optimiser of its own. `own` are
    the runs' optimisers, equal but for the learning rate; of `max_norms` (P,) inf clips nothing.
    """

    def __init__(
        self,
        own: Sequence[torch.optim.Optimizer],
        weights: Tensor,
        gradients: Tensor,
        max_norms: Sequence[float],
    ) -> None:
        self._rows, self._slopes, self._gradients = list(weights), list(gradients), gradients
        self._max_norms = torch.tensor(max_norms, dtype=torch.float64, device=weights.device)
        self._may_clip = min(max_norms) < math.inf
        settings = {key: value for key, value in own[0].param_groups[0].items() if key != "params"}
        if isinstance(own[0], torch.optim.Adam) and weights.device.type == "cpu":
            settings["fused"] = True
        make: Any = type(own[0])
        self._optimizer: torch.optim.Optimizer = make([{**settings, "params": [row]} for row in self._rows])
        # Bare of what torch wraps around it, which imports its compiler, and that takes a second.
        self._step = inspect.unwrap(make.step)
        self._groups = self._optimizer.param_groups
        self._rates: list[float] = []
        self._active: list[bool] = []

    def step(self, learning_rates: Sequence[float], active: BoolArray) -> BoolArray:
        """Make a step of the networks (P,) that are active and have finite gradients; returns which did."""
        norms = torch.linalg.vector_norm(self._gradients, dim=1)
        if self._may_clip:
            scales = torch.clamp(self._max_norms / (norms.double() + 1e-6), max=1.0)
            self._gradients *= scales.float()[:, None]
        finite: BoolArray = active & torch.isfinite(norms).cpu().numpy()
        if self._rates != (rates := list(learning_rates)):
            self._rates, settings = rates, {**self._groups[0]}
            groups: dict[float, list[Tensor]] = {}  # rows of one rate, which are stepped on at once
            for row, rate in zip(self._rows, rates, strict=True):
                groups.setdefault(rate, []).append(row)
            self._groups[:] = [{**settings, "lr": rate, "params": rows} for rate, rows in groups.items()]
        if self._active != (now := finite.tolist()):
            self._active = now
            for row, slope, steps in zip(self._rows, self._slopes, now, strict=True):
                row.grad = slope if steps else None
        with torch.no_grad(), _flushing_denormals():
            self._step(self._optimizer)
        return finite

    def get_state(self, run: int) -> dict[str, Any]:
        """Each number that the optimiser keeps of a run; none before its first step."""
        state = self._optimizer.state.get(self._rows[run], {})
        return {name: value.cpu().numpy().copy() for name, value in state.items()}

    def set_state(self, run: int, state: dict[str, Any]) -> None:
        if not state:
            return
        row = self._rows[run]
        # What the optimiser keeps of a row after a step, for names, shapes and types.
        make: Any = type(self._optimizer)
        other = torch.zeros_like(row)
        other.grad = torch.zeros_like(row)
        optimizer = make([{**self._groups[0], "params": [other]}])
        with torch.no_grad():
            self._step(optimizer)
        found = dict(optimizer.state[other])
        if state.keys() != found.keys():
            raise StateError(f"the optimiser's state has {', '.join(state)}, must have {', '.join(found)}")
        for name, value in found.items():
            own = value.cpu().numpy()
            fill(own, state[name], f"the optimiser's {name}")
            found[name] = torch.as_tensor(own, device=value.device)
        self._optimizer.state[row] = found


@contextlib.contextmanager
def _flushing_denormals() -> Iterator[None]:
    """Take denormal numbers, which are slow, for 0: moments of weights without a gradient shrink to them."""
    if _SMALLEST * 1.0 == 0:  # they are already, by somebody else's wish
        yield
        return
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(False)
