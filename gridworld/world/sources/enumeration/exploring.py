"""The reachable states of a deterministic environment, found by trying every action in copies of each.

A step count is left out of the states (`clocks`): a grid of 144 positions with a step limit of 256 has
36,864 states, and one step in each of 144 tells almost all about them. `elapsed_time` asks what the time
changes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from gridworld.errors import InputError
from gridworld.process.console.progress import ProgressLine
from gridworld.process.console.terminal import printable
from gridworld.process.memory_budget import check_memory
from gridworld.world.mdp import BoolArray, FloatArray, IntArray
from gridworld.world.outcomes import MOST_ACTIONS
from gridworld.world.sources.enumeration.snapshots import Snapshots, key_of, random_states

Clocks = Mapping[str, int]  # attributes that count steps, and what they are at a reset
_Rows = dict[int, list[tuple[int, float, bool, bool]]]  # next state, reward, terminated, truncated, by action

_MANY_STATES = 20_000  # from which on their number is told
_MOST_BYTES = 2**31  # of all copies and observations together
_SEEDS = 8  # resets that must lead to the same state


class TimeMattersError(Exception):
    """A step does something else at another time."""


class Move(NamedTuple):
    """What a step does."""

    key: bytes  # of the state that follows
    seen: bytes  # a digest of the observation
    observation: Any
    reward: float
    terminated: bool
    truncated: bool


class Subject:
    """The environment that is enumerated: one object, into which copies of its states are put.

    Args:
        name: what messages call it.
        env: an environment, wrapped or not.

    Attributes:
        num_actions: A.
        snapshots: of it.

    Raises:
        InputError: other actions than numbers from 0 on; or its resets lead to different states.
    """

    def __init__(self, name: str, env: gym.Env[Any, Any]) -> None:
        self.name = name
        self.env = env.unwrapped
        self.snapshots = Snapshots(self.env)
        actions = env.action_space
        if not isinstance(actions, spaces.Discrete) or actions.start != 0 or actions.n > MOST_ACTIONS:
            raise self.refusal(
                f"its actions are {actions}, must be Discrete(n), from 0 to {MOST_ACTIONS} - 1"
            )
        self.num_actions = int(actions.n)
        keys = {self.reset(seed)[0] for seed in range(_SEEDS)}
        if len(keys) > 1:
            raise self.refusal(
                "a reset leads to another state with another seed, so that its states cannot be enumerated "
                f"from one start{self._remedy or '; take an environment whose layout and start are fixed'}"
            )

    @property
    def _remedy(self) -> str:
        return "; it has a transition table, so take env=gymnasium" if hasattr(self.env, "P") else ""

    def refusal(self, reason: str) -> InputError:
        """An error that says why there is no table of it."""
        return InputError(f"env.id={self.name}: {reason}")

    def reset(self, seed: int) -> tuple[bytes, Any]:
        """The key of the state after a reset, and the observation."""
        observation, _ = self.env.reset(seed=seed)
        return self.key(), observation

    def truncates(self, snapshot: bytes, clocks: Clocks, time: int, action: int) -> bool:
        """Whether an action truncates, as in `try_action`."""
        self._set(snapshot, clocks, time)
        return self.step(action)[3]

    def _set(self, snapshot: bytes, clocks: Clocks, time: int) -> None:
        self.snapshots.put_back(snapshot)
        for clock, first in clocks.items():
            setattr(self.env, clock, first + time)

    def step(self, action: int) -> tuple[Any, float, bool, bool]:
        """Observation, reward, terminated and truncated of a step.

        Raises:
            InputError: the step fails.
        """
        try:
            observation, reward, terminated, truncated, _ = self.env.step(action)
        except Exception as error:  # whatever it raises
            raise self.refusal(f"a step with action {action} fails: {error}") from error
        return observation, float(reward), bool(terminated), bool(truncated)

    def key(self, clocks: Clocks | None = None) -> bytes:
        """The key of its state; the clocks do not count."""
        try:
            return self.snapshots.key(clocks or ())
        except (TypeError, ValueError, RecursionError) as error:
            raise self.refusal(f"its state cannot be compared: {error}") from error

    def copy(self) -> bytes:
        """A copy of its state."""
        try:
            return self.snapshots.take()
        except Exception as error:  # whatever the classes in it raise
            raise self.refusal(f"its state cannot be copied: {error}") from error

    def try_action(self, snapshot: bytes, clocks: Clocks, time: int, action: int) -> Move:
        """Take an action in a copy of a state, with its clocks set as they are after `time` steps.

        Raises:
            InputError: the step fails, or draws a random number.
        """
        self._set(snapshot, clocks, time)
        before = random_states(self.env)
        observation, reward, terminated, truncated = self.step(action)
        if random_states(self.env) != before:
            raise self.refusal(
                f"a step with action {action} draws a random number, so it is not deterministic{self._remedy}"
            )
        if any(getattr(self.env, clock, None) != first + time + 1 for clock, first in clocks.items()):
            raise TimeMattersError
        return Move(self.key(clocks), key_of(observation), observation, reward, terminated, truncated)


@dataclass(eq=False)
class Graph:
    """N states without their time, the start first.

    Attributes:
        next_state: (N, A), integers; of states that are not tried, themselves.
        reward: (N, A), float64.
        terminated: (N, A), bool.
        truncated: (N, A), bool.
        tried: (N,), bool, whether steps from it were tried: it goes on from there.
        depth: (N,), integers, the least steps from the start.
        keys: N keys.
        seen: N digests of observations.
        observations: N observations, as arrays; empty where they are none.
        snapshots: N copies.
    """

    next_state: IntArray
    reward: FloatArray
    terminated: BoolArray
    truncated: BoolArray
    tried: BoolArray
    depth: IntArray
    keys: list[bytes]
    seen: list[bytes]
    observations: list[NDArray[Any]]
    snapshots: list[bytes]


@dataclass(eq=False)
class _Found:
    """The states found so far; `goes_on`: whether an episode may go on from there."""

    as_array: Callable[[Any], NDArray[Any] | None]
    number: dict[bytes, int] = field(default_factory=dict)
    depth: list[int] = field(default_factory=list)
    goes_on: list[bool] = field(default_factory=list)
    seen: list[bytes] = field(default_factory=list)
    observations: list[NDArray[Any]] = field(default_factory=list)
    snapshots: list[bytes] = field(default_factory=list)
    num_bytes: int = 0

    def add(self, key: bytes, seen: bytes, observation: Any, snapshot: bytes, depth: int) -> int:
        self.number[key] = len(self.number)
        self.depth.append(depth)
        self.goes_on.append(False)
        self.seen.append(seen)
        self.snapshots.append(snapshot)
        self.num_bytes += len(snapshot)
        array = self.as_array(observation)
        if array is not None:
            self.observations.append(array)
            self.num_bytes += array.nbytes
        return len(self.number) - 1

    def forget(self, first: int) -> None:
        """Leave out the states from this number on."""
        for each in (self.depth, self.goes_on, self.seen, self.observations, self.snapshots):
            del each[first:]
        self.number = {key: state for key, state in self.number.items() if state < first}


def explore(
    subject: Subject, clocks: Clocks, most_states: int, deepest: int | None = None, beyond: int = 0
) -> Graph:
    """Find all states that can be reached, breadth first, and what every action does there.

    At `deepest` steps from the start episodes are over. What lies beyond is found too where there are few
    such states, and left out otherwise: a state may hold the time in any form, and then they have no end.

    Args:
        subject: the environment.
        clocks: attributes that are no part of a state; they are as after a reset before each step.
        most_states: more are refused.
        deepest: the step limit, if one is known.
        beyond: states beyond it; if there are more, or one cannot be tried, all are left out.

    Raises:
        TimeMattersError: the clocks do not count every step, or observations show them.
        InputError: too many states; or what `Subject.try_action` refuses.
    """
    _, observation = subject.reset(0)
    found = _Found(_array_reader(subject))
    found.add(subject.key(clocks), key_of(observation), observation, subject.copy(), 0)
    found.goes_on[0] = True
    search = _Search(subject, clocks, found, [0])
    search.go_on(most_states, deepest)
    if search.pending and beyond:
        size, rows = len(found.number), dict(search.rows)
        try:
            search.go_on(min(most_states, size + beyond), None)
        except InputError:
            found.forget(size)
            search.rows = rows
    return _as_graph(found, search.rows, subject.num_actions)


@dataclass(eq=False)
class _Search:
    """A search, breadth first, that can stop at a depth: `pending` is what is to be tried."""

    subject: Subject
    clocks: Clocks
    found: _Found
    pending: list[int]
    rows: _Rows = field(default_factory=dict)

    def go_on(self, most_states: int, deepest: int | None) -> None:
        """Try what is pending, and what is found by that; states at the depth `deepest` are left pending."""
        subject, clocks, found, left = self.subject, self.clocks, self.found, []
        line = ProgressLine(True)
        for state in self.pending:  # which grows
            if found.depth[state] == deepest:
                left.append(state)
                continue
            row = []
            for action in range(subject.num_actions):
                move = subject.try_action(found.snapshots[state], clocks, 0, action)
                following = _state_of(subject, found, move, found.depth[state] + 1, clocks, most_states)
                row.append((following, move.reward, move.terminated, move.truncated))
                over = move.terminated or (move.truncated and not clocks)
                if not (over or found.goes_on[following]):
                    found.goes_on[following] = True
                    self.pending.append(following)
            self.rows[state] = row
            if len(found.number) > _MANY_STATES and state % 500 == 0:
                line.show(lambda: self._how_far(deepest, most_states))
        line.clear()
        self.pending = left

    def _how_far(self, deepest: int | None, most_states: int) -> str:
        hint = "" if deepest else ", no step limit ends them (env.kwargs.max_episode_steps would)"
        return (
            f"enumerating {printable(self.subject.name)}: {len(self.found.number):,} states so far, at most "
            f"{most_states:,}{hint}; Ctrl-C ends it"
        )


def _state_of(
    subject: Subject, found: _Found, move: Move, depth: int, clocks: Clocks, most_states: int
) -> int:
    """The number of the state that a move has led to, where the subject is now."""
    state = found.number.get(move.key)
    if state is None:
        if len(found.number) >= most_states:
            raise subject.refusal(
                f"more than {most_states:,} states can be reached, and more than that cannot be solved for; "
                "take a smaller one"
            )
        state = found.add(move.key, move.seen, move.observation, subject.copy(), depth)
        if found.num_bytes > _MOST_BYTES:
            raise subject.refusal(
                f"copies of the first {state + 1:,} states take more than {_MOST_BYTES / 2**30:.0f} GiB"
            )
        check_memory(f"env.id={subject.name}", found.num_bytes)
    elif found.seen[state] != move.seen:
        if clocks:
            raise TimeMattersError
        raise subject.refusal(
            "the same state is shown by different observations, so that what an agent sees is no function of "
            "the state"
        )
    return state


def _as_graph(found: _Found, rows: _Rows, num_actions: int) -> Graph:
    size = len(found.number)
    still = [[(state, 0.0, False, False)] * num_actions for state in range(size)]
    for state, row in rows.items():
        still[state] = row
    columns = np.array(still, dtype=np.float64).reshape(size, num_actions, 4)
    return Graph(
        next_state=columns[:, :, 0].astype(np.int64),
        reward=columns[:, :, 1],
        terminated=columns[:, :, 2] > 0,
        truncated=columns[:, :, 3] > 0,
        tried=np.isin(np.arange(size), list(rows)),
        depth=np.array(found.depth),
        keys=list(found.number),
        seen=found.seen,
        observations=found.observations,
        snapshots=found.snapshots,
    )


def _array_reader(subject: Subject) -> Callable[[Any], NDArray[Any] | None]:
    """How an observation is made an array: as it is, of a Dict the `image`; None where there is none."""
    space = subject.env.observation_space
    of_image = isinstance(space, spaces.Dict)
    part = space.spaces.get("image") if isinstance(space, spaces.Dict) else space
    if not isinstance(part, spaces.Box if of_image else spaces.Box | spaces.Discrete):
        return lambda observation: None

    def read(observation: Any) -> NDArray[Any]:
        try:
            array = np.array(observation["image"]) if of_image else np.array(observation, dtype=space.dtype)
            fits = array.shape == part.shape and array.dtype.kind in "biuf"
            if isinstance(part, spaces.Discrete):
                fits = fits and bool(part.start <= array < part.start + part.n)
        except (TypeError, ValueError, KeyError, IndexError, OverflowError):
            fits = False
        if not fits:
            raise subject.refusal(
                f"an observation is {' '.join(str(observation).split())[:80]}, which does not fit its "
                f"space {' '.join(str(space).split())[:120]}"
            )
        return array

    return read
