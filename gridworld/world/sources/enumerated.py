"""Worlds from deterministic Gymnasium environments, enumerated: every action in a copy of every state.

    explore   the states and what each action does there; everything that changes is state, the time included
    replay    the environment itself beside the table, thousands of steps: any difference is refused

An enumeration may have missed something: randomness that no generator of the environment shows, state outside
of its attributes or in those that it was told to leave out, a wrapper that changes what is seen. Whatever
changes the walks of an agent shows up in the replay, if it is met.

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
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order

from gridworld.process.console.progress import telling_if_slow
from gridworld.process.memory_budget import check_memory
from gridworld.world.mdp import Mdp
from gridworld.world.outcomes import MOST_STATES, Outcomes, mdp_from_outcomes
from gridworld.world.sources.exploring import Graph, Subject, explore
from gridworld.world.sources.making import make_env
from gridworld.world.sources.snapshots import Snapshots, key_of
from gridworld.world.sources.wrappers import refuse_transformed

_STEPS = 3_000  # at least
_EPISODES = 5  # at least
_LONGEST = 10_000  # steps of the first episode where the time may be left out; who cuts later has no limit
_LONG = 500  # of the others
_AT_RANDOM = 10  # steps between two directed walks
_SEED = 20_260_101


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
    """
    with telling_if_slow(f"enumerating {env_id}"):
        env = make_env(env_id, kwargs)
        try:
            subject = Subject(env_id, env, ignore)
            limit = None if env.spec is None else env.spec.max_episode_steps
            limit = limit if limit is not None and limit > 0 else None  # -1 is "none" to `gymnasium.make`
            graph = explore(subject, most_states, limit)
            limits = [each for each in (_own_limit(subject, graph), limit) if each is not None]
            mdp = _compile(env_id, subject, graph, min(limits, default=None))
            replays = _Replays(subject, mdp, graph)
            replays.check(make_env(env_id, kwargs))
            refuse_transformed(f"env.id={env_id}", env)
        finally:
            env.close()
    return replace(mdp, max_episode_steps=replays.limit)


def _own_limit(subject: Subject, graph: Graph) -> int | None:
    """The time at which it truncates all episodes, if any."""
    times = np.broadcast_to(np.array(graph.depth)[:, None] + 1, graph.truncated.shape)
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


class _Replays:
    """Walks through an environment that must be those of its table.

    Attributes:
        limit: the steps after which it truncates: the table's, or what the walks found.
    """

    def __init__(self, subject: Subject, mdp: Mdp, graph: Graph) -> None:
        self._subject, self._mdp, self._graph = subject, mdp, graph
        self._random = np.random.default_rng(_SEED)
        self.limit = mdp.max_episode_steps
        origins = np.repeat(np.arange(mdp.num_states), mdp.num_actions)
        leads = np.ones(len(origins)), (origins, mdp.next_state.ravel())
        self._moves = csr_array(leads, shape=(mdp.num_states, mdp.num_states))

    def check(self, env: gym.Env[Any, Any]) -> None:
        """Walk a new environment, with the wrappers of its id, to states drawn at random; it is closed."""
        snapshots = Snapshots(env.unwrapped)
        steps = episodes = 0
        try:
            while steps < _STEPS or episodes < _EPISODES:
                most = _LONGEST if self._subject.ignore and not episodes else _LONG
                steps += self._episode(env, snapshots, most, episodes % 3 * _AT_RANDOM)
                episodes += 1
        finally:
            env.close()

    def _episode(self, env: gym.Env[Any, Any], snapshots: Snapshots, most: int, at_random: int) -> int:
        """Walk to one state after the other, with random steps between, until it ends; the steps."""
        mdp, state, steps = self._mdp, int(self._mdp.start_states[0]), 0
        observation, _ = env.reset(seed=int(self._random.integers(2**31)))
        self._compare("state", steps, self._seen(snapshots, observation), self._expected(state))
        actions: list[int] = []
        while steps < most and not mdp.terminal[state]:
            if not actions:
                actions = (
                    self._way_from(state) + self._random.integers(mdp.num_actions, size=at_random).tolist()
                )
            action = actions.pop(0)
            observation, reward, terminated, truncated, _ = env.step(action)
            steps += 1
            self._compare("reward", steps, float(reward), float(mdp.reward[state, action, 0]))
            state = int(mdp.next_state[state, action, 0])
            cut = bool(truncated and not terminated)
            if cut and self.limit is None and self._subject.ignore:
                self.limit = steps
            over = bool(mdp.terminal[state])
            expected = [over, steps >= (self.limit or np.inf) and not over]
            self._compare("end (terminated, truncated)", steps, [bool(terminated), cut], expected)
            self._compare("state", steps, self._seen(snapshots, observation), self._expected(state))
            if cut:
                break
        return steps

    def _way_from(self, state: int) -> list[int]:
        """The actions by which to come to a state drawn at random, first to one where it goes on."""
        mdp = self._mdp
        reached, before = breadth_first_order(self._moves, state)
        going_on = reached[~mdp.absorbing[reached]]
        target = int(self._random.choice(going_on if going_on.size > 1 else reached))
        way: list[int] = []
        while target != state:
            origin = int(before[target])
            way.append(int(np.argmax(mdp.next_state[origin, :, 0] == target)))
            target = origin
        return way[::-1] or [int(self._random.integers(mdp.num_actions))]

    def _seen(self, snapshots: Snapshots, observation: Any) -> tuple[bytes, bytes]:
        return snapshots.key(self._subject.ignore), key_of(observation)

    def _expected(self, state: int) -> tuple[bytes, bytes]:
        place = self._mdp.number[state]
        return self._graph.keys[place], self._graph.seen[place]

    def _compare(self, what: str, steps: int, found: Any, expected: Any) -> None:
        if found != expected:
            shown = f" ({found}, enumerated as {expected})" if what != "state" else ""
            left_out = self._subject.ignore
            depends = f"depends on {', '.join(left_out)}, which env.ignore leaves out, " if left_out else ""
            raise self._subject.refusal(
                f"after {steps} steps of an episode its {what} is not the enumerated one{shown}, so it "
                f"{depends}is random, has state outside of its attributes, or a wrapper that changes it"
            )
