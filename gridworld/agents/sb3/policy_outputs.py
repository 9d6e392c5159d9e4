"""Outputs of an SB3 policy for given observations, by what it has, not by its class.

An actor-critic has action probabilities and values, others have Q values or their quantiles.
"""

from __future__ import annotations

import inspect
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from stable_baselines3.common.policies import BasePolicy
from torch import Tensor, nn

from gridworld.base.errors import InputError, in_short
from gridworld.envs.observations import ObservationTable
from gridworld.world.door.attributes import random_states
from gridworld.world.mdp import BoolArray, FloatArray, IntArray, Mdp

CHUNK = 4096  # states a forward pass
_ASKED = 512  # states
_PART = 3
NO_TABLE = "so it cannot be evaluated exactly"
_LIBRARIES = ("stable_baselines3.", "sb3_contrib.", "gridworld.", "torch.")
_PREDICTS = ("predict", "_predict")  # what decides an action, of a model or a policy
_OFTEN = 100  # times, where a custom layer or `predict` decides


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


def predicts_by(model: Any, policy: BasePolicy) -> str | None:
    """The path of a class whose own `predict` decides on an action; None: the libraries' does."""
    for thing in (model, policy):
        for name in _PREDICTS:
            method = getattr(type(thing), name, None)
            if name in vars(thing) or not getattr(method, "__module__", _LIBRARIES[0]).startswith(_LIBRARIES):
                return f"{type(thing).__module__}.{type(thing).__qualname__}"
    return None


def is_of_libraries(model: Any, policy: BasePolicy) -> bool:
    """Whether no custom layer or `predict` decides on an action."""
    layers = (type(each).__module__ for each in policy.modules())
    return predicts_by(model, policy) is None and all(each.startswith(_LIBRARIES) for each in layers)


def predicted(
    model: Any, observation: ObservationTable, mdp: Mdp, masks: BoolArray | None = None, **more: Any
) -> IntArray:
    """(S,), the actions that `predict` takes in all states, asked in batches."""
    states = np.arange(observation.num_states)
    asked = (states[at : at + CHUNK] for at in range(0, len(states), CHUNK))
    return np.concatenate([_predicted(model, observation, mdp, masks, each, **more) for each in asked])


def _predicted(
    model: Any, observation: ObservationTable, mdp: Mdp, masks: Any, states: Any, **more: Any
) -> IntArray:
    """(n,), the actions in some states; `states` is one number to ask as for a single environment."""
    if masks is not None:
        more["action_masks"] = masks[states]
    try:
        found = model.predict(observation.rows(states), deterministic=True, **more)
        taken, state = np.asarray(found[0]), found[1]
    except Exception as error:  # it may be anybody's own
        raise InputError(f"the model: its predict() raised {in_short(error)}") from error
    if state is not None:
        raise InputError(f"the model: its predict() keeps a state between steps, {NO_TABLE}")
    fits = taken.shape == np.shape(states) and taken.dtype.kind in "iu"
    if not fits or not np.isin(taken, np.arange(mdp.num_actions)).all():
        raise InputError(
            f"the model: its predict() returned {str(taken)[:60]} for {np.size(states)} states; must be an "
            f"action per state, {mdp.action_choices()}"
        )
    return taken


def why_unsteady(
    model: Any, policy: BasePolicy, observation: ObservationTable, mdp: Mdp, masks: BoolArray | None = None
) -> str | None:
    """Why `predict` is not a function of what it is shown: asked alone and together, in two orders, again.

    The policy is left as it was.
    """
    was_training, before = policy.training, random_states()
    some = np.flatnonzero(mdp.acting)[:_ASKED]
    together = predicted(model, observation, mdp, masks)[some]

    def alone(states: IntArray) -> IntArray:
        return np.array([_predicted(model, observation, mdp, masks, state) for state in states])

    rounds = [alone(some), alone(some[::-1])[::-1]]
    often = 1 if is_of_libraries(model, policy) else _OFTEN
    rounds += [predicted(model, observation, mdp, masks)[some] for _ in range(often)]
    takes_starts = "episode_start" in inspect.signature(model.predict).parameters
    if takes_starts and predicts_by(model, policy) is not None and observation.num_states <= CHUNK:
        for begins in np.tile([[True], [False]], observation.num_states):
            rounds.append(predicted(model, observation, mdp, masks, episode_start=begins)[some])
    reason = why_no_table(policy, observation)
    policy.set_training_mode(was_training)
    if reason is None and random_states() != before:
        reason = f"draws random numbers for its best action, {NO_TABLE}"
    if reason is None and any((each != together).any() for each in rounds):
        reason = f"does not always take the same action in the same state, {NO_TABLE}"
    return reason
