"""An optimiser's steps on all parameters joined into one vector.

On networks this small the framework's overhead is the cost, and it is paid per tensor. So all parameters are
made views of one vector, as are their gradients, and a twin of the policy's optimiser steps on that vector.
For an optimiser that looks at every weight by itself, as Adam does, the steps are the same up to rounding;
`ELEMENTWISE` lists them. The last bit may differ: on the CPU Adam's twin takes torch's fused step, which some
processors round differently, and which may depend on a weight's place in its vector. A run's vector is the
same alone, in a population and after a resume, and so are its bits. The policy's own optimiser holds views of
its twin's state, so that files and callbacks see what they would see without it.

A step takes numbers below 1.2e-38 for 0. The moment of a weight whose gradient has become 0 would shrink to
one of these and stay it for ever; processors are a hundred times slower with them, and no weight is moved.
"""

from __future__ import annotations

import contextlib
import copy
import inspect
import math
from collections.abc import Callable, Hashable, Iterator, Sequence
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor, nn

ELEMENTWISE: tuple[type[torch.optim.Optimizer], ...] = (
    *(torch.optim.Adadelta, torch.optim.Adagrad, torch.optim.Adam, torch.optim.AdamW, torch.optim.Adamax),
    *(torch.optim.NAdam, torch.optim.RAdam, torch.optim.RMSprop, torch.optim.SGD),
)
_SMALLEST = math.ulp(0.0)  # a denormal number

# What torch.autograd's functions call once they have imported sympy, for shapes that are symbols.
ENGINE: Any = torch.autograd.Variable._execution_engine


class FlatOptimizer:
    """Takes the steps of `optimizer` as SB3 does: gradients from zero, clipped by their common norm.

    Args:
        optimizer: the policy's.
        parameters: those of its parameters that are to change; None: all.

    Attributes:
        weights: (N,), all parameters.
        gradient: (N,), theirs.
    """

    def __init__(
        self, optimizer: torch.optim.Optimizer, parameters: Sequence[nn.Parameter] | None = None
    ) -> None:
        (group,) = optimizer.param_groups
        self._optimizer = optimizer
        self.parameters: Sequence[Tensor] = group["params"] if parameters is None else parameters
        self._leaves = () if parameters is None else tuple(parameters)  # of backward passes; (): all
        self.weights = torch.cat([parameter.detach().ravel() for parameter in self.parameters])
        self._joined = nn.Parameter(self.weights)
        self.gradient = self._joined.grad = torch.zeros_like(self.weights)
        for parameter, view in zip(self.parameters, self.cut(self.weights), strict=True):
            parameter.data = view
        self._gradients = self.cut(self.gradient)
        twin: Any = type(optimizer)
        self._twin: torch.optim.Optimizer = twin([{**group, "params": [self._joined]}])
        if isinstance(optimizer, torch.optim.Adam) and self.weights.device.type == "cpu":
            self._twin.param_groups[0]["fused"] = True
        # Bare of what torch wraps around it for profilers, hooks and the compiler, none of which are here.
        self._step = inspect.unwrap(type(optimizer).step)
        self._shared: Any = None  # the state of `optimizer` once it consists of views

    def step(self, outputs: Sequence[Tensor], slopes: Sequence[NDArray[Any]], max_grad_norm: float) -> None:
        """Make one step, from a loss's slopes in the network's outputs.

        Args:
            outputs: of the network, with their graph.
            slopes: one array per output, of its shape.
            max_grad_norm: the gradient's norm is clipped to it.

        Raises:
            FloatingPointError: the gradient is no finite number; no step was made.
        """
        self.backward(outputs, slopes)
        norm = self.gradient.norm().item()
        if not norm < math.inf:
            raise not_finite()
        if (scale := clipping(norm, max_grad_norm)) < 1:
            self.gradient *= scale
        self.advance()

    def backward(self, outputs: Sequence[Tensor], slopes: Sequence[NDArray[Any]]) -> None:
        """Set the gradient to that of a loss with these slopes in the network's outputs."""
        self.gradient.zero_()
        self._attach()
        run_backward(outputs, slopes, self._leaves)

    def _attach(self) -> None:
        """Let each parameter's gradient be a view, should somebody have removed it."""
        if self.parameters[0].grad is not self._gradients[0]:
            for parameter, view in zip(self.parameters, self._gradients, strict=True):
                parameter.grad = view

    def advance(self) -> None:
        """Let the optimiser step on the gradient as it is."""
        self.settings()
        with torch.no_grad(), _flushing_denormals():
            self._step(self._twin)
        self._share()

    def settings(self) -> dict[str, Any]:
        """The optimiser's settings for its next step, the learning rate among them."""
        if self._optimizer.state is not self._shared and self._optimizer.state:
            self._take_over()
        group = self._twin.param_groups[0]
        group["lr"] = self._optimizer.param_groups[0]["lr"]
        return group

    @property
    def kind(self) -> Hashable:
        """Equal for optimisers that `joint_step` takes together."""
        return type(self._optimizer), repr({**self.settings(), "params": None})

    def work_on(self, weights: Tensor, gradient: Tensor) -> None:
        """Step on these vectors (N,) from here on; the parameters stay where they are."""
        self._joined.data, self._joined.grad = weights, gradient

    def take_back(self) -> None:
        """Copy the vectors of `work_on` into its own, and step on these again."""
        assert self._joined.grad is not None
        self.weights.copy_(self._joined.detach())
        self.gradient.copy_(self._joined.grad)
        self._attach()
        self.work_on(self.weights, self.gradient)
        self._share()

    def _share(self) -> None:
        """Let the optimiser's state of each parameter be a view of its twin's, once that has one."""
        if self._optimizer.state is self._shared or not self._twin.state[self._joined]:
            return
        for name, value in self._twin.state[self._joined].items():
            whole = isinstance(value, Tensor) and value.shape == self._joined.shape
            parts = self.cut(value) if whole else [value] * len(self.parameters)
            for parameter, part in zip(self.parameters, parts, strict=True):
                self._optimizer.state[parameter][name] = part
        self._shared = self._optimizer.state

    def _take_over(self) -> None:
        """Go on from a state that somebody loaded into the optimiser."""
        states = [self._optimizer.state[parameter] for parameter in self.parameters]
        for name, value in states[0].items():
            whole = isinstance(value, Tensor) and value.shape == self.parameters[0].shape
            self._twin.state[self._joined][name] = (
                torch.cat([state[name].ravel() for state in states]) if whole else copy.copy(value)
            )

    def cut(self, joined: Tensor) -> list[Tensor]:
        """Vectors (..., N) of all weights, cut into views of the parameters' shapes."""
        parts = torch.split(joined, [parameter.numel() for parameter in self.parameters], dim=-1)
        pairs = zip(parts, self.parameters, strict=True)
        return [part.view(*part.shape[:-1], *of.shape) for part, of in pairs]


