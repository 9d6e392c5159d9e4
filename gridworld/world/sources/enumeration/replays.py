"""The environment itself beside its table, step by step.

An enumeration may have missed something: randomness that no generator of the environment shows, state outside
of its attributes, a reward that is paid at one time only, a wrapper that changes what is seen. Whatever
changes the walks of an agent shows up here, if it is met.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import cached_property
from typing import Any

import gymnasium as gym
import numpy as np

from gridworld.world.mdp import IntArray, Mdp
from gridworld.world.sources.enumeration.exploring import Clocks, Graph, Subject
from gridworld.world.sources.enumeration.snapshots import Snapshots, key_of

_STEPS = 3_000  # at least
_EPISODES = 5  # at least
_AFTERWARDS = 10  # random steps at the end of a directed walk
_SEED = 20_260_101


class Replays:
    """Walks through an environment that must be those of its table.

    Args:
        subject: the environment as it was enumerated.
        mdp: its table.
        graph: its states without time.
        clocks: what is not part of these.
        state: (S,), the state without time that each of the table's is.
    """

    def __init__(self, subject: Subject, mdp: Mdp, graph: Graph, clocks: Clocks, state: IntArray) -> None:
        self._subject, self._mdp, self._graph, self._clocks = subject, mdp, graph, clocks
        self._state = state[mdp.number]
        self._random = np.random.default_rng(_SEED)

    def check(self, env: gym.Env[Any, Any]) -> None:
        """Walk at random, and straight to states drawn at random, with all of the wrappers of its id.

        Args:
            env: a new one; it is closed.

        Raises:
            InputError: it does something else than the table.
        """
        snapshots = Snapshots(env.unwrapped)
        steps = episodes = 0
        try:
            while steps < _STEPS or episodes < _EPISODES:
                steps += self._episode(env, snapshots, self._actions(episodes))
                episodes += 1
        finally:
            env.close()

    def _actions(self, episode: int) -> Iterator[int]:
        """The actions to a random state and some more, and every other time random ones all along."""
        actions = self._mdp.num_actions
        if episode % 2:
            yield from self._way_to(int(self._random.integers(self._mdp.num_states)))
            yield from self._random.integers(actions, size=_AFTERWARDS).tolist()
        else:
            yield from self._random.integers(
                actions, size=min(self._mdp.max_episode_steps or 500, 500)
            ).tolist()

    def _way_to(self, state: int) -> list[int]:
        """The actions by which a state was first found."""
        origin, action = self._origins
        way = []
        while origin[state] >= 0:
            way.append(int(action[state]))
            state = int(origin[state])
        return way[::-1]

    @cached_property
    def _origins(self) -> tuple[IntArray, IntArray]:
        """(S,), the state from which each is first reached, -1 of the start; (S,), by which action."""
        mdp = self._mdp
        origin, action = np.full((2, mdp.num_states), -1)
        reached = mdp.start > 0
        frontier: IntArray = mdp.start_states
        while frontier.size:
            states, actions = (
                np.repeat(frontier, mdp.num_actions),
                np.tile(range(mdp.num_actions), len(frontier)),
            )
            following, first = np.unique(mdp.next_state[states, actions, 0], return_index=True)
            first, following = first[~reached[following]], following[~reached[following]]
            origin[following], action[following] = states[first], actions[first]
            reached[following] = True
            frontier = following
        return origin, action

    def _episode(self, env: gym.Env[Any, Any], snapshots: Snapshots, actions: Iterable[int]) -> int:
        """Walk until the actions or the episode end.

        Returns:
            The steps.
        """
        mdp, state, steps = self._mdp, int(self._mdp.start_states[0]), 0
        observation, _ = env.reset(seed=int(self._random.integers(2**31)))
        self._compare("state", steps, self._seen(snapshots, observation), self._expected(state))
        for action in actions:
            observation, reward, *ends, _ = env.step(action)
            steps += 1
            self._compare("reward", steps, float(reward), float(mdp.reward[state, action, 0]))
            state = int(mdp.next_state[state, action, 0])
            expected = [bool(mdp.terminal[state]), steps >= (mdp.max_episode_steps or np.inf)]
            self._compare("end (terminated, truncated)", steps, list(map(bool, ends)), expected)
            self._compare("state", steps, self._seen(snapshots, observation), self._expected(state))
            if any(expected):
                break
        return steps

    def _seen(self, snapshots: Snapshots, observation: Any) -> tuple[bytes, bytes]:
        return snapshots.key(self._clocks), key_of(observation)

    def _expected(self, state: int) -> tuple[bytes, bytes]:
        place = self._state[state]
        return self._graph.keys[place], self._graph.seen[place]

    def _compare(self, what: str, steps: int, found: Any, expected: Any) -> None:
        if found != expected:
            shown = f" ({found}, enumerated as {expected})" if what != "state" else ""
            raise self._subject.refusal(
                f"after {steps} steps of an episode its {what} is not the enumerated one{shown}, so it is "
                "random, has state outside of its attributes, or a wrapper that changes it"
            )
