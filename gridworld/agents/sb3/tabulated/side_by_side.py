"""Networks of one shape side by side: P of them make a step in the time that one takes.

While several runs train together (`process.parallel.together`), an update is made for all of them at once:
their weights stand in one matrix (P, N), the networks run at once (`tabulated.stacked_layers`), and each
row is clipped and stepped as it would be alone. That each network's numbers are then the same to the last
bit depends on the processor and on the build of torch; `agree` tries it out on the networks at hand. Only
runs that are to be mixed, as may be asked for on CUDA, are updated at once whatever comes of it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Sequence
from types import TracebackType
from typing import Any, Protocol, Self, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gridworld.agents.sb3.tabulated.flat_optimizer import FlatOptimizer, clipping, joint_step, run_backward
from gridworld.agents.sb3.tabulated.stacked_layers import ALIGNMENT, Leaves
from gridworld.process.console.terminal import tell


class Tabulated(Protocol):
    """A model that can be updated side by side with others of its kind."""

    descent: FlatOptimizer
    inputs: Any  # `state_inputs.StateInputs`

    def outputs_of_all(self, leaves: Leaves | None = None) -> Sequence[Tensor]:
        """What its network says of all states, (S, ...) each, with the graph.

        Args:
            leaves: the weights of P networks of this shape, of `SideBySide`; then (P, S, ...) each, of these.
        """


class Member(Protocol):
    """A model's part in an update."""

    @property
    def model(self) -> Tabulated: ...


M = TypeVar("M", bound=Member)
Errors = list[Exception | None]  # to raise in each member


def update_together(update: Callable[[Sequence[M]], Errors], members: Sequence[M]) -> Errors:
    """Update models at once, or one by one where that would not give the same numbers.

    Args:
        update: does it for several, or one; `meet` has seen to it that they are of one kind.
        members: the models' parts.
    """
    if len(members) > 1 and not agree([member.model for member in members]):
        return [error for member in members for error in update([member])]
    return update(members)


_agreed: dict[Hashable, bool] = {}


def agree(models: Sequence[Tabulated]) -> bool:
    """Whether these models side by side give the numbers of each alone, to the last bit, or need not.

    It is tried out once in a process for each kind and number of them and of threads, forwards and backwards.
    """
    if models[0].inputs.mixes:
        return True
    key = models[0].inputs.kind, len(models), torch.get_num_threads()
    if key not in _agreed:
        was_told = not all(_agreed.values())
        _agreed[key] = _try_out(models)
        if not (_agreed[key] or was_told):
            tell(
                "population: this processor or torch adds up otherwise for several networks like these at "
                "once; such runs train one by one"
            )
    return _agreed[key]


def _try_out(models: Sequence[Tabulated]) -> bool:
    generator = np.random.default_rng(0)
    optimizers = [model.descent for model in models]
    with SideBySide(optimizers) as rows:
        outputs = models[0].outputs_of_all(rows.leaves)
        slopes = [generator.normal(size=output.shape) for output in outputs]
        gradients = rows.backward(outputs, slopes)
        for row, model in enumerate(models):
            alone = model.outputs_of_all()
            if not all(torch.equal(mine, all_[row]) for mine, all_ in zip(alone, outputs, strict=True)):
                return False
            model.descent.backward(alone, [slope[row] for slope in slopes])
            if not torch.equal(model.descent.gradient, gradients[row]):
                return False
    return True


def stacked(optimizers: Sequence[FlatOptimizer]) -> tuple[Tensor, Leaves]:
    """Copies of the weights of P optimisers, (P, N); and as `stacked_layers.forward` takes them."""
    own = [each.weights for each in optimizers]
    # Each row begins where a vector of its own would: products with vectors add up by alignment.
    width = -(-len(own[0]) // ALIGNMENT) * ALIGNMENT
    weights = torch.stack(own, out=own[0].new_empty(len(own), width)[:, : len(own[0])])
    first = optimizers[0]
    leaves = [view.detach().requires_grad_() for view in first.cut(weights)]
    return weights, {id(of): leaf for of, leaf in zip(first.parameters, leaves, strict=True)}


class SideBySide:
    """The weights of P optimisers while they step together, as a context manager.

    Inside the block the optimisers' own parameters are stale, except that a single optimiser steps on them
    as it always does.

    Args:
        optimizers: of P networks of the same shapes.

    Attributes:
        leaves: the weights, for `stacked_layers.forward`; none where there is one optimiser.
    """

    def __init__(self, optimizers: Sequence[FlatOptimizer]) -> None:
        self._optimizers = optimizers
        self.leaves: Leaves = {}
        self._steps: dict[tuple[int, ...], list[Callable[[], None]]] = {}  # by the rows that step

    def __enter__(self) -> Self:
        if len(self._optimizers) == 1:
            return self
        self._weights, self.leaves = stacked(self._optimizers)
        runs, count = self._weights.shape
        self._gradients = self._weights.new_zeros(runs, self._weights.stride(0))[:, :count]
        for each, weights, gradient in zip(self._optimizers, self._weights, self._gradients, strict=True):
            each.work_on(weights, gradient)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if len(self._optimizers) == 1:
            return
        for each in self._optimizers:
            each.take_back()

    def step(
        self,
        outputs: Sequence[Tensor],
        slopes: Sequence[NDArray[Any]],
        max_grad_norms: Sequence[float],
        rows: Sequence[int],
    ) -> list[bool]:
        """Make one step of some of the optimisers.

        Args:
            outputs: of the networks, (P, ...) each, with their graph.
            slopes: an array for each output, of its shape.
            max_grad_norms: P, what each gradient's norm is clipped to.
            rows: which of the P are to step.

        Returns:
            Of each of `rows`, whether its gradient was finite; if not, it made no step.
        """
        if len(self._optimizers) == 1:
            try:
                self._optimizers[0].step(outputs, slopes, max_grad_norms[0])
            except FloatingPointError:
                return [False]
            return [True]
        self.backward(outputs, slopes)
        norms = torch.linalg.vector_norm(self._gradients, dim=1).tolist()
        pairs = zip(norms, max_grad_norms, strict=True)
        scales = [min(1.0, clipping(norm, most)) for norm, most in pairs]  # 1 where it is NaN
        if min(scales) < 1:
            self._gradients *= self._gradients.new_tensor(scales)[:, None]
        finite = [norms[row] < math.inf for row in rows]
        self._advance(tuple(row for row, goes in zip(rows, finite, strict=True) if goes))
        return finite

    def backward(self, outputs: Sequence[Tensor], slopes: Sequence[NDArray[Any]]) -> Tensor:
        """Take a loss's slopes in the outputs back to the gradients (P, N) of several."""
        gradients = run_backward(outputs, slopes, tuple(self.leaves.values()), accumulates=False)
        torch.cat([each.flatten(1) for each in gradients], dim=1, out=self._gradients)
        self._gradients += 0  # as each is added to 0 where there is one network, and -0 becomes 0
        return self._gradients

    def _advance(self, rows: tuple[int, ...]) -> None:
        if rows not in self._steps:
            kinds: dict[Hashable, list[FlatOptimizer]] = {}
            for each in (self._optimizers[row] for row in rows):
                kinds.setdefault(each.kind, []).append(each)
            self._steps = {rows: [joint_step(same) for same in kinds.values()]}
        for step in self._steps[rows]:
            step()
