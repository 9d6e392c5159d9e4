"""The oracle ablation: a model's network fitted to the exact answer by supervised learning.

What keeps failing is the network itself, since nothing else of reinforcement learning is left: no
exploration, no bootstrapping, no moving target.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.policies import BasePolicy
from torch import Tensor

from gridworld.agents import Agent
from gridworld.agents.sb3.agent import SB3Agent
from gridworld.agents.sb3.policy_outputs import read
from gridworld.world.mdp import IntArray
from gridworld.world.solver import Solution

_RATE = 3e-3
_STEPS, _FEWEST = 1500, 500  # of the fit; a network that is too slow for the fewest is not judged
_EVERY = 25  # steps between two looks
_WORK = 6e8  # weights times states times steps: about a second


def oracle_fit(
    agent: Agent, best: Solution, states: IntArray, is_optimal: Callable[[IntArray], bool], fresh: bool
) -> bool | None:
    """Fit a copy of a model's network to the optimum.

    Args:
        agent: an `SB3Agent`; stays as it is.
        best: the optimum under the agent's own discount.
        states: (n,), those to fit: that an episode can come to.
        is_optimal: judges greedy actions (S,).
        fresh: whether to begin with new weights, not those that the model has learnt.

    Returns:
        Whether the greedy actions became optimal; None: the network is too large to say in time.
    """
    assert isinstance(agent, SB3Agent)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        policy = copy.deepcopy(agent.model.policy)
        weights = sum(each.numel() for each in policy.parameters())
        steps = int(min(_STEPS, _WORK / (weights * len(states))))
        if steps < _FEWEST:
            return None
        if fresh:
            _renew(policy)
        observations, _ = policy.obs_to_tensor(agent.observation.rows(states))
        greedy = np.argmax(best.q, axis=1)
        return _fit(
            policy,
            observations,
            _Targets(best, states),
            steps,
            lambda actions: is_optimal(_placed(greedy, states, actions)),
        )


class _Targets:
    """The exact answer of n states.

    Attributes:
        q: (n, A), advantages in units of their deviation: a scale that no network finds hard.
        optimal: (n, A), 1 for the optimal actions.
    """

    def __init__(self, best: Solution, states: IntArray) -> None:
        q = best.q[states] - best.v[states][:, None]
        q = np.where(np.isfinite(q), q, 0.0)
        self.q = torch.tensor(q / max(float(q.std()), 1e-12), dtype=torch.float32)
        self.optimal = torch.tensor(best.optimal[states], dtype=torch.float32)

    def loss(self, policy: BasePolicy, observations: Any) -> tuple[Tensor, Tensor]:
        """What to descend, and the greedy actions (n,)."""
        found = read(policy, observations)
        if found.probabilities is not None:
            right = (found.probabilities * self.optimal).sum(dim=1).clamp_min(1e-12)
            return -right.log().mean(), found.probabilities.argmax(dim=1)
        assert found.q is not None
        return ((found.q - self.q) ** 2).mean(), found.q.argmax(dim=1)


def _fit(
    policy: BasePolicy,
    observations: Any,
    targets: _Targets,
    steps: int,
    is_optimal: Callable[[IntArray], bool],
) -> bool:
    for weights in policy.parameters():
        weights.requires_grad_(True)
    optimizer = torch.optim.Adam(policy.parameters(), lr=_RATE)
    for step in range(steps + 1):
        loss, actions = targets.loss(policy, observations)
        if step % _EVERY == 0 and is_optimal(actions.numpy()):
            return True
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
    return False


def _renew(policy: BasePolicy) -> None:
    for module in policy.modules():
        if callable(reset := getattr(module, "reset_parameters", None)):
            reset()


def _placed(actions: IntArray, states: IntArray, found: IntArray) -> IntArray:
    placed = actions.copy()
    placed[states] = found
    return placed
