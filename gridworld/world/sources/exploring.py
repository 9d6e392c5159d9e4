"""The reachable states of a deterministic environment, found by trying every action in a copy of each.

Everything that changes is state, the elapsed time too, but for the attributes that the user names.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from gridworld.errors import InputError
from gridworld.process.console.progress import ProgressLine
from gridworld.process.console.terminal import printable
from gridworld.process.memory_budget import check_memory
from gridworld.world.outcomes import MOST_ACTIONS
from gridworld.world.sources.snapshots import Snapshots, key_of, random_states

_BEYOND = 1_000  # states further than a step limit that are found too, so that a small world is whole
_DEEPEST = 10_000  # steps from the start
_MANY_STATES = 20_000  # from which on their number is told
_MOST_BYTES = 2**31  # of all copies and observations together
_SAMPLED = 16  # of so many states the copy of one is kept, to tell what keeps changing
_FACING = ("right", "down", "left", "up")  # minigrid's directions
_SEEDS = 8  # resets that must lead to the same state
_FIXED = "; take an environment with a fixed layout and start, or name in env.ignore what nothing depends on"


class Subject:
    """The environment that is enumerated: one object, into which copies of its states are put.

    `ignore` names attributes that are no part of a state.
    """

    def __init__(self, name: str, env: gym.Env[Any, Any], ignore: Sequence[str] = ()) -> None:
        self.name, self.ignore = name, tuple(ignore)
        self.env = env.unwrapped
        self.snapshots = Snapshots(self.env)
        actions = env.action_space
        if not isinstance(actions, spaces.Discrete) or actions.start != 0 or actions.n > MOST_ACTIONS:
            raise self.refusal(
                f"its actions are {actions}, must be Discrete(n), from 0 to {MOST_ACTIONS} - 1"
            )
        self.num_actions = int(actions.n)
        self.env.reset(seed=0)
        if unknown := [each for each in ignore if each not in vars(self.env)]:
            raise InputError(
                f"env.ignore={list(ignore)}: {name} has no attribute {unknown[0]}; it has "
                f"{', '.join(vars(self.env))}"
            )
        key, before = self.key(), self._keys()
        for seed in range(_SEEDS):
            self.env.reset(seed=seed)
            if self.key() != key:
                changed = _listed(name for name, each in self._keys().items() if each != before.get(name))
                raise self.refusal(
                    f"a reset leads to another state with another seed or at another time (in {changed}), so "
                    f"that its states cannot be enumerated from one start{self._remedy or _FIXED}"
                )

    def _keys(self) -> dict[str, bytes]:
        return {name: key for name, key in self.snapshots.keys().items() if name not in self.ignore}

    @property
    def _remedy(self) -> str:
        return "; it has a transition table, so take env=gymnasium" if hasattr(self.env, "P") else ""

    def refusal(self, reason: str) -> InputError:
        """An error that says why there is no table of it."""
        return InputError(f"env.id={self.name}: {reason}")

    def key(self) -> bytes:
        """The key of its state."""
        try:
            return self.snapshots.key(self.ignore)
        except (TypeError, ValueError, RecursionError) as error:
            raise self.refusal(f"its state cannot be compared: {error}") from error

    def copy(self) -> bytes:
        """A copy of its state."""
        try:
            return self.snapshots.take()
        except Exception as error:  # whatever the classes in it raise
            raise self.refusal(f"its state cannot be copied: {error}") from error

    def steps(self, snapshot: bytes) -> list[tuple[bytes, Any, float, bool, bool]]:
        """Of each action in a copy of a state: a copy of what follows, observation, reward, both ends."""
        found = []
        before = random_states(self.env)
        for action in range(self.num_actions):
            self.snapshots.put_back(snapshot)
            try:
                observation, reward, terminated, truncated, _ = self.env.step(action)
            except Exception as error:  # whatever it raises
                raise self.refusal(f"a step with action {action} fails: {error}") from error
            found.append((self.copy(), observation, float(reward), bool(terminated), bool(truncated)))
        if random_states(self.env) != before:
            raise self.refusal(f"a step draws a random number, so it is not deterministic{self._remedy}")
        return found

    def state_name(self) -> str:
        """What a reader calls its state, by the attributes that minigrid's environments have; else ""."""
        place, direction = (getattr(self.env, name, None) for name in ("agent_pos", "agent_dir"))
        try:
            (col, row), facing = place, _FACING[direction]  # type: ignore[misc, index]
            name = f"row {int(row) + 1}, column {int(col) + 1}, facing {facing}"
        except (TypeError, ValueError, IndexError):
            return ""
        carried = getattr(getattr(self.env, "carrying", None), "type", None)
        time = "" if "step_count" in self.ignore else f", step {getattr(self.env, 'step_count', '?')}"
        return f"{name}{f', carrying a {carried}' if carried else ''}{time}"

    def changing(self, snapshots: Sequence[bytes]) -> str:
        """The attributes with the most values in copies of states, that of the elapsed time among them."""
        values: dict[str, set[bytes]] = {}
        for snapshot in snapshots:
            self.snapshots.put_back(snapshot)
            for name, key in self._keys().items():
                values.setdefault(name, set()).add(key)
        most = max(map(len, values.values()))
        return _listed(name for name, found in values.items() if len(found) == most)


