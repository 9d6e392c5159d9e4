"""Worlds from deterministic Gymnasium environments, enumerated: every action in a copy of every state.

    explore       the states without their time, and what each action does there
    elapsed_time  what the time changes; where rewards depend on it, it is made part of the state
    replays       the environment itself beside the table, thousands of steps: any difference is refused

The world has the environment's own step limit, that of its id or the one at which it truncates by itself.

Its own observation is a table where the observation space is a Box or Discrete, or a Dict with a Box
`image`, of which this entry is taken, as minigrid's `ImgObsWrapper` does. Elsewhere there is none.

An end is a success as in `outcomes`; where the reward depends on the time, if it pays more than 0.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import EnumType
from typing import Any

import gymnasium as gym
import numpy as np

from gridworld.errors import InputError
from gridworld.process.console.progress import telling_if_slow
from gridworld.process.memory_budget import check_memory
from gridworld.world.mdp import IntArray, Mdp
from gridworld.world.outcomes import MOST_STATES, Outcomes, mdp_from_outcomes
from gridworld.world.sources.enumeration.elapsed_time import (
    Trials,
    find_clocks,
    outcomes_of,
    own_limit,
    with_time,
)
from gridworld.world.sources.enumeration.exploring import Clocks, Graph, Subject, TimeMattersError, explore
from gridworld.world.sources.enumeration.replays import Replays
from gridworld.world.sources.making import make_env
from gridworld.world.sources.wrappers import refuse_transformed

_BEYOND = 5_000  # states more than a step limit away; `env.max_episode_steps` may be larger than the id's


def enumerate_env(
    env_id: str, kwargs: Mapping[str, Any] | None = None, *, most_states: int = MOST_STATES
) -> Mdp:
    """Compile a deterministic environment by trying every action in a copy of every state.

    Args:
        env_id: its registered id.
        kwargs: the arguments of `gymnasium.make`.
        most_states: more are refused as soon as they are found.

    Returns:
        The world; its `truth` is "enumerated, N states".

    Raises:
        InputError: it cannot be made; it has other than discrete actions, layouts that are drawn anew, random
            steps, states that cannot be copied, or too many; or it does something else than its table.
    """
    with telling_if_slow(f"enumerating {env_id}"):
        env = make_env(env_id, kwargs)
        try:
            subject = Subject(env_id, env)
            table = _tabulate(subject, _limit_of_id(env), most_states)
            mdp = _compile(env_id, table, subject)
            Replays(subject, mdp, table.graph, table.clocks, table.state).check(make_env(env_id, kwargs))
            refuse_transformed(f"env.id={env_id}", env)
        finally:
            env.close()
    return mdp


@dataclass(frozen=True, eq=False)
class _Table:
    """Attributes: the states of the graph that the n states of the world are, (n,), and their outcomes."""

    graph: Graph
    clocks: Clocks
    outcomes: Outcomes
    state: IntArray
    max_episode_steps: int | None


def _limit_of_id(env: gym.Env[Any, Any]) -> int | None:
    limit = None if env.spec is None else env.spec.max_episode_steps
    return limit if limit is not None and limit > 0 else None  # -1 is "none" to `gymnasium.make`


def _tabulate(subject: Subject, limit_of_id: int | None, most_states: int) -> _Table:
    clocks = find_clocks(subject, limit_of_id)
    if clocks:
        try:
            return _without_time(subject, clocks, limit_of_id, most_states)
        except TimeMattersError:
            pass
    graph = explore(subject, {}, most_states, limit_of_id, 0 if clocks else _BEYOND)
    limit = _least(_common_limit(subject, graph), limit_of_id)
    return _Table(graph, {}, _plain(graph), np.arange(len(graph.keys)), limit)


def _without_time(subject: Subject, clocks: Clocks, limit_of_id: int | None, most_states: int) -> _Table:
    graph = explore(subject, clocks, most_states, limit_of_id, _BEYOND)
    if len(np.unique(graph.truncated[graph.tried])) > 1:
        raise _no_common_limit(subject)
    own = own_limit(subject, graph, clocks, limit_of_id)
    limit = _least(own, limit_of_id)
    rewards = Trials(subject, graph, clocks, own).rewards_by_time(limit, most_states)
    if not rewards or limit is None:  # without a limit no reward varies
        return _Table(graph, clocks, _plain(graph), np.arange(len(graph.keys)), limit)
    timed = with_time(graph, rewards, limit)
    return _Table(graph, clocks, timed.outcomes, timed.state, limit)


def _plain(graph: Graph) -> Outcomes:
    return outcomes_of(graph.next_state, graph.reward, graph.terminated, None)


def _least(*limits: int | None) -> int | None:
    return min((limit for limit in limits if limit is not None), default=None)


def _common_limit(subject: Subject, graph: Graph) -> int | None:
    """The time at which it truncates where its time is part of its state, or hidden from the attributes."""
    times = np.unique(np.broadcast_to(graph.depth[:, None] + 1, graph.truncated.shape)[graph.truncated])
    if not times.size:
        return None
    at_the_end = graph.tried & (graph.depth == times[0] - 1)
    if (
        times.size > 1
        or not graph.truncated[at_the_end].all()
        or (graph.depth[graph.tried] >= times[0]).any()
    ):
        raise _no_common_limit(subject)
    return int(times[0])


def _no_common_limit(subject: Subject) -> InputError:
    return subject.refusal(
        "it truncates some episodes earlier than others, which no step limit of the world says"
    )


def _compile(name: str, table: _Table, subject: Subject) -> Mdp:
    observations = None
    if table.graph.observations:
        rows = table.graph.observations
        check_memory(f"env.id={name}: its own observations", len(table.state) * rows[0].nbytes)
        observations = np.stack(rows)[table.state]
    mdp = mdp_from_outcomes(
        name,
        table.outcomes,
        action_names=_action_names(subject),
        max_episode_steps=table.max_episode_steps,
        own_observation=observations,
    )
    return replace(mdp, truth=f"enumerated, {mdp.num_states:,} states")


def _action_names(subject: Subject) -> list[str] | None:
    """The names in an enumeration `actions`, if the environment has one that fits."""
    actions = getattr(subject.env, "actions", None)
    if not isinstance(actions, EnumType):
        return None
    names = {member.value: member.name for member in actions}  # type: ignore[var-annotated]
    numbers = range(subject.num_actions)
    return [names[number] for number in numbers] if names.keys() >= set(numbers) else None
