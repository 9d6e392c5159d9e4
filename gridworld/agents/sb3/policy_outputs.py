"""Outputs of an SB3 policy for given observations: action probabilities or Q values, and values.

Asked for by what a policy can do, not by its class: an actor-critic has a distribution and values,
a value-based one has a network of Q values, or of their quantiles, whose mean they are.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from stable_baselines3.common.policies import BasePolicy
from torch import Tensor, nn

from gridworld.agents.sb3.memory_size import CHUNK
from gridworld.envs.observations import ObservationTable
from gridworld.world.exact.markov_chain import one_hot_policy
from gridworld.world.mdp import FloatArray, IntArray

_ASKED = 512  # states
_PART = 3


class Reading(NamedTuple):
    """What is known of n states."""

    values: Tensor  # (n,)
    probabilities: Tensor | None  # (n, A), of an actor-critic
    q: Tensor | None  # (n, A), of a value-based agent


def why_unreadable(policy: BasePolicy) -> str | None:
    """Why a policy's outputs cannot be read as a table over states; None: they can."""
    for module in policy.modules():
        if isinstance(module, nn.RNNBase):
            return (
                f"keeps a memory from step to step ({type(module).__name__}), so what it does is not a "
                "function of the state, and no table of it can be evaluated exactly; take one without"
            )
    if _is_actor_critic(policy) or hasattr(policy, "q_net") or hasattr(policy, "quantile_net"):
        return None
    return (
        f"has a policy ({type(policy).__name__}) that tells neither probabilities and values nor Q values "
        "of a state, so it cannot be evaluated exactly"
    )


def why_no_table(policy: BasePolicy, observation: ObservationTable) -> str | None:
    """Why a policy's outputs are no function of the state, as asking it twice, and for fewer states, shows.

    Returns:
        The reason; None: they are one, as far as it shows.
    """
    states = np.arange(min(observation.num_states, _ASKED))
    with torch.no_grad():
        once, again, part = (
            read(policy, policy.obs_to_tensor(observation.rows(some))[0])
            for some in (states, states, states[::_PART])
        )
    for one, other, fewer in zip(once, again, part, strict=True):
        if one is None or other is None or fewer is None:
            continue
        same = torch.allclose(one, other, rtol=0, atol=0, equal_nan=True)
        if not same or not torch.allclose(one[::_PART], fewer, rtol=1e-3, atol=1e-4, equal_nan=True):
            return (
                "does not always give the same answer in the same state, so no table of it can be evaluated "
                "exactly"
            )
    return None


def read(policy: BasePolicy, observations: Any, masks: Any = None) -> Reading:
    """Ask a policy about a batch of n observations, tensors of its own making; `masks`: allowed actions."""
    policy.set_training_mode(False)
    if _is_actor_critic(policy):
        asked: Any = policy
        allowed = {} if masks is None else {"action_masks": masks}
        distribution = asked.get_distribution(observations, **allowed).distribution
        return Reading(asked.predict_values(observations)[:, 0], distribution.probs, None)
    if hasattr(policy, "quantile_net"):
        return of_q(cast(nn.Module, policy.quantile_net)(observations).mean(dim=1))
    return of_q(cast(nn.Module, policy.q_net)(observations))


class Outputs(NamedTuple):
    """A `Reading` of all S states, as float64."""

    values: FloatArray  # (S,)
    probabilities: FloatArray | None  # (S, A)
    q: FloatArray | None  # (S, A)


def read_states(num_states: int, ask: Callable[[IntArray], Reading]) -> Outputs:
    """Read all states, in batches and without gradients.

    Args:
        num_states: S.
        ask: reads the states of the numbers that it is given.
    """
    states = np.arange(num_states)
    with torch.no_grad():
        parts = [ask(states[start : start + CHUNK]) for start in range(0, num_states, CHUNK)]
    values, probabilities, q = (_joined(part) for part in zip(*parts, strict=True))
    assert values is not None
    return Outputs(values, probabilities, q)


def _joined(parts: tuple[Tensor | None, ...]) -> FloatArray | None:
    tensors = [part for part in parts if part is not None]
    return torch.cat(tensors).cpu().numpy().astype(np.float64) if tensors else None


def epsilon_greedy(q: FloatArray, epsilon: float) -> FloatArray:
    """(S, A), the action probabilities of SB3's exploration with Q values (S, A)."""
    actions = q.shape[1]
    mixed: FloatArray = (1 - epsilon) * one_hot_policy(np.argmax(q, axis=1), actions) + epsilon / actions
    return mixed


def of_q(q: Tensor) -> Reading:
    """The reading of Q values (n, A)."""
    return Reading(torch.max(q, dim=1).values, None, q)


def _is_actor_critic(policy: BasePolicy) -> bool:
    return hasattr(policy, "get_distribution") and hasattr(policy, "predict_values")
