"""What the elapsed time changes in an environment that counts its steps, and states with their time.

Where the reward depends on the step count, as in MiniGrid, the time is part of a state: a world is then one
copy of its states for every step of an episode. Which steps pay by the time is found out by trying each at
three times, among them the first and the last possible one; over all steps, every time is tried. Those that
pay by the time are tried at all times. That nothing was missed is checked by replays (`replays`).

At the step limit an episode is truncated. A state of that time is not terminal, since the environment does
not say so, but nothing follows: every action stays there and pays nothing. Its value is 0, and V* without a
step limit is the value of the best episode within the environment's own limit.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from gridworld.world.mdp import BoolArray, FloatArray, IntArray
from gridworld.world.outcomes import Outcomes
from gridworld.world.sources.enumeration.exploring import Clocks, Graph, Subject, TimeMattersError

_LONGEST = 10_000  # steps; who truncates later is taken to have no limit
_UNLIMITED = 1_000  # steps within which rewards must not depend on the time where there is no limit
_WALK = 40  # steps that an attribute must count to be a clock

Rewards = dict[tuple[int, int], FloatArray]  # (L,) by (state, action), NaN where it cannot be reached


def find_clocks(subject: Subject, limit: int | None) -> Clocks:
    """The attributes that count the steps, with their values at a reset; what merely looks so is included.

    Args:
        subject: the environment.
        limit: the steps of its episodes, if that is known.
    """
    subject.reset(0)
    first = {name: value for name, value in vars(subject.env).items() if type(value) is int}
    counting, steps = set(first), 0
    for action in itertools.islice(itertools.cycle(range(subject.num_actions)), _WALK + subject.num_actions):
        *_, terminated, truncated = subject.step(action)
        steps += 1
        counting = {name for name in counting if getattr(subject.env, name, None) == first[name] + steps}
        if terminated or truncated or steps == limit:
            subject.reset(0)
            steps = 0
    return {name: first[name] for name in sorted(counting)}


def own_limit(subject: Subject, graph: Graph, clocks: Clocks, longest: int | None) -> int | None:
    """The time at which the environment truncates an episode; None if not within `longest` steps."""
    lasting = np.flatnonzero(~graph.terminated[0])
    if lasting.size:
        for time in range(min(longest or _LONGEST, _LONGEST)):
            if subject.truncates(graph.snapshots[0], clocks, time, int(lasting[0])):
                return time + 1
    return None


@dataclass(frozen=True, eq=False)
class Trials:
    """Steps tried at any time of an episode.

    Attributes:
        subject: the environment.
        graph: its states without time.
        clocks: its step counts.
        own_limit: the time at which the environment truncates, if any.
    """

    subject: Subject
    graph: Graph
    clocks: Clocks
    own_limit: int | None

    def rewards_by_time(self, limit: int | None, most_states: int) -> Rewards:
        """The rewards that depend on the time, within `limit` steps; empty where none does.

        Args:
            limit: L, the last step of an episode; None: there is none.
            most_states: of states with their time, more are refused.

        Raises:
            TimeMattersError: something else depends on the time too.
            InputError: a reward does, and with the time there are too many states.
        """
        last = limit or _UNLIMITED
        others = itertools.cycle(np.random.default_rng(0).permutation(last).tolist())
        varying: Rewards = {}
        states = np.flatnonzero(self.graph.tried & (self.graph.depth < last))
        pays = np.abs(self.graph.reward[states]).max(axis=1)
        for state in states[np.argsort(-pays, kind="stable")].tolist():  # likely ones first
            first = int(self.graph.depth[state])
            for action in range(self.subject.num_actions):
                times = {first, last - 1, max(first, next(others))}
                found = {self._reward(state, action, time) for time in times}
                if found != {self.graph.reward[state, action]}:
                    if not varying:
                        self._check_size(limit, most_states)
                    by_time = [self._reward(state, action, time) for time in range(first, last)]
                    varying[state, action] = np.concatenate([np.full(first, np.nan), by_time])
        return varying

    def _check_size(self, limit: int | None, most_states: int) -> None:
        if limit is None:
            raise self.subject.refusal(
                "its reward depends on the elapsed time, and its episodes have no step limit, so that its "
                "states have no end; set env.kwargs.max_episode_steps"
            )
        size = _Layers(self.graph, limit).size
        if size > most_states:
            raise self.subject.refusal(
                f"its reward depends on the elapsed time, and with it there are {size:,} states, "
                f"{len(self.graph.keys):,} without it; at most {most_states:,} can be solved for"
            )

    def _reward(self, state: int, action: int, time: int) -> float:
        graph = self.graph
        move = self.subject.try_action(graph.snapshots[state], self.clocks, time, action)
        following = graph.next_state[state, action]
        if (
            move.key != graph.keys[following]
            or move.seen != graph.seen[following]
            or move.terminated != graph.terminated[state, action]
            or move.truncated != (self.own_limit is not None and time + 1 >= self.own_limit)
        ):
            raise TimeMattersError
        return move.reward


@dataclass(frozen=True, eq=False)
class Timed:
    """States with their time.

    Attributes:
        outcomes: of n of them.
        state: (n,), integers, which state without time each is.
    """

    outcomes: Outcomes
    state: IntArray


class _Layers:
    """Which states are reached at each time from 0 to `limit`.

    Attributes:
        states: of each time (n,), ascending.
        playing: of each time (n,), whether it goes on from there.
        first: of each time, the number of its first state.
    """

    def __init__(self, graph: Graph, limit: int) -> None:
        self.states: list[IntArray] = [np.array([0])]
        self.playing: list[BoolArray] = [np.array([True])]
        for _ in range(limit):
            states = self.states[-1][self.playing[-1]]
            following = graph.next_state[states]
            self.states.append(np.unique(following))
            self.playing.append(np.isin(self.states[-1], following[~graph.terminated[states]]))
        self.first = np.cumsum([0, *map(len, self.states)])

    @property
    def size(self) -> int:
        """Of all times together."""
        return int(self.first[-1])


def with_time(graph: Graph, rewards: Rewards, limit: int) -> Timed:
    """Make states of (state, time).

    Args:
        graph: the states without time.
        rewards: those that depend on the time.
        limit: the time of the last states, in which nothing is possible any more.
    """
    layers = _Layers(graph, limit)
    actions = graph.next_state.shape[1]
    next_state = np.repeat(np.arange(layers.size)[:, None], actions, axis=1)
    reward, terminated = np.zeros(next_state.shape), np.zeros(next_state.shape, dtype=np.bool_)
    for time in range(limit):
        playing = layers.playing[time]
        states = layers.states[time][playing]
        rows = layers.first[time] + np.flatnonzero(playing)
        following = np.searchsorted(layers.states[time + 1], graph.next_state[states])
        next_state[rows] = layers.first[time + 1] + following
        reward[rows], terminated[rows] = graph.reward[states], graph.terminated[states]
        row = dict(zip(states.tolist(), rows.tolist(), strict=True))
        for (state, action), by_time in rewards.items():
            if state in row:
                reward[row[state], action] = by_time[time]
    outcomes = outcomes_of(next_state, reward, terminated, _paid(reward, terminated))
    return Timed(outcomes, np.concatenate(layers.states))


def _paid(reward: FloatArray, terminated: BoolArray) -> BoolArray | None:
    """Which ends are a success: those that pay, since what they pay gets less; None: those that pay best."""
    paid = terminated & (reward > 0)
    return paid if paid.any() else None


def outcomes_of(
    next_state: IntArray, reward: FloatArray, terminated: BoolArray, success: BoolArray | None
) -> Outcomes:
    """Outcomes of a deterministic world from tables (N, A), with state 0 as the start."""
    return Outcomes(
        next_state=next_state[:, :, None],
        probability=np.ones((*next_state.shape, 1)),
        reward=reward[:, :, None],
        terminated=terminated[:, :, None],
        start=np.eye(1, len(next_state))[0],
        success=None if success is None else success[:, :, None],
    )
