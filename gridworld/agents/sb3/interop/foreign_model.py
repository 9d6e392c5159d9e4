"""Reading any model of SB3 as a policy over the states of a world, whoever trained it.

The model may have seen states through wrappers of Gymnasium and of SB3. What it saw of each state is made
again through the same wrappers, once a state, and its policy is asked about all of them in batches.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    VecCheckNan,
    VecEnv,
    VecEnvWrapper,
    VecMonitor,
    VecNormalize,
    VecTransposeImage,
)

from gridworld.agents.sb3.policy_outputs import (
    epsilon_greedy,
    read,
    read_states,
    why_no_table,
    why_unreadable,
)
from gridworld.agents.sb3.vec_env import GridWorldVecEnv
from gridworld.envs.inspection import is_discrete, observation_like, observation_of, tabulated
from gridworld.envs.observations import ObservationTable
from gridworld.errors import InputError
from gridworld.world.exact.markov_chain import one_hot_policy
from gridworld.world.mdp import FloatArray, Mdp


class Tables(NamedTuple):
    """A model's policies, and what they are of; (S, A), float64, each."""

    greedy: FloatArray  # action probabilities
    sampled: FloatArray  # the same
    outputs: FloatArray  # action probabilities of an actor-critic, Q values of others


def tables_of(model: Any, mdp: Mdp, env: Any = None) -> Tables:
    """Read a model's policies.

    Args:
        model: an SB3 model, or its policy.
        mdp: the world.
        env: the environment that it was trained on, in which it sees states; None, or one that it does not
            fit: the world's own observation with the model's space.

    Raises:
        InputError: it has no table: it keeps a memory, sees or does something else, or is no SB3 model.
    """
    policy = _policy_of(model)
    observation = seen_by(policy, mdp, env)
    _check_is_a_table(policy, observation)
    return read_tables(policy, observation, _epsilon(model))


def seen_by(policy: BasePolicy, mdp: Mdp, env: Any = None) -> ObservationTable:
    """What a policy sees of each state; the arguments are those of `tables_of`.

    Raises:
        InputError: it sees or does something else.
    """
    if not is_discrete(policy.action_space, mdp.num_actions):
        raise InputError(
            f"the model acts in {policy.action_space}; {mdp.name} has Discrete({mdp.num_actions})"
        )
    observation = _observation(env, mdp)
    if observation is not None and observation.space == policy.observation_space:
        return observation
    return observation_like(mdp, policy.observation_space)


def read_tables(policy: BasePolicy, observation: ObservationTable, epsilon: float = 0.0) -> Tables:
    """Ask a policy about every state; it is left as it was.

    Args:
        policy: of SB3.
        observation: what it sees of each.
        epsilon: the exploration rate, of a policy with Q values.

    Raises:
        InputError: its outputs are no finite numbers.
    """
    was_training = policy.training
    _, probabilities, q = read_states(
        observation.num_states,
        lambda states: read(policy, policy.obs_to_tensor(observation.rows(states))[0]),
    )
    policy.set_training_mode(was_training)
    table = q if probabilities is None else probabilities
    assert table is not None
    if not np.isfinite(table).all():
        raise InputError("the model's outputs are no finite numbers; its training has diverged")
    sampled = table if q is None else epsilon_greedy(q, epsilon)
    return Tables(one_hot_policy(table.argmax(axis=1), table.shape[1]), sampled, table)


def _policy_of(model: Any) -> BasePolicy:
    policy = model if isinstance(model, BasePolicy) else getattr(model, "policy", None)
    if not isinstance(policy, BasePolicy):
        raise InputError(f"{type(model).__name__}: is neither a model of Stable-Baselines3 nor a table")
    return policy


def _epsilon(model: Any) -> float:
    return float(getattr(model, "exploration_rate", 0.0))


def _check_is_a_table(policy: BasePolicy, observation: ObservationTable) -> None:
    reason = why_unreadable(policy)
    if reason is None:
        was_training = policy.training
        reason = why_no_table(policy, observation)
        policy.set_training_mode(was_training)
    if reason is not None:
        raise InputError(f"the model {reason}")


def _observation(env: Any, mdp: Mdp) -> ObservationTable | None:
    """What an environment shows of each state; None where that cannot be seen from here."""
    if isinstance(env, VecEnvWrapper):
        return _through(env, _observation(env.venv, mdp))
    if isinstance(env, GridWorldVecEnv):
        return env.observation
    if isinstance(env, DummyVecEnv):
        return observation_of(env.envs[0], mdp)
    if isinstance(env, VecEnv) or env is None:
        return None  # in other processes, say
    table = getattr(env, "table", None)  # of a batch's wrapper
    if isinstance(table, ObservationTable):
        return table
    is_single = hasattr(env, "get_wrapper_attr") and not hasattr(env, "num_envs")
    return observation_of(env, mdp) if is_single else None


def _through(wrapper: VecEnvWrapper, observation: ObservationTable | None) -> ObservationTable | None:
    """The observations as a wrapper of SB3 hands them on."""
    if isinstance(wrapper, VecMonitor | VecCheckNan) or observation is None:
        return observation
    if isinstance(wrapper, VecTransposeImage):
        rows = np.stack([wrapper.transpose_image(row) for row in observation.table()])
        return tabulated(wrapper.observation_space, rows)
    if isinstance(wrapper, VecNormalize):
        rows = np.asarray(wrapper.normalize_obs(observation.table()))
        return tabulated(wrapper.observation_space, rows)
    if wrapper.observation_space == wrapper.venv.observation_space:
        return observation
    raise InputError(
        f"env: {type(wrapper).__name__} makes observations of more than the state, so no table of the policy "
        "can be evaluated exactly; leave it out"
    )
