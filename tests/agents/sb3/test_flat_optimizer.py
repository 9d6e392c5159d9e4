"""Stepping on all parameters as one vector is stepping on each of them."""

import copy
import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from gridworld.agents.sb3.tabulated.flat_optimizer import ELEMENTWISE, FlatOptimizer, joint_step

OPTIONS: dict[str, dict[str, Any]] = {
    "Adam": {"amsgrad": True, "weight_decay": 0.01},
    "RMSprop": {"momentum": 0.9, "centered": True},
    "SGD": {"momentum": 0.9, "nesterov": True},
}


def network() -> nn.Sequential:
    torch.manual_seed(0)
    return nn.Sequential(nn.Linear(3, 5), nn.Tanh(), nn.Linear(5, 2))


def stepped(optimizer: torch.optim.Optimizer, net: nn.Sequential, seed: int, largest_norm: float) -> None:
    """One step as SB3 takes it."""
    inputs, slopes = draw(seed)
    optimizer.zero_grad()
    net(inputs).backward(torch.as_tensor(slopes, dtype=torch.float32))
    nn.utils.clip_grad_norm_(net.parameters(), largest_norm)
    optimizer.step()


def draw(seed: int) -> tuple[torch.Tensor, np.ndarray]:
    rng = np.random.default_rng(seed)
    return torch.as_tensor(rng.normal(size=(7, 3)), dtype=torch.float32), rng.normal(size=(7, 2))


def assert_same_state(one: torch.optim.Optimizer, other: torch.optim.Optimizer) -> None:
    mine, theirs = one.state_dict()["state"], other.state_dict()["state"]
    assert mine.keys() == theirs.keys() == set(range(4))
    for index, state in theirs.items():
        assert mine[index].keys() == state.keys()
        for name, value in state.items():
            assert torch.allclose(torch.as_tensor(mine[index][name]), torch.as_tensor(value), rtol=1e-4)


@pytest.mark.parametrize("largest_norm", [0.5, 100.0], ids=["clipped", "whole"])
@pytest.mark.parametrize("options", ["defaults", "options"])
@pytest.mark.parametrize("kind", ELEMENTWISE)
def test_every_elementwise_optimiser_steps_as_by_itself(
    kind: type[torch.optim.Optimizer], options: str, largest_norm: float
) -> None:
    arguments = OPTIONS.get(kind.__name__, {}) if options == "options" else {}
    ours, theirs = network(), network()
    make: Any = kind
    optimizers = [make(net.parameters(), lr=0.01, **arguments) for net in (ours, theirs)]
    descent = FlatOptimizer(optimizers[0])
    for seed in range(6):
        for optimizer in optimizers:
            optimizer.param_groups[0]["lr"] = 0.01 / (1 + seed)  # as a schedule does
        inputs, slopes = draw(seed)
        descent.step([ours(inputs)], [slopes], largest_norm)
        stepped(optimizers[1], theirs, seed, largest_norm)
        for mine, peer in zip(ours.parameters(), theirs.parameters(), strict=True):
            assert torch.allclose(mine, peer, atol=1e-6)
        if optimizers[1].state:  # plain SGD has none
            assert_same_state(*optimizers)
        if seed == 2:  # somebody loads what was saved, and it goes on from there
            optimizers[0].load_state_dict(copy.deepcopy(optimizers[1].state_dict()))


def test_gradients_that_somebody_removed_come_back() -> None:
    net = network()
    descent = FlatOptimizer(torch.optim.SGD(net.parameters(), lr=0.1))
    for _ in range(2):
        before = [parameter.detach().clone() for parameter in net.parameters()]
        net.zero_grad(set_to_none=True)
        inputs, slopes = draw(0)
        descent.step([net(inputs)], [slopes], 1.0)
        for parameter, old in zip(net.parameters(), before, strict=True):
            assert torch.allclose(parameter, old - 0.1 * parameter.grad, atol=1e-7)


@pytest.mark.parametrize("by_somebody_else", [False, True])
@pytest.mark.parametrize("jointly", [False, True])
@pytest.mark.parametrize("kind", [torch.optim.Adam, torch.optim.RMSprop], ids=["Adam", "RMSprop"])
def test_moments_that_shrink_become_zero_and_weights_are_the_same(
    kind: type[torch.optim.Optimizer], jointly: bool, by_somebody_else: bool
) -> None:
    if not torch.set_flush_denormal(False):
        pytest.skip("this processor has no such mode")
    arguments: dict[str, Any] = {"lr": 0.01} if kind is torch.optim.Adam else {"lr": 0.01, "momentum": 0.9}
    moment = "exp_avg" if kind is torch.optim.Adam else "momentum_buffer"
    nets = [network() for _ in range(2)]
    make: Any = kind
    ours, theirs = (make(net.parameters(), **arguments) for net in nets)
    descent = FlatOptimizer(ours)
    inputs, slopes = draw(0)
    descent.step([nets[0](inputs)], [slopes], math.inf)
    stepped(theirs, nets[1], 0, math.inf)
    step = joint_step([descent]) if jointly else descent.advance
    descent.gradient.zero_()
    theirs.zero_grad(set_to_none=False)
    torch.set_flush_denormal(by_somebody_else)
    try:
        for _ in range(1000):
            step()
        is_still_on = math.ulp(0.0) * 1.0 == 0
    finally:
        torch.set_flush_denormal(False)
    assert is_still_on == by_somebody_else
    for _ in range(1000):
        theirs.step()
    for mine, peer in zip(nets[0].parameters(), nets[1].parameters(), strict=True):
        assert torch.equal(mine, peer)
        assert (ours.state[mine][moment] == 0).all()
        assert (theirs.state[peer][moment] != 0).any()  # this is what costs
