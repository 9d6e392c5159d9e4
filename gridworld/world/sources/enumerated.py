"""Worlds from deterministic Gymnasium environments, enumerated: every action in a copy of every state.

    explore   the states and what each action does there; everything that changes is state, the time included
    replays   the environment itself beside the table, thousands of steps: any difference is refused

A user may name attributes that are no part of a state, such as a step count on which nothing depends. The
claim then rests on that, and `truth` says so.

The world has the environment's own step limit, that of its id or the one at which it truncates by itself. A
state at the limit is not terminal, since the environment does not say so, but nothing follows: every action
stays there and pays nothing.

Its own observation is a table where the observation space is a Box or Discrete, or a Dict with a Box
`image`, of which this entry is taken, as minigrid's `ImgObsWrapper` does. Elsewhere there is none.

An end is a success if it pays more than 0, and if none does, if it pays best.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from enum import EnumType
from typing import Any

import gymnasium as gym
import numpy as np

from gridworld.process.console.progress import telling_if_slow
from gridworld.process.memory_budget import check_memory
from gridworld.world.mdp import Mdp
from gridworld.world.outcomes import MOST_STATES, Outcomes, mdp_from_outcomes
from gridworld.world.sources.enumeration.exploring import Graph, Subject, explore
from gridworld.world.sources.enumeration.replays import Replays
from gridworld.world.sources.making import make_env
from gridworld.world.sources.wrappers import refuse_transformed


def enumerate_env(
    env_id: str,
    kwargs: Mapping[str, Any] | None = None,
    *,
    ignore: Sequence[str] = (),
    most_states: int = MOST_STATES,
) -> Mdp:
    """Compile a deterministic environment by trying every action in a copy of every state.

    Args:
        env_id: its registered id.
        kwargs: the arguments of `gymnasium.make`.
        ignore: attributes of the environment that are no part of its state.
        most_states: more are refused as soon as they are found.

    Returns:
        The world; its `truth` is "enumerated, N states", and without which attributes.

    Raises:
        InputError: it cannot be made; it has other than discrete actions, layouts that are drawn anew, random
            steps, states that cannot be copied, or too many; or it does something else than its table.
    """
    with telling_if_slow(f"enumerating {env_id}"):
        env = make_env(env_id, kwargs)
        try:
            subject = Subject(env_id, env, ignore)
            limit = _limit_of_id(env)
            graph = explore(subject, most_states, limit)
            mdp = _compile(env_id, subject, graph, _least(_own_limit(subject, graph), limit))
            replays = Replays(subject, mdp, graph)
            replays.check(make_env(env_id, kwargs))
            refuse_transformed(f"env.id={env_id}", env)
        finally:
            env.close()
    return replace(mdp, max_episode_steps=replays.limit)


def _limit_of_id(env: gym.Env[Any, Any]) -> int | None:
    limit = None if env.spec is None else env.spec.max_episode_steps
    return limit if limit is not None and limit > 0 else None  # -1 is "none" to `gymnasium.make`


def _least(*limits: int | None) -> int | None:
    return min((limit for limit in limits if limit is not None), default=None)


def _own_limit(subject: Subject, graph: Graph) -> int | None:
    """The time at which it truncates all episodes, if any."""
    times = np.broadcast_to(graph.depth[:, None] + 1, graph.truncated.shape)
    truncating = graph.truncated & ~graph.terminated
    if not truncating.any():
        return None
    limit = int(times[truncating].min())
    if (graph.truncated != (times >= limit))[graph.tried[:, None] & ~graph.terminated].any():
        raise subject.refusal(
            "it truncates some episodes earlier than others, which no step limit of the world says"
        )
    return limit


def _compile(name: str, subject: Subject, graph: Graph, limit: int | None) -> Mdp:
    observations = None
    if graph.observations:
        check_memory(f"env.id={name}: its own observations", len(graph.keys) * graph.observations[0].nbytes)
        observations = np.stack(graph.observations)
    paid = graph.terminated & (graph.reward > 0)
    mdp = mdp_from_outcomes(
        name,
        Outcomes(
            next_state=graph.next_state[:, :, None],
            probability=np.ones((*graph.next_state.shape, 1)),
            reward=graph.reward[:, :, None],
            terminated=graph.terminated[:, :, None],
            start=np.eye(1, len(graph.next_state))[0],
            success=paid[:, :, None] if paid.any() else None,
        ),
        action_names=_action_names(subject),
        max_episode_steps=limit,
        own_observation=observations,
    )
    if graph.names[0]:
        mdp = replace(mdp, state_names=tuple(graph.names))
    told = f" without {', '.join(subject.ignore)} as told" if subject.ignore else ""
    return replace(mdp, truth=f"enumerated, {mdp.num_states:,} states{told}")


def _action_names(subject: Subject) -> list[str] | None:
    """The names in an enumeration `actions`, if the environment has one that fits."""
    actions = getattr(subject.env, "actions", None)
    if not isinstance(actions, EnumType):
        return None
    names = {member.value: member.name for member in actions}  # type: ignore[var-annotated]
    numbers = range(subject.num_actions)
    return [names[number] for number in numbers] if names.keys() >= set(numbers) else None
