"""Products with the Jacobian of a network's outputs, from either side."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor

from gridworld.agents.sb3.tabulated.flat_optimizer import ENGINE


class Jacobian:
    """∂ outputs / ∂ parameters, with the parameters joined into one vector of length n.

    A backward pass gives u^T J. That is linear in u, so a backward pass through the backward pass gives J v.

    Args:
        outputs: (U, A), with their graph.
        parameters: all of which they depend on.
    """

    def __init__(self, outputs: Tensor, parameters: Sequence[Tensor]) -> None:
        self._outputs = outputs
        self._parameters = tuple(parameters)
        self._seed = torch.zeros_like(outputs, requires_grad=True)
        self._pulled = _backward(outputs, self._seed, self._parameters, create_graph=True)

    def pull(self, slopes: NDArray[Any]) -> Tensor:
        """u^T J (n,) of slopes u (U, A)."""
        seed = torch.as_tensor(slopes, dtype=self._outputs.dtype, device=self._outputs.device)
        return _backward(self._outputs, seed, self._parameters)

    def push(self, vector: Tensor) -> NDArray[Any]:
        """J v (U, A) of a change v (n,) of the parameters."""
        moved: NDArray[Any] = _backward(self._pulled, vector, (self._seed,)).cpu().numpy()
        return moved.reshape(self._outputs.shape)


def _backward(
    outputs: Tensor, seed: Tensor, inputs: tuple[Tensor, ...], create_graph: bool = False
) -> Tensor:
    """Gradients in one vector; the graph is kept. It is what torch.autograd.grad calls, see `ENGINE`."""
    found = ENGINE.run_backward(
        *((outputs,), (seed,), True, create_graph, inputs), allow_unreachable=False, accumulate_grad=False
    )
    return torch.cat([gradient.reshape(-1) for gradient in found])
