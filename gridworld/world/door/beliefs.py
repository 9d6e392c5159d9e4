"""What can be known of a hidden state: the world whose states are exact distributions over it.

A hidden state is all that an environment holds; what an agent gets is an observation, a reward and whether
the episode is over. A state of the world is what these leave open after everything so far: a distribution
over hidden states, the belief, and the last observation. Where the history determines the hidden state, as in
a deterministic environment, a belief is one hidden state. No agent, whatever it remembers, does better than
the optimum of this world, and one that remembers enough reaches it.

Reference: K. J. Åström, Optimal control of Markov processes with incomplete state information, 1965.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any, NamedTuple, TypeVar

import numpy as np

from gridworld.base.errors import InputError
from gridworld.world.mdp import IntArray
from gridworld.world.outcomes import Outcomes, check_size

Number = TypeVar("Number", float, Fraction)
Belief = tuple[tuple[int, Fraction], ...]  # hidden states, ascending, with their probabilities
_MOST_NODES = 200_000
_MOST_PARTS = 2_000_000  # hidden states of all beliefs together
_MOST_BITS = 4_096  # bits of a probability, which a history without end makes longer and longer


def summed(parts: Iterable[tuple[Any, Number]]) -> dict[Any, Number]:
    """The sum of what belongs to each key."""
    sums: dict[Any, Number] = {}
    for key, part in parts:
        sums[key] = sums[key] + part if key in sums else part
    return sums


class Step(NamedTuple):
    """One outcome of an action in a hidden state, or in a belief."""

    probability: Fraction
    following: int  # the number of a hidden state, or of a node
    seen: bytes  # a digest of the observation
    reward: float
    terminated: bool
    truncated: bool


@dataclass
class State:
    """A state of the environment itself, which an agent may not see."""

    number: int
    depth: int  # steps from the start
    copy: bytes  # b"" where it is no longer needed
    core: bytes  # a digest of its attributes without clocks
    name: str
    place: tuple[str, int, int] | None  # which way the agent faces, row and column
    is_open: bool = False  # an episode goes on in it
    steps: Sequence[Sequence[Step]] = ()  # the outcomes of each action; empty where none was tried
    mask: tuple[bool, ...] | None = None  # which actions `action_masks()` allows


def lumped(steps: Sequence[Sequence[Sequence[Step]]], apart: Sequence[Any]) -> list[int]:
    """The number of each hidden state's class: states of one class look and pay alike, whatever is done.

    They differ in what nothing depends on, such as the colour of a picture; `steps` as in `Beliefs`, where a
    negative number is an end; states whose `apart` differs are not of one class.

    A class is split where what follows in its states differs, and then only states that lead to those which
    left it are looked at again; the largest part stays, so that a state is looked at O(log S) times.

    References: K. G. Larsen and A. Skou, Bisimulation through probabilistic testing, 1991; A. Valmari and
    G. Franceschinis, Simple O(m log n) time Markov chain lumping, 2010.
    """
    first = dict[Any, int]()
    classes = [
        first.setdefault((bool(rows), each), len(first)) for rows, each in zip(steps, apart, strict=True)
    ]
    members: list[set[int]] = [set() for _ in first]
    leading: list[list[int]] = [[] for _ in steps]  # the states before each
    for state, rows in enumerate(steps):
        members[classes[state]].add(state)
        for step in itertools.chain.from_iterable(rows):
            if step.following >= 0:
                leading[step.following].append(state)
    changed = set(range(len(steps)))
    while changed:
        split: dict[int, dict[Any, list[int]]] = {}  # the changed states of a class by what follows
        for state in changed:
            parts = split.setdefault(classes[state], {})
            parts.setdefault(_following(steps[state], classes), []).append(state)
        others = {}  # of a class the number of states that have not changed, in all of which the same follows
        for number, parts in split.items():
            if count := len(members[number]) - sum(map(len, parts.values())):
                other = next(each for each in members[number] if each not in changed)
                others[number] = count, parts.setdefault(_following(steps[other], classes), [])
        moved: list[int] = []
        for number, parts in split.items():
            count, alike = others.get(number, (0, None))
            largest = max(parts.values(), key=lambda part: len(part) + count * (part is alike))
            if alike is not None and largest is not alike:
                alike += members[number] - changed
            for part in parts.values():
                if part is not largest:
                    members[number].difference_update(part)
                    for state in part:
                        classes[state] = len(members)
                    members.append(set(part))
                    moved += part
        changed = set[int]().union(*(leading[state] for state in moved))
    numbers = dict[int, int]()
    return [numbers.setdefault(each, len(numbers)) for each in classes]


def _following(rows: Sequence[Sequence[Step]], classes: Sequence[int]) -> Any:
    """How likely each action leads to each class, with what is shown and paid."""
    following = []
    for row in rows:
        parts = [
            ((classes[state] if state >= 0 else state, *shown), probability)
            for probability, state, *shown in row
        ]
        following.append(frozenset(summed(parts).items() if len(parts) > 1 else parts))
    return tuple(following)


@dataclass
class Node:
    """A belief and the observation with which it came."""

    belief: Belief
    seen: bytes
    depth: int  # steps from the start
    rows: list[list[Step]] = field(default_factory=list)  # by actions; empty where none was tried


_OFTEN = 100  # of so many nodes one shows how far it is
_BEYOND = 1_000  # nodes further than a step limit that are found too, so that a small world is whole


class Beliefs:
    """All beliefs that histories from the start lead to, breadth first.

    Args:
        starts: the probability of each hidden state and observation after a reset.
        steps: of each hidden state the outcomes of each action; empty where none was tried.
        too_large: makes an error of a reason.
        most_seconds: the time after which it is given up.
        show: shows how far it is.
        limit: steps of an episode; of a few nodes more, what follows in them is not asked.
    """

    def __init__(
        self,
        starts: Iterable[tuple[Fraction, int, bytes]],
        steps: Sequence[Sequence[Sequence[Step]]],
        too_large: Callable[[str], InputError],
        most_seconds: float,
        show: Callable[[str], None] = lambda what: None,
        limit: int | None = None,
    ) -> None:
        self._too_large, self._most, self._num_parts = too_large, _MOST_NODES, 0
        self._until = time.monotonic() + most_seconds
        self.nodes: list[Node] = []
        self._numbers: dict[tuple[Belief, bytes], int] = {}
        self._depth = 0  # of nodes that are found now
        first: dict[bytes, list[tuple[int, Fraction]]] = {}
        for probability, hidden, seen in starts:
            first.setdefault(seen, []).append((hidden, probability))
        self.starts = [self._node(parts, seen) for seen, parts in first.items()]  # probability and node
        beyond, size = math.inf, 0  # the first node at the limit, and how many there were when it came
        for number, node in enumerate(self.nodes):  # which grows
            if not number % _OFTEN:
                show(f"{len(self.nodes):,} distributions over its states")
            if limit is not None and node.depth >= limit and beyond == math.inf:
                beyond, size = number, len(self.nodes)
                self._most = min(self._most, size + _BEYOND)
            held = [(steps[hidden], probability) for hidden, probability in node.belief]
            self._depth = node.depth + 1
            try:
                if all(each for each, _ in held):
                    node.rows = [
                        self._row([(each[action], probability) for each, probability in held])
                        for action in range(len(held[0][0]))
                    ]
            except InputError:
                if beyond == math.inf:
                    raise
                for late in self.nodes[int(beyond) :]:
                    late.rows = []
                del self.nodes[size:]
                break

    def _row(self, hidden: Sequence[tuple[Sequence[Step], Fraction]]) -> list[Step]:
        groups: dict[tuple[bytes, float, bool, bool], list[tuple[int, Fraction]]] = {}
        for steps, share in hidden:
            for each in steps:
                parts = groups.setdefault((each.seen, each.reward, each.terminated, each.truncated), [])
                parts.append((each.following, share * each.probability))
        return [Step(*self._node(parts, seen), seen, *rest) for (seen, *rest), parts in groups.items()]  # type: ignore[arg-type]

    def _node(self, parts: list[tuple[int, Fraction]], seen: bytes) -> tuple[Fraction, int]:
        """The probability of these hidden states together, and the number of the node that they are."""
        if len(parts) == 1:
            total = parts[0][1]
            belief: Belief = ((parts[0][0], Fraction(1)),)
        else:
            sums = summed(parts)
            total = sum(sums.values(), Fraction(0))
            belief = tuple((hidden, sums[hidden] / total) for hidden in sorted(sums))
        key = belief, seen
        if key not in self._numbers:
            self._numbers[key] = len(self.nodes)
            self.nodes.append(Node(belief, seen, self._depth))
            self._num_parts += len(belief)
            is_long = max(each.denominator.bit_length() for _, each in belief) > _MOST_BITS
            is_many = len(self.nodes) > self._most or self._num_parts > _MOST_PARTS or is_long
            if time.monotonic() > self._until:
                raise self._too_large(
                    "its time is over before all is found that its observations leave open: "
                    f"{len(self.nodes):,} situations so far, and there are more"
                )
            if is_many:
                raise self._too_large(
                    "its observations do not show its state, and what histories say of it has no end in the "
                    f"size allowed: after {len(self.nodes):,} different distributions of {self._num_parts:,} "
                    "probabilities there are more; show more of the state, or set a limit "
                    "(env.kwargs.max_episode_steps)"
                )
        return total, self._numbers[key]

    def outcomes(self, name: str, num_actions: int, numbers: IntArray, size: int) -> Outcomes:
        """Its tables of `size` states, by the number (n,) of each node; what was not tried stays as it is."""
        width = max((len(row) for node in self.nodes for row in node.rows), default=1)
        check_size(name, size, num_actions, width)
        table = np.zeros((4, size, num_actions, width))
        table[0] = np.arange(size)[:, None, None]
        table[1, :, :, 0] = 1.0
        for number, node in zip(numbers, self.nodes, strict=True):
            for action, row in enumerate(node.rows):
                table[:, number, action, : len(row)] = np.array(
                    [
                        (numbers[each.following], float(each.probability), each.reward, each.terminated)
                        for each in row
                    ]
                ).T
        start = np.zeros(size)
        for probability, number in self.starts:
            start[numbers[number]] += float(probability)
        ends, reward = table[3] > 0, table[2]
        paid = ends & (reward > 0)
        return Outcomes(
            next_state=table[0].astype(np.int64),
            probability=table[1],
            reward=reward,
            terminated=ends,
            start=start,
            success=paid if paid.any() else None,
        )

    def num_aliased(self) -> int:
        """How many observations stand for several nodes in which something is to be done."""
        acting: dict[bytes, int] = {}
        for node in self.nodes:
            if node.rows:
                acting[node.seen] = acting.get(node.seen, 0) + 1
        return sum(number > 1 for number in acting.values())
