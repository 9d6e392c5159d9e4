"""An optimiser's steps on all parameters joined into one vector.

On networks this small the framework's overhead is the cost, and it is paid per tensor. So all parameters are
made views of one vector, as are their gradients, and a twin of the policy's optimiser steps on that vector.
For an optimiser that looks at every weight by itself, as Adam does, the numbers are the same to the last bit;
`ELEMENTWISE` lists those that do. The policy's own optimiser holds views of its twin's state, so that files
and callbacks see what they would see without it.
"""

from __future__ import annotations

import copy
import inspect
import math
from collections.abc import Sequence
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor, nn

ELEMENTWISE: tuple[type[torch.optim.Optimizer], ...] = (
    *(torch.optim.Adadelta, torch.optim.Adagrad, torch.optim.Adam, torch.optim.AdamW, torch.optim.Adamax),
    *(torch.optim.NAdam, torch.optim.RAdam, torch.optim.RMSprop, torch.optim.SGD),
)

# What torch.autograd's functions call once they have imported sympy, for shapes that are symbols.
ENGINE: Any = torch.autograd.Variable._execution_engine


class FlatOptimizer:
    """Takes the steps of `optimizer` as SB3 does: gradients from zero, clipped by their common norm.

    Args:
        optimizer: the policy's.
        parameters: those of its parameters that are to change; None: all.
    """

    def __init__(
        self, optimizer: torch.optim.Optimizer, parameters: Sequence[nn.Parameter] | None = None
    ) -> None:
        (group,) = optimizer.param_groups
        self._optimizer = optimizer
        self._parameters: Sequence[Tensor] = group["params"] if parameters is None else parameters
        self._leaves = () if parameters is None else tuple(parameters)  # of backward passes; (): all
        joined = torch.cat([parameter.detach().ravel() for parameter in self._parameters])
        self._joined = nn.Parameter(joined)
        self._gradient = self._joined.grad = torch.zeros_like(joined)
        for parameter, view in zip(self._parameters, self._views(joined), strict=True):
            parameter.data = view
        self._gradients = self._views(self._gradient)
        twin: Any = type(optimizer)
        self._twin: torch.optim.Optimizer = twin([{**group, "params": [self._joined]}])
        if isinstance(optimizer, torch.optim.Adam) and joined.device.type == "cpu":
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
        """
        self._gradient.zero_()
        if self._parameters[0].grad is not self._gradients[0]:
            for parameter, view in zip(self._parameters, self._gradients, strict=True):
                parameter.grad = view
        ENGINE.run_backward(
            tuple(outputs),
            tuple(
                torch.as_tensor(slope, dtype=output.dtype, device=output.device).view_as(output)
                for output, slope in zip(outputs, slopes, strict=True)
            ),
            *(False, False, self._leaves),  # the graph is not kept, no graph of the gradients
            allow_unreachable=True,
            accumulate_grad=True,
        )
        # As torch.nn.utils.clip_grad_norm_ does it.
        norm = self._gradient.norm().item()
        if not norm < math.inf:
            raise FloatingPointError("the gradient is no finite number")
        scale = max_grad_norm / (norm + 1e-6)
        if scale < 1:
            self._gradient *= scale
        if self._optimizer.state is not self._shared and self._optimizer.state:
            self._take_over()
        self._twin.param_groups[0]["lr"] = self._optimizer.param_groups[0]["lr"]
        with torch.no_grad():
            self._step(self._twin)
        if self._optimizer.state is not self._shared:
            self._share()

    def _share(self) -> None:
        """Let the optimiser's state of each parameter be a view of its twin's."""
        for name, value in self._twin.state[self._joined].items():
            whole = isinstance(value, Tensor) and value.shape == self._joined.shape
            parts = self._views(value) if whole else [value] * len(self._parameters)
            for parameter, part in zip(self._parameters, parts, strict=True):
                self._optimizer.state[parameter][name] = part
        self._shared = self._optimizer.state

    def _take_over(self) -> None:
        """Go on from a state that somebody loaded into the optimiser."""
        states = [self._optimizer.state[parameter] for parameter in self._parameters]
        for name, value in states[0].items():
            whole = isinstance(value, Tensor) and value.shape == self._parameters[0].shape
            self._twin.state[self._joined][name] = (
                torch.cat([state[name].ravel() for state in states]) if whole else copy.copy(value)
            )

    def _views(self, joined: Tensor) -> list[Tensor]:
        """A vector of all weights, cut into the parameters' shapes."""
        parts = torch.split(joined, [parameter.numel() for parameter in self._parameters])
        return [part.view_as(of) for part, of in zip(parts, self._parameters, strict=True)]
