"""An enumerated environment beside its world, with its own random generator: any difference is refused."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import seeding
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order

from gridworld.world.enumeration.beliefs import Step
from gridworld.world.enumeration.snapshots import Snapshots, random_states
from gridworld.world.reading import digest, generator_state
from gridworld.world.sources.table_walk import FALSE_ALARM, evidence

if TYPE_CHECKING:
    from gridworld.world.sources.enumerated import Enumerated

_RESETS, _STEPS, _EPISODES = 8, 3_000, 5  # of the replay, at least; each of these resets is a new instance's
_IF_DRAWN = 64  # instead, if making an instance draws random numbers
_LONGEST = 10_000  # steps of its first episode where the time may be left out; who cuts later has no limit
_LONG = 500  # of the others
_COMPARED = 500  # states, where there is chance; observations and rewards all the way
_AT_RANDOM = 10  # steps between two directed walks
_SEED = 20_260_101


class Replay:
    """Walks through an environment, whose steps must be those of its beliefs."""

    def __init__(self, found: Enumerated, make: Callable[[], gym.Env[Any, Any]]) -> None:
        self._found, self._search = found, found.search
        self._mdp, self._limit = found.mdp, found.mdp.max_episode_steps
        self._nodes = found.beliefs.nodes
        self._random = np.random.default_rng(_SEED)
        self._make = make
        self._is_drawn = self._made()
        self._steps = 0  # of this episode
        self._num_compared = 0
        self._keys: dict[bytes, bytes] = {}  # of states, by digests of their copies
        self._started = np.zeros(len(found.beliefs.starts))
        self._counts: dict[tuple[Any, ...], dict[int, int]] = {}  # of outcomes, by rows and what was before
        self._last: tuple[int, int, int] | None = None  # node, action and outcome of the last step
        rows = [
            (number, each.following)
            for number, node in enumerate(self._nodes)
            for row in node.rows
            for each in row
        ]
        origins, following = np.array(rows, dtype=np.int64).reshape(-1, 2).T
        size = len(self._nodes)
        self._moves = csr_array((np.ones(len(rows)), (origins, following)), shape=(size, size))

    def _made(self) -> bool:
        """Make a new environment, with the wrappers of its id; whether that draws random numbers."""
        before = random_states()
        self._env = self._make()
        own = self._env.unwrapped
        self._snapshots = Snapshots(own)
        if (generator := vars(own).get("_np_random")) is None:
            return random_states() != before
        fresh, _ = seeding.np_random(own._np_random_seed)
        return random_states() != before or generator_state(fresh) != generator_state(generator)

    def check(self) -> int | None:
        """Walk new environments to states drawn at random, and close them.

        Returns the step limit: the table's, or what the walks found.
        """
        steps = episodes = 0
        try:
            for _ in range(_IF_DRAWN if self._is_drawn else _RESETS):
                self._start()
                self._env.close()
                self._is_drawn |= self._made()
            while steps < _STEPS or episodes < _EPISODES:
                most = _LONGEST if self._search.ignore and not episodes else _LONG
                self._walk(most, episodes % 3 * _AT_RANDOM)
                steps, episodes = steps + max(self._steps, 1), episodes + 1
        finally:
            self._env.close()
        self._check_frequencies()
        return self._limit

    def _walk(self, most: int, at_random: int) -> None:
        """Walk to one node after the other, with random steps between, until the episode ends."""
        mdp, way = self._mdp, list[tuple[int, int]]()  # actions, and the nodes to which they may lead
        node, over, truncated = self._start(), False, False
        while self._steps < most and self._nodes[node].rows and not (over or truncated):
            if not way:
                way = self._way_from(node)
                way += [(int(each), -1) for each in self._random.integers(mdp.num_actions, size=at_random)]
            action, planned = way.pop(0)
            observation, reward, terminated, truncated, _ = self._env.step(action)
            self._steps += 1
            over, seen = bool(terminated), digest(observation)
            truncated = bool(truncated and not over)
            found = self._outcome(node, action, (seen, float(reward), over))
            if truncated and self._limit is None and self._search.ignore:
                self._limit = self._steps
            is_cut = not found.terminated and self._limit is not None and self._steps >= self._limit
            self._compare("end (terminated, truncated)", [over, truncated], [found.terminated, is_cut])
            node = found.following
            self._compare_state(node, seen)
            way = way if planned in (-1, node) else []

    def _start(self) -> int:
        """The node after a reset."""
        observation, _ = self._env.reset(seed=int(self._random.integers(2**31)))
        self._steps, self._last, seen = 0, None, digest(observation)
        shown = [self._nodes[each].seen for _, each in self._found.beliefs.starts]
        place = shown.index(seen) if seen in shown else 0
        node = self._found.beliefs.starts[place][1]
        self._compare_state(node, seen)
        self._started[place] += 1
        return node

    def _outcome(self, node: int, action: int, shown: tuple[bytes, float, bool]) -> Step:
        """The outcome of a row that shows this; if there is just one, what differs is named."""
        row = self._nodes[node].rows[action]
        same = [
            number for number, each in enumerate(row) if (each.seen, each.reward, each.terminated) == shown
        ]
        if not same:
            if len(row) > 1:
                self._compare("outcome", (*shown[1:], "and its observation"), "none such")
            self._compare("reward", shown[1], row[0].reward)
            return row[0]
        for key in ((node, action), (node, action, self._last)):
            counts = self._counts.setdefault(key, {})
            counts[same[0]] = counts.get(same[0], 0) + 1
        self._last = node, action, same[0]
        return row[same[0]]

    def _check_frequencies(self) -> None:
        """Refuse counts that cannot come from the probabilities, by Bayes factors as in `table_walk`."""
        starts = [[float(probability) for probability, _ in self._found.beliefs.starts]]
        rows = [(each, self._nodes[each[0]].rows[each[1]]) for each in self._counts]
        width = max((len(row) for _, row in rows), default=1)
        counts, chance = np.zeros((2, len(rows), width))
        for place, (pair, row) in enumerate(rows):
            chance[place, : len(row)] = [float(each.probability) for each in row]
            for column, count in self._counts[pair].items():
                counts[place, column] = count
        found = [*evidence(counts, chance), *evidence(self._started[None], np.array(starts))]
        if max(found) > np.log(len(found) / FALSE_ALARM):
            raise self._search.refusal(
                "its random outcomes are not as frequent as was enumerated, so it draws them in another way "
                "than by the methods of np_random, or remembers more than its state"
            )

    def _way_from(self, node: int) -> list[tuple[int, int]]:
        """Actions that may lead to a node drawn at random, first to one where it goes on."""
        reached, before = breadth_first_order(self._moves, node)
        going_on = [each for each in reached.tolist() if self._nodes[each].rows]
        target = int(self._random.choice(going_on if len(going_on) > 1 else reached))
        way: list[tuple[int, int]] = []
        while target != node:
            origin = int(before[target])
            rows = self._nodes[origin].rows
            leading = [
                number for number, row in enumerate(rows) if target in {each.following for each in row}
            ]
            way.append((int(self._random.choice(leading)), target))
            target = origin
        return way[::-1] or [(int(self._random.integers(self._mdp.num_actions)), -1)]

    def _compare_state(self, node: int, seen: bytes) -> None:
        possible = self._found.possible(self._nodes[node])
        is_enough = self._search.is_random and self._num_compared >= _COMPARED
        found = not possible or is_enough or self._key() in {each.key for each in possible}
        self._compare("state", (found, seen), (True, self._nodes[node].seen))

    def _key(self) -> bytes:
        """The environment's state; equal copies are of equal states."""
        self._num_compared += 1
        copy = digest(self._snapshots.take())
        if copy not in self._keys:
            self._keys[copy] = self._snapshots.key(self._search.ignore, kinds=True)
        return self._keys[copy]

    def _compare(self, what: str, found: Any, expected: Any) -> None:
        if found != expected:
            shown = f" ({found}, enumerated as {expected})" if what != "state" else ""
            left_out = ", ".join(self._search.ignore)
            depends = f"depends on {left_out}, which env.ignore leaves out, " if left_out else ""
            raise self._search.refusal(
                f"after {self._steps} steps of an episode its {what} is not the enumerated one{shown}, so "
                f"it {depends}is random, has state outside its attributes, or has a wrapper that changes it"
            )
