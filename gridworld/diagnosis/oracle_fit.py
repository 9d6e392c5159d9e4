"""The oracle ablation: a model's network fitted to the exact answer by supervised learning.

What keeps failing is the network itself, since nothing else of reinforcement learning is left: no
exploration, no bootstrapping, no moving target. A network too large to be fitted in about a second is not
judged: the answer is None.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from gridworld.agents import Agent
from gridworld.agents.sb3.agent import SB3Agent
from gridworld.agents.sb3.policy_outputs import Reading, read
from gridworld.world.mdp import IntArray
from gridworld.world.solver import Solution

_RATE = 3e-3
_STEPS, _FEWEST = 1500, 500  # of the fit; a network that is too slow for the fewest is not judged
_EVERY = 25  # steps between two looks
_WORK = 6e8  # weights times states times steps: about a second


def oracle_fit(
    agent: Agent, best: Solution, states: IntArray, is_optimal: Callable[[IntArray], bool], fresh: bool
) -> bool | None:
    """Whether greedy actions become optimal where a copy of a model's network is fitted to the optimum.

    `best` is the optimum under the agent's own discount, `states` (n,) are those that an episode can come to,
    `is_optimal` judges greedy actions (S,), and `fresh` weights are not those that the model has learned.
    """
    fit = _Fit(agent, best, states, advantages=True)
    actions = np.argmax(best.q, axis=1)

    def is_done(found: IntArray) -> bool:
        actions[states] = found
        return is_optimal(actions)

    return fit.run(lambda found: fit.error(found, slice(None)), is_done, fresh) if fit.is_fast else None


class OneState(NamedTuple):
    """What comes of teaching a network one state only."""

    told_apart: bool  # it can be right there while all others are held where they are
    spoilt: IntArray  # (k,), states that were right and are not, where nothing holds the others


def one_state_fit(agent: Agent, best: Solution, states: IntArray, state: int) -> OneState | None:
    """Fit a copy of a model's network, with its own weights, to the optimum in one state; see above."""
    fit = _Fit(agent, best, states, advantages=False)
    if not fit.is_fast:
        return None
    here, rows, right = int(np.flatnonzero(states == state)[0]), np.arange(len(states)), best.optimal[states]
    with torch.no_grad():
        before = read(fit.policy, fit.observations)
    last = _greedy(before)
    was_right = right[rows, last]

    def no_other_is_lost(found: IntArray) -> bool:
        return bool(right[rows, found][was_right | (rows == here)].all())

    def is_right_there(found: IntArray) -> bool:
        nonlocal last
        last = found
        return bool(right[here, found[here]])

    told_apart = fit.run(lambda found: fit.error(found, [here]) + _moved(found, before), no_other_is_lost)
    fit.run(lambda found: fit.error(found, [here]), is_right_there)
    return OneState(told_apart, states[was_right & ~right[rows, last]])


def narrowest_layer(agent: Agent) -> int:
    """The units of the narrowest layer between a network's features and its actions; 0: there is none."""
    policy = agent.model.policy
    if hasattr(policy, "mlp_extractor"):
        layers = list(policy.mlp_extractor.policy_net.modules())
    else:
        network = getattr(policy, "q_net", None) or getattr(policy, "quantile_net", None)
        linear = [each for each in network.modules() if isinstance(each, torch.nn.Linear)] if network else []
        layers = linear[:-1]
    return min((each.out_features for each in layers if isinstance(each, torch.nn.Linear)), default=0)


class _Fit:
    """Supervised fits of copies of one network to the exact answer of n states.

    The answer is Q (n, A), or advantages in units of their deviation: a scale that no network finds hard.
    """

    def __init__(self, agent: Agent, best: Solution, states: IntArray, advantages: bool) -> None:
        assert isinstance(agent, SB3Agent)
        self.policy = agent.model.policy
        weights = sum(each.numel() for each in self.policy.parameters())
        self._steps = int(min(_STEPS, _WORK / (weights * len(states))))
        self.is_fast = self._steps >= _FEWEST
        self.observations, _ = self.policy.obs_to_tensor(agent.observation.rows(states))
        q = best.q[states] - (best.v[states][:, None] if advantages else 0.0)
        q = np.where(np.isfinite(q), q, 0.0)
        scale = max(float(q.std()), 1e-12) if advantages else 1.0
        self._q = torch.tensor(q / scale, dtype=torch.float32)
        self._optimal = torch.tensor(best.optimal[states], dtype=torch.float32)

    def error(self, found: Reading, where: Any) -> Tensor:
        """How far an answer is from the exact one in some of the states."""
        if found.probabilities is not None:
            right = (found.probabilities * self._optimal)[where].sum(dim=1).clamp_min(1e-12)
            return -right.log().mean()
        assert found.q is not None
        return ((found.q - self._q)[where] ** 2).mean()

    def run(
        self, loss: Callable[[Reading], Tensor], is_done: Callable[[IntArray], bool], fresh: bool = False
    ) -> bool:
        """Descend a loss until the greedy actions (n,) will do; False: they never did."""
        threads = torch.get_num_threads()
        torch.set_num_threads(1)  # in networks as small as these threads would wait for each other
        try:
            with torch.random.fork_rng(devices=[]):
                torch.manual_seed(0)
                policy = copy.deepcopy(self.policy).requires_grad_(True)
                for module in policy.modules() if fresh else ():
                    if callable(reset := getattr(module, "reset_parameters", None)):
                        reset()
                optimizer = torch.optim.Adam(policy.parameters(), lr=_RATE)
                for step in range(self._steps + 1):
                    found = read(policy, self.observations)
                    if step % _EVERY == 0 and is_done(_greedy(found)):
                        return True
                    optimizer.zero_grad()
                    loss(found).backward()  # type: ignore[no-untyped-call]
                    optimizer.step()
            return False
        finally:
            torch.set_num_threads(threads)


def _greedy(found: Reading) -> IntArray:
    known = found.q if found.probabilities is None else found.probabilities
    assert known is not None
    return np.asarray(known.argmax(dim=1).numpy())


def _moved(found: Reading, before: Reading) -> Tensor:
    """How far an answer is from an earlier one."""
    if found.probabilities is not None and before.probabilities is not None:
        return -(before.probabilities * found.probabilities.clamp_min(1e-12).log()).sum(dim=1).mean()
    assert found.q is not None
    assert before.q is not None
    return ((found.q - before.q) ** 2).mean()