def joint_step(optimizers: Sequence[FlatOptimizer]) -> Callable[[], None]:
    """A step of optimisers of one kind at once, each as its `advance` makes it, on what they work on."""
    first, vectors = optimizers[0], [each._joined for each in optimizers]
    twin: Any = type(first._optimizer)
    all_ = twin([{**first.settings(), "params": vectors}])
    for each, vector in zip(optimizers, vectors, strict=True):
        all_.state[vector] = each._twin.state[vector]

    def step() -> None:
        with torch.no_grad(), _flushing_denormals():
            first._step(all_)

    return step


@contextlib.contextmanager
def _flushing_denormals() -> Iterator[None]:
    """Take denormal numbers for 0 within, on processors that can."""
    if _SMALLEST * 1.0 == 0:  # they are already, by somebody else's wish
        yield
        return
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(False)


def run_backward(
    outputs: Sequence[Tensor],
    slopes: Sequence[NDArray[Any]],
    leaves: Sequence[Tensor] = (),
    accumulates: bool = True,
) -> Sequence[Tensor]:
    """Take a loss's slopes in the outputs back to the weights.

    Args:
        outputs: of a network, with their graph, which is used up.
        slopes: an array for each output.
        leaves: the weights whose gradients are asked for; (): all.
        accumulates: whether gradients are added to those that the weights have.

    Returns:
        The gradients of `leaves`, if they were not added.
    """
    gradients: Sequence[Tensor] = ENGINE.run_backward(
        tuple(outputs),
        tuple(
            torch.as_tensor(slope, dtype=output.dtype, device=output.device).view_as(output)
            for output, slope in zip(outputs, slopes, strict=True)
        ),
        *(False, False, tuple(leaves)),  # the graph is not kept, no graph of the gradients
        allow_unreachable=True,
        accumulate_grad=accumulates,
    )
    return gradients


def not_finite() -> FloatingPointError:
    """The error to raise where a gradient is no finite number."""
    return FloatingPointError("the gradient is no finite number")


def clipping(norm: float, max_grad_norm: float) -> float:
    """What a gradient of this norm is multiplied by if it is below 1, as `clip_grad_norm_` of torch does."""
    return max_grad_norm / (norm + 1e-6)
