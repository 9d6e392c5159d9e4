"""The states of a Gymnasium environment, and what every action does in a copy of each.

A search holds one environment, into which it puts copies of states. A state is read exactly or refused
(`reading`). In place of `np_random` there is a generator that takes every outcome in turn (`branching`).
Draws from other generators are refused, wherever the state holds them, and so are spaces and functions that
change, and changes outside the attributes.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import itertools
import math
import pickle
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from enum import EnumType
from typing import Any, NoReturn

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from gridworld.base.errors import InputError
from gridworld.base.user_input import check_memory
from gridworld.world.enumeration.beliefs import Step
from gridworld.world.enumeration.branching import Branching
from gridworld.world.enumeration.snapshots import Snapshots, random_states
from gridworld.world.outcomes import MOST_ACTIONS
from gridworld.world.reach import Reach
from gridworld.world.reading import UnreadableError, digest

_BEYOND = 1_000  # states further than a step limit that are found too, so that a small world is whole
_DEEPEST = 10_000  # steps from the start
_MOST_BYTES = 2**31  # of all copies and observations together
_SAMPLED = 16  # of so many states the copy of one is kept, to name what keeps changing
_FACING = ("right", "down", "left", "up")  # minigrid's directions
_METHODS = ("step", "reset")  # what is read of them
_ELSEWHERE = "draws a random number from another generator than self.np_random, so its outcomes are unknown"
OVER = -1  # in place of the state in which an episode ends, where there is chance
_MOST_RUNS = 10_000_000  # of a step or a reset, some minutes
_WATCHED, _WATCHED_LATER = 100, 1_009  # first runs after which all that is outside is compared; later one of
_LONGEST_NAME = 60  # of a state that is called by its observation

_digest_of_whole = functools.lru_cache(2**16)(digest)  # of tuples, which are the same where they are equal
Named = tuple[str, tuple[str, int, int] | None]  # what a reader calls a state, and its place


@dataclass
class State:
    """A state of the environment itself, which an agent may not see."""

    number: int
    key: bytes
    alike: bytes  # its key without types of numbers
    seen: bytes  # a digest of the observation with which it was found
    depth: int  # steps from the start
    copy: bytes  # b"" where it is no longer needed
    name: str
    place: tuple[str, int, int] | None  # which way the agent faces, row and column
    is_open: bool = False  # an episode goes on in it
    steps: Sequence[Sequence[Step]] = ()  # the outcomes of each action; empty where none was tried


class StateSearch:
    """Finds the states of an environment, those after a reset first, breadth first.

    It is one object, into which copies of its states are put; `ignore` are attributes that are no state.
    """

    def __init__(self, name: str, env: gym.Env[Any, Any], ignore: Sequence[str], most_states: int) -> None:
        self.name, self.ignore, self._most_states = name, tuple(ignore), most_states
        self.states: list[State] = []
        self.observations: dict[bytes, NDArray[Any] | None] = {}  # by their digests
        self.shown: dict[bytes, str] = {}  # the same as short texts
        self.ends: dict[bytes, Named] = {}  # what ends are called, by their observations
        self.is_random = False
        self.env = env.unwrapped
        self._branching = Branching(f"env.id={name}")
        self._snapshots = Snapshots(self.env, self._branching)
        actions = env.action_space
        if not isinstance(actions, spaces.Discrete) or actions.start != 0 or actions.n > MOST_ACTIONS:
            raise self.refusal(
                f"its actions are {actions}, must be Discrete(n), from 0 to {MOST_ACTIONS} - 1"
            )
        self.num_actions = int(actions.n)
        self._by_key: dict[bytes, State] = {}
        self._by_copy: dict[bytes, State] = {}  # by a digest of a copy, of which a state may have several
        self._num_bytes = self._num_runs = 0
        self._outside, self._before = list[Reach](), list[bytes]()
        self._values = set[tuple[str, Any]]()  # of all attributes, in all states and ends so far
        self._not_reset: list[bytes] = []  # copies with a value among these that no reset was tried from

    def refusal(self, reason: str) -> InputError:
        """An error that says why there is no table of it."""
        return InputError(f"env.id={self.name}: {reason}")

    def _prepare(self) -> None:
        """Find the starts, with the generator that branches wherever the environment holds its own."""
        own = self.env.np_random  # it is made when it is first asked for
        self._snapshots.replace(own, self._branching)
        self._first = self._snapshots.take()  # before the first reset, which may set what others keep
        try:
            self.starts = self._resets(self._first)
        except InputError:
            self._reached()  # which may name the reason
            raise
        if unknown := [each for each in self.ignore if each not in vars(self.env)]:
            raise InputError(
                f"env.ignore={list(self.ignore)}: {self.name} has no attribute {unknown[0]}; it has "
                f"{', '.join(vars(self.env))}"
            )

    def explore(self, limit: int | None) -> None:
        """Find all states that can be reached, and what every action does there.

        Episodes are over at the step limit. What lies beyond it is kept too if it is little.
        """
        self._prepare()
        self._outside = self._reached()
        self._before = [each.content(is_outside=True) for each in self._outside]
        waiting, size = [self.states[each.following] for each in self.starts], 0
        waiting = list({each.number: each for each in waiting}.values())
        for state in waiting:
            state.is_open = True
        self._check_resets(waiting[0].copy)
        beyond: int | None = None  # where in `waiting` the limit is, with `size` states before it
        for place, state in enumerate(waiting):  # which grows
            if beyond is None and state.depth >= (limit or _DEEPEST):
                if limit is None:
                    still = f"after {_DEEPEST:,} steps it still finds new states"
                    raise self.refusal(f"{still}, since its {self._what_changes()}")
                beyond, size = place, len(self.states)
                self._most_states = min(self._most_states, size + _BEYOND)
            try:
                state.steps = self._tried(state)
            except InputError:
                if beyond is None:
                    raise
                for late in waiting[beyond:]:
                    late.steps = ()
                del self.states[size:]
                break
            for step in itertools.chain.from_iterable(state.steps):
                following = self.states[step.following]  # of an end, any
                if not (step.terminated or step.truncated or following.is_open):
                    following.is_open = True
                    waiting.append(following)
        self._check_outside()
        self._check_resets(next(each.copy for each in reversed(self.states) if each.copy))

    def _reached(self) -> list[Reach]:
        where = f"env.id={self.name}"
        return [Reach(where, self.env, method, [self._branching], skips=True) for method in _METHODS]

    def _check_outside(self) -> None:
        kept = self._snapshots.changed()
        if kept is not None or [each.content(is_outside=True) for each in self._outside] != self._before:
            raise self.refusal(
                f"a step changes {type(kept).__name__ if kept else 'what is outside of its attributes'}, of "
                "which no copies can be made; hold what changes in attributes: numbers, lists, numpy arrays"
            )

    def _resets(self, copy: bytes) -> list[Step]:
        """What a reset leads to from a copy of a state."""
        with self._no_other_draws("reset"):
            return self._merged(functools.partial(self._reset, copy))

    def _reset(self, copy: bytes) -> tuple[int, bytes, float, bool, bool]:
        self._snapshots.put_back(copy)
        try:
            observation, _ = self.env.reset()
        except Exception as error:  # whatever it raises
            raise self.refusal(f"a reset fails: {error}") from error
        if vars(self.env).get("_np_random") is not self._branching:
            raise self.refusal("reset() makes another np_random; leave that to super().reset(seed=seed)")
        return *self._state_after(observation, 0), 0.0, False, False

    def _has_new_values(self) -> bool:
        """Whether an attribute has a value that it had in no state or end before."""
        size = len(self._values)
        self._values.update(self._snapshots.values(self.ignore))
        return len(self._values) > size

    def _check_first_resets(self) -> None:
        """A reset must lead to the same after each value that an attribute has, in ends too, by one draw."""
        with self._no_other_draws("reset"):
            while self._not_reset:
                copy = self._not_reset.pop()
                if self._branching.first(functools.partial(self._reset, copy))[:2] != self.starts[0][1:3]:
                    self._refuse_reset(copy)

    def _check_resets(self, copy: bytes) -> None:
        """A reset must lead to the same, whatever it draws."""
        size = len(self.states)
        if sorted(self._resets(copy)) != sorted(self.starts) or len(self.states) > size:
            self._refuse_reset(copy)

    def _refuse_reset(self, copy: bytes) -> NoReturn:
        usual, found = self._values_after_resets(self._first), self._values_after_resets(copy)
        changed = _listed(name for name in usual | found if usual.get(name) != found.get(name))
        raise self.refusal(
            f"a reset does not always lead to the same state (in {changed}), so its states cannot be "
            "enumerated from one start; set all of it in reset(), or list irrelevant attributes in env.ignore"
        )

    def _values_after_resets(self, copy: bytes) -> dict[str, set[bytes]]:
        values: dict[str, set[bytes]] = {}

        def reset() -> tuple[int, bytes, float, bool, bool]:
            result = self._reset(copy)
            for name, value in self._snapshots.keys(self.ignore).items():
                values.setdefault(name, set()).add(value)
            return result

        self._branching.outcomes(reset)
        return values

    @contextlib.contextmanager
    def _no_other_draws(self, what: str) -> Iterator[None]:
        before = self._snapshots.random_states(), random_states()
        try:
            yield
        finally:  # whatever else is refused
            if (self._snapshots.random_states(), random_states()) != before:
                raise self.refusal(f"a {what} {_ELSEWHERE}")

    def _tried(self, state: State) -> list[list[Step]]:
        """What each action does in a copy of a state."""
        actions = range(self.num_actions)
        with self._no_other_draws("step"):
            steps = [self._merged(functools.partial(self._stepped, state, action)) for action in actions]
        if self._not_reset:
            self._check_first_resets()
        if state.number.bit_count() == 1:  # 1, 2, 4, 8 ...
            self._check_resets(state.copy)
        if state.number % _SAMPLED:
            self._num_bytes -= len(state.copy)
            state.copy = b""
        return steps

    def _stepped(self, state: State, action: int) -> tuple[int, bytes, float, bool, bool]:
        self._snapshots.put_back(state.copy)
        try:
            observation, reward, terminated, truncated, _ = self.env.step(action)
            shown = float(reward), bool(terminated), bool(truncated)
        except Exception as error:  # whatever it raises
            raise self.refusal(f"a step with action {action} fails: {error}") from error
        if not math.isfinite(shown[0]):
            raise self.refusal(f"a step with action {action} pays {shown[0]}; must be a finite number")
        return *self._state_after(observation, state.depth + 1, is_over=shown[1]), *shown

    def _merged(self, run: Callable[[], tuple[int, bytes, float, bool, bool]]) -> list[Step]:
        """Its different results, each with its probability."""

        def watched() -> tuple[int, bytes, float, bool, bool]:
            result = run()
            self._num_runs += 1
            self.is_random |= self._branching.has_drawn
            if self._num_runs <= _WATCHED or not self._num_runs % _WATCHED_LATER:
                self._check_outside()
            return result

        found = self._branching.outcomes(watched)
        if self._num_runs > _MOST_RUNS:
            raise self.refusal(f"its random outcomes are more than {_MOST_RUNS:,}, too many to try them all")
        return [Step(probability, *result) for result, probability in found.items()]

    def _state_after(self, observation: Any, depth: int, is_over: bool = False) -> tuple[int, bytes]:
        """The number of the state that the environment is in, and a digest of the observation."""
        try:
            is_whole = type(observation) is tuple and all(type(each) is int for each in observation)
            seen = (_digest_of_whole if is_whole else digest)(observation)
        except UnreadableError:
            with contextlib.suppress(Exception):
                pickle.dumps(observation)  # a random number in it is refused with its line
            raise
        if seen not in self.observations:
            self.observations[seen] = array = self._as_array(observation)
            shown = " ".join(str(observation).split())
            self.shown[seen] = f"observation {shown}" if len(shown) <= _LONGEST_NAME else ""
            self._num_bytes += 0 if array is None else array.nbytes
        if is_over and seen not in self.ends:
            self.ends[seen] = self._named()
        is_end = is_over and (self.is_random or self._branching.has_drawn)
        if is_end and not self._has_new_values():
            return OVER, seen
        try:
            copy = self._snapshots.take()
        except Exception as error:  # whatever the classes in it raise
            raise self.refusal(f"its state cannot be copied: {error}") from error
        if is_end:
            self._not_reset.append(copy)
            return OVER, seen
        short = hashlib.blake2b(copy, digest_size=16).digest()
        if (state := self._by_copy.get(short)) is None:
            key = self._snapshots.key(self.ignore, kinds=True)
            state = self._by_key.get(key) or self._added(key, seen, depth, copy)
            self._by_copy[short] = state
        if state.seen != seen and not self._branching.has_drawn:
            left_out = ", ".join(self.ignore)
            without = f" without {left_out}, which env.ignore leaves out" if left_out else ""
            raise self.refusal(
                f"the same state has different observations, so they are not a function of the state{without}"
            )
        return state.number, seen

    def _added(self, key: bytes, seen: bytes, depth: int, copy: bytes) -> State:
        size, (name, place) = 1 + len(self.states), self._named()
        state = State(size - 1, key, self._snapshots.key(self.ignore), seen, depth, copy, name, place)
        self._by_key[key] = state
        if self._has_new_values():
            self._not_reset.append(copy)
        self.states.append(state)
        self._num_bytes += len(copy)
        if size > self._most_states:
            raise self.refusal(
                f"more than {self._most_states:,} states can be reached, too many to solve, since its "
                f"{self._what_changes()}"
            )
        if self._num_bytes > _MOST_BYTES:
            raise self.refusal(
                f"copies of the first {size:,} states take more than {_MOST_BYTES / 2**30:.0f} GiB"
            )
        check_memory(f"env.id={self.name}", self._num_bytes)
        return state

    def _named(self) -> Named:
        """What a reader calls its state, and its place, by attributes that minigrid's environments have."""
        place, direction = (getattr(self.env, name, None) for name in ("agent_pos", "agent_dir"))
        try:
            column, row = (int(each) for each in place)  # type: ignore[union-attr]
            facing = f"facing {_FACING[direction]}"  # type: ignore[index]
        except (TypeError, ValueError, IndexError):
            return "", None
        if carried := getattr(getattr(self.env, "carrying", None), "type", None):
            facing += f", carrying a {carried}"
        time = "" if "step_count" in self.ignore else f", step {getattr(self.env, 'step_count', '?')}"
        return f"row {row + 1}, column {column + 1}, {facing}{time}", (facing, row, column)

    def _as_array(self, observation: Any) -> NDArray[Any] | None:
        """An observation as an array, of a Dict the `image`; None where there is none."""
        space = self.env.observation_space
        image = space.spaces.get("image") if isinstance(space, spaces.Dict) else None
        part = image if isinstance(image, spaces.Box) else space
        if isinstance(part, spaces.Tuple) and all(isinstance(each, spaces.Discrete) for each in part):
            kind: Any = np.int64
            shape: Any = (len(part.spaces),)
        elif isinstance(part, spaces.Box | spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary):
            kind, shape = part.dtype, part.shape
        else:
            return None
        try:
            array = np.array(observation, kind) if part is space else np.array(observation["image"])
            fits = array.shape == shape and array.dtype.kind in "biuf"
            if isinstance(part, spaces.Discrete):
                fits = fits and bool(part.start <= array < part.start + part.n)
        except (TypeError, ValueError, KeyError, IndexError, OverflowError):
            fits = False
        if not fits:
            raise self.refusal(
                f"an observation is {' '.join(str(observation).split())[:80]}, which is not in its space "
                f"{' '.join(str(space).split())[:120]}"
            )
        return array

    def _what_changes(self) -> str:
        """What has most values, the elapsed time among them, and a remedy, as the rest of a sentence."""
        values: dict[str, set[bytes]] = {}
        for copy in [each.copy for each in self.states[::_SAMPLED] if each.copy][-1000:]:
            self._snapshots.put_back(copy)
            for name, key in self._snapshots.keys(self.ignore).items():
                values.setdefault(name, set()).add(key)
        most = max(map(len, values.values()))
        names = _listed(name for name, found in values.items() if len(found) == most)
        return (
            f"{names} keeps changing; use a smaller one, set a limit (env.kwargs.max_episode_steps), or "
            f"ignore irrelevant attributes, e.g. env.ignore=[{names.split(',')[0]}]"
        )

    def own_limit(self) -> int | None:
        """The time at which the environment itself truncates all episodes, if any."""
        steps = ((each.depth + 1, step) for each in self.states for row in each.steps for step in row)
        truncated: dict[bool, set[int]] = {True: set(), False: set()}  # times of steps that are no end
        for time, step in steps:
            if not step.terminated:
                truncated[step.truncated].add(time)
        if not truncated[True]:
            return None
        limit = min(truncated[True])
        if max(truncated[False], default=0) >= limit:
            raise self.refusal(
                "it truncates some episodes earlier than others, so it has no single step limit"
            )
        return limit

    def action_names(self) -> list[str] | None:
        """The names in an enumeration `actions`, if the environment has one that fits."""
        actions = getattr(self.env, "actions", None)
        if not isinstance(actions, EnumType):
            return None
        names = {member.value: member.name for member in actions}  # type: ignore[var-annotated]
        numbers = range(self.num_actions)
        return [names[number] for number in numbers] if names.keys() >= set(numbers) else None


def _listed(names: Iterable[str]) -> str:
    return ", ".join(sorted(names)) or "nothing"