def _listed(names: Any) -> str:
    return ", ".join(sorted(names)) or "nothing"


def explore(subject: Subject, most_states: int, limit: int | None) -> Graph:
    """Find all states that can be reached, breadth first, and what every action does there.

    Episodes are over at the step limit. What lies beyond it is left out where states hold the time; elsewhere
    it is found too if it is little.
    """
    search = Graph(subject, most_states)
    search.go_on(limit or _DEEPEST)
    if search.pending and limit is None:
        raise subject.refusal(
            f"after {_DEEPEST:,} steps there are still new states, since its {search.changing()}"
        )
    inside = len(search.depth)
    if search.pending and search.holds_time():
        return search.kept(inside, limit)
    if search.pending:
        search.most_states = min(most_states, inside + _BEYOND)
        try:
            search.go_on(None)
        except InputError:
            return search.kept(inside, limit)
    return search.kept(len(search.depth), None)


class Graph:
    """N states, the start first, found by a search, breadth first, that can stop at a depth.

    Attributes:
        pending: the states that are still to be tried.
        depth: of each state, the least steps from the start.
        seen, names: N digests of observations, and names, all empty where none are known.
        observations: N arrays; empty where observations are none.
        keys: N keys of states, once what is kept is known, as for all below.
        tried: (N,), whether steps from it were tried: it goes on from there.
        next_state, reward, terminated, truncated: (N, A); a state that was not tried leads to itself.
    """

    def __init__(self, subject: Subject, most_states: int) -> None:
        self.subject, self.most_states = subject, most_states
        self.pending = [0]
        self.depth: list[int] = []
        self.seen: list[bytes] = []
        self.names: list[str] = []
        self.observations: list[NDArray[Any]] = []
        self._as_array = _array_reader(subject)
        self._rows: dict[int, list[tuple[int, float, bool, bool]]] = {}
        self._goes_on = {0}
        self._state_of_copy: dict[bytes, int] = {}  # by a digest of a copy, of which a state may have several
        self._state: dict[bytes, int] = {}  # by its key
        self._snapshots: list[bytes] = []
        self._num_bytes = 0
        observation, _ = subject.env.reset(seed=0)
        self._state_after(subject.copy(), observation, 0)

    def go_on(self, deepest: int | None) -> None:
        """Try what is pending, and what is found by that; states at the depth `deepest` are left pending."""
        left = []
        line = ProgressLine(True)
        for state in self.pending:  # which grows
            if self.depth[state] == deepest:
                left.append(state)
                continue
            row = []
            moves = self.subject.steps(self._snapshots[state])
            for copy, observation, reward, terminated, truncated in moves:
                following = self._state_after(copy, observation, self.depth[state] + 1)
                row.append((following, reward, terminated, truncated))
                if not (terminated or truncated or following in self._goes_on):
                    self._goes_on.add(following)
                    self.pending.append(following)
            self._rows[state] = row
            if state % _SAMPLED:
                self._num_bytes -= len(self._snapshots[state])
                self._snapshots[state] = b""
            if len(self.depth) > _MANY_STATES and state % 500 == 0:
                line.show(
                    lambda: (
                        f"enumerating {printable(self.subject.name)}: {len(self.depth):,} states so far, at "
                        f"most {self.most_states:,}; Ctrl-C ends it"
                    )
                )
        line.clear()
        self.pending = left

    def holds_time(self) -> bool:
        """Whether no state is met at two times."""
        return all(
            self.depth[following] == self.depth[state] + 1
            for state, row in self._rows.items()
            for following, *_ in row
        )

    def _state_after(self, copy: bytes, observation: Any, depth: int) -> int:
        """The number of a state that the subject may have been in before, given a copy of it."""
        subject, short, seen = self.subject, key_of(copy), key_of(observation)
        state = self._state_of_copy.get(short)
        if state is None:
            subject.snapshots.put_back(copy)
            state = self._state_of_copy[short] = self._state.setdefault(subject.key(), len(self._state))
        if state == len(self.depth):
            self._add(copy, seen, observation, depth)
        elif self.seen[state] != seen:
            left_out = ", ".join(subject.ignore)
            without = f" without {left_out}, which env.ignore leaves out" if left_out else ""
            raise subject.refusal(
                "the same state is shown by different observations, so that what an agent sees is no "
                f"function of the state{without}"
            )
        return state

    def _add(self, copy: bytes, seen: bytes, observation: Any, depth: int) -> None:
        self.depth.append(depth)
        self._snapshots.append(copy)
        self.seen.append(seen)
        self.names.append(self.subject.state_name())
        self._num_bytes += len(copy)
        array = self._as_array(observation)
        if array is not None:
            self.observations.append(array)
            self._num_bytes += array.nbytes
        size = len(self.depth)
        if size > self.most_states:
            raise self.subject.refusal(
                f"more than {self.most_states:,} states can be reached, and more than that cannot be solved "
                f"for, since its {self.changing()}"
            )
        if self._num_bytes > _MOST_BYTES:
            raise self.subject.refusal(
                f"copies of the first {size:,} states take more than {_MOST_BYTES / 2**30:.0f} GiB"
            )
        check_memory(f"env.id={self.subject.name}", self._num_bytes)

    def changing(self) -> str:
        """What keeps changing, and what can be done about it, as the rest of a sentence."""
        found = self.subject.changing([each for each in self._snapshots[::_SAMPLED] if each][-1000:])
        return (
            f"{found} keeps changing; take a smaller one, set a limit (env.kwargs.max_episode_steps), or "
            f"leave out what nothing depends on, e.g. env.ignore=[{found.split(',')[0]}]"
        )

    def kept(self, size: int, limit: int | None) -> Graph:
        """The first states of those found; from a limit on they count as not tried."""
        for each in (self.depth, self.seen, self.names, self.observations):
            del each[size:]
        self.keys = list(self._state)[:size]
        self.tried = np.array([state in self._rows and self.depth[state] != limit for state in range(size)])
        still = [[(state, 0.0, False, False)] * self.subject.num_actions for state in range(size)]
        rows = [self._rows[state] if self.tried[state] else still[state] for state in range(size)]
        columns = np.array(rows, dtype=np.float64).reshape(size, self.subject.num_actions, 4)
        self.next_state, self.reward = columns[:, :, 0].astype(np.int64), columns[:, :, 1]
        self.terminated, self.truncated = columns[:, :, 2] > 0, columns[:, :, 3] > 0
        return self


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
