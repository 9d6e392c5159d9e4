"""Stepping on all parameters as one vector is stepping on each of them."""

import copy
import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from gridworld.agents.sb3.tabulated.flat_optimizer import ELEMENTWISE, FlatOptimizer, joint_step
from gridworld.agents.sb3.tabulated.side_by_side import stacked

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


@pytest.mark.parametrize("kind", ELEMENTWISE)
def test_steps_in_a_population_and_after_a_resume_have_the_bits_of_those_alone(
    kind: type[torch.optim.Optimizer],
) -> None:
    """These bits are promised, at every length: a kernel may round a vector's last few numbers otherwise."""
    make: Any = kind
    for length in (*range(1, 40), 129, 1000):
        torch.manual_seed(length)
        slopes = torch.randn(5, 3, length) * 10 ** torch.randn(5, 1, 1)  # steps, runs, weights
        first = torch.randn(3, length)
        alone, members, resumed = (
            [FlatOptimizer(make([nn.Parameter(run.clone())], lr=0.01)) for run in first] for _ in range(3)
        )
        weights, _ = stacked(members)
        gradients = weights.new_zeros(3, weights.stride(0))[:, :length]
        for member, *row in zip(members, weights, gradients, strict=True):
            member.work_on(*row)
        step = joint_step(members)
        for number, slope in enumerate(slopes):
            for run, own in enumerate(alone):
                own.gradient.copy_(slope[run])
                own.advance()
                if number == 2:
                    resumed[run].weights.copy_(own.weights)
                    resumed[run]._optimizer.load_state_dict(copy.deepcopy(own._optimizer.state_dict()))
                elif number > 2:
                    resumed[run].gradient.copy_(slope[run])
                    resumed[run].advance()
            gradients.copy_(slope)
            step()
        for run, own in enumerate(alone):
            assert torch.equal(own.weights, weights[run])
            assert torch.equal(own.weights, resumed[run].weights)


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


def is_denormal(numbers: torch.Tensor) -> torch.Tensor:
    return (numbers != 0) & (numbers.abs() < torch.finfo(numbers.dtype).tiny)


@pytest.mark.parametrize("by_somebody_else", [False, True])
@pytest.mark.parametrize("jointly", [False, True])
@pytest.mark.parametrize("kind", [torch.optim.Adam, torch.optim.RMSprop], ids=["Adam", "RMSprop"])
def test_moments_that_shrink_never_become_denormal_and_weights_are_the_same(
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
        assert torch.allclose(mine, peer, rtol=1e-5, atol=1e-7)
        assert not is_denormal(ours.state[mine][moment]).any()
        assert is_denormal(theirs.state[peer][moment]).any()  # this is what costs
