"""Networks of one shape run at once: a layer is a batched product of (P, U, in) with (P, in, out).

A batched product of matrices calls, for each of them, the routine that a single one calls. So each network's
numbers are the same to the last bit, as far as its own numbers lie in memory as they do alone. Of products
with vectors this is tried out (`_batch_is_as_single`), and they are made one by one where it is not so.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

ALIGNMENT = 16  # numbers; torch begins every tensor at a multiple of 64 bytes
Leaves = Mapping[int, Tensor]  # by the identity of the first network's parameter: (P, *its shape)


def forward(network: Iterable[nn.Module], leaves: Leaves, features: Tensor | None) -> Tensor:
    """Run P networks of one shape.

    Args:
        network: the layers of the first of them.
        leaves: the weights of all, of `SideBySide`.
        features: (U, n), the same for all; None: the first layer is linear and its input the unit vectors.

    Returns:
        (P, U, m).
    """
    hidden = features
    for layer in network:
        if not isinstance(layer, nn.Linear):
            hidden = layer(hidden)
            continue
        weight, bias = leaves[id(layer.weight)], leaves[id(layer.bias)][:, None]
        if hidden is None:
            hidden = weight.transpose(1, 2) + bias
            continue
        if hidden.dim() == 2:
            hidden = hidden.expand(len(weight), *hidden.shape)
        hidden = _linear(hidden, weight, bias)
    assert hidden is not None
    return hidden


class _Linear(torch.autograd.Function):
    """P linear layers, with the products that torch makes for a single one, in both directions.

    A layer with one output is a product with a vector, which some processors add up in another order than a
    batch of such products, and all in an order that depends on where its numbers lie. Where the batch would
    not do, it is made run by run, of copies that lie as those of a single layer.
    """

    @staticmethod
    def forward(ctx: Any, inputs: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        ctx.save_for_backward(inputs, weight)
        if weight.shape[1] > 1:
            return torch.baddbmm(bias, inputs, weight.transpose(1, 2))
        if _adds_up_as_alone(inputs):
            return torch.bmm(weight, inputs.transpose(1, 2)).transpose(1, 2) + bias
        rows = zip(bias, inputs, weight, strict=True)
        return torch.stack([torch.addmm(own, x.clone(), w.t()) for own, x, w in rows])

    @staticmethod
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor | None, Tensor, Tensor]:
        inputs, weight = ctx.saved_tensors
        of_inputs = None
        if ctx.needs_input_grad[0] and _is_transposed(inputs):
            of_inputs = torch.bmm(weight.transpose(1, 2), slope.transpose(1, 2)).transpose(1, 2)
        elif ctx.needs_input_grad[0]:
            of_inputs = torch.bmm(slope, weight)
        if weight.shape[1] > 1 or _adds_up_as_alone(inputs):
            of_weight = torch.bmm(slope.transpose(1, 2), inputs)
        else:
            rows = zip(slope, inputs, strict=True)
            of_weight = torch.stack([torch.mm(g.clone().t(), x.clone()) for g, x in rows])
        return of_inputs, of_weight, slope.sum(1, keepdim=True)


def _is_transposed(inputs: Tensor) -> bool:
    return inputs.stride()[1:] == (1, inputs.shape[1])


def _adds_up_as_alone(inputs: Tensor) -> bool:
    lies_so = not _is_transposed(inputs) and inputs.stride(0) % ALIGNMENT == 0
    return lies_so and (not inputs.is_cpu or _batch_is_as_single(*inputs.shape[1:], torch.get_num_threads()))


@functools.lru_cache(maxsize=256)
def _batch_is_as_single(rows: int, width: int, threads: int) -> bool:
    """Whether products with vectors add up in a batch as each does alone, in both directions."""
    count = max(2, 256 // rows)  # enough numbers to tell, also where there are few rows
    numbers = np.random.default_rng(0)
    inputs, weight, slope = (
        torch.from_numpy(numbers.normal(size=(count, *shape)).astype(np.float32))
        for shape in ((rows, width), (width, 1), (rows, 1))
    )
    outputs, slopes = torch.bmm(weight.transpose(1, 2), inputs.transpose(1, 2)), slope.transpose(1, 2)
    return all(
        torch.equal(own_output[0], torch.mm(x.clone(), w.clone())[:, 0])
        and torch.equal(own_slope, torch.mm(g.clone().t(), x.clone()))
        for own_output, own_slope, x, w, g in zip(
            outputs, torch.bmm(slopes, inputs), inputs, weight, slope, strict=True
        )
    )


_linear: Any = _Linear.apply


def can_stand(*networks: nn.Module) -> bool:
    """Whether all that these networks learn is in linear layers with a bias, as `forward` runs them."""
    layers = [layer for network in networks for layer in network.modules() if not list(layer.children())]
    return all(
        layer.bias is not None if isinstance(layer, nn.Linear) else not list(layer.parameters())
        for layer in layers
    )
