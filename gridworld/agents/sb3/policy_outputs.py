"""Outputs of an SB3 policy for given observations, by what it has, not by its class.

An actor-critic has action probabilities and values, others have Q values or their quantiles.
"""

from __future__ import annotations

from typing import Any, NamedTuple, cast

import numpy as np
import torch
from stable_baselines3.common.policies import BasePolicy
from torch import Tensor, nn

from gridworld.envs.observations import ObservationTable
from gridworld.world.mdp import BoolArray, FloatArray

CHUNK = 4096  # states a forward pass
_ASKED = 512  # states
_PART = 3
NO_TABLE = "so it cannot be evaluated exactly"


class Reading(NamedTuple):
    """What is known of n states."""

    values: Tensor  # (n,)
    probabilities: Tensor | None  # (n, A), of an actor-critic
    q: Tensor | None  # (n, A), of a value-based agent


def why_unreadable(policy: BasePolicy) -> str | None:
    """Why a policy's outputs cannot be read as a table over states; None: they can."""
    for module in policy.modules():
        if isinstance(module, nn.RNNBase):
            return f"keeps memory between steps ({type(module).__name__}), {NO_TABLE}"
    if _is_actor_critic(policy) or hasattr(policy, "q_net") or hasattr(policy, "quantile_net"):
        return None
    return f"has neither action probabilities and values nor Q values ({type(policy).__name__}), {NO_TABLE}"


def why_no_table(policy: BasePolicy, observation: ObservationTable) -> str | None:
    """Why outputs are no function of the state, as asking twice, and for fewer states, shows; or None."""
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
            return f"does not always answer the same in the same state, {NO_TABLE}"
    return None


def read(policy: BasePolicy, observations: Any, masks: BoolArray | None = None) -> Reading:
    """Ask a policy about a batch of n observations, tensors of its own making; `masks`: allowed actions."""
    policy.set_training_mode(False)
    if _is_actor_critic(policy):
        asked: Any = policy
        allowed = {} if masks is None else {"action_masks": masks}
        distribution = asked.get_distribution(observations, **allowed).distribution
        return Reading(asked.predict_values(observations)[:, 0], distribution.probs, None)
    if hasattr(policy, "quantile_net"):
        q = cast(nn.Module, policy.quantile_net)(observations).mean(dim=1)
    else:
        q = cast(nn.Module, policy.q_net)(observations)
    return Reading(torch.max(q, dim=1).values, None, q)


def read_table(
    policy: BasePolicy, observation: ObservationTable, masks: BoolArray | None = None
) -> tuple[FloatArray, FloatArray | None, FloatArray | None]:
    """A `Reading` of all states in float64, made in batches; `masks`: allowed actions (S, A)."""
    parts = []
    with torch.no_grad():
        for start in range(0, observation.num_states, CHUNK):
            states = np.arange(start, min(start + CHUNK, observation.num_states))
            rows, _ = policy.obs_to_tensor(observation.rows(states))
            parts.append(read(policy, rows, None if masks is None else masks[states]))
    values, probabilities, q = (
        None if of_all[0] is None else torch.cat(of_all).cpu().numpy().astype(np.float64)
        for of_all in zip(*parts, strict=True)
    )
    assert values is not None
    return values, probabilities, q


def explored(greedy: FloatArray, epsilon: float) -> FloatArray:
    """(S, A), the action probabilities of SB3's exploration around a greedy policy (S, A)."""
    policy: FloatArray = (1 - epsilon) * greedy + epsilon / greedy.shape[1]
    return policy


def _is_actor_critic(policy: BasePolicy) -> bool:
    return hasattr(policy, "get_distribution") and hasattr(policy, "predict_values")
