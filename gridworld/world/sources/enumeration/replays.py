"""The environment itself beside its table, step by step.

An enumeration may have missed something: randomness that no generator of the environment shows, state outside
of its attributes or in those that it was told to leave out, a wrapper that changes what is seen. Whatever
changes the walks of an agent shows up here, if it is met.
"""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np

from gridworld.world.mdp import IntArray, Mdp
from gridworld.world.sources.enumeration.exploring import Graph, Subject
from gridworld.world.sources.enumeration.snapshots import Snapshots, key_of

_STEPS = 3_000  # at least
_EPISODES = 5  # at least
_LONGEST = 10_000  # steps of the first episode where the time may be left out; who cuts later has no limit
_LONG = 500  # of the others
_AT_RANDOM = 10  # steps between two directed walks
_SEED = 20_260_101


class Replays:
    """Walks through an environment that must be those of its table.

    Attributes:
        limit: the steps after which it truncates: the table's, or what the walks found.
    """

    def __init__(self, subject: Subject, mdp: Mdp, graph: Graph) -> None:
        self._subject, self._mdp, self._graph = subject, mdp, graph
        self._random = np.random.default_rng(_SEED)
        self.limit = mdp.max_episode_steps

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
        origin, by = np.full((2, mdp.num_states), -1)
        frontier: IntArray = np.array([state])
        found = [frontier]
        while frontier.size:
            origins = np.repeat(frontier, mdp.num_actions)
            actions = np.tile(range(mdp.num_actions), len(frontier))
            following, first = np.unique(mdp.next_state[origins, actions, 0], return_index=True)
            new = (origin[following] < 0) & (following != state)
            frontier, first = following[new], first[new]
            origin[frontier], by[frontier] = origins[first], actions[first]
            found.append(frontier)
        reached = np.concatenate(found)
        going_on = reached[~mdp.absorbing[reached]]
        target = int(self._random.choice(going_on if going_on.size > 1 else reached))
        way = []
        while target != state:
            way.append(int(by[target]))
            target = int(origin[target])
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
