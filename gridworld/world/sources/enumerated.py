"""Worlds from Gymnasium environments without a table, enumerated: every action in a copy of every state.

    search    the states and what each action does there; everything that changes is state, the time included
    draws     a generator in place of the environment's own takes every outcome in turn (`world.branching`)
    beliefs   what observations leave open of the state (`sources.beliefs`): the states of the world
    replay    the environment itself beside the table, thousands of steps: any difference is refused

A state is read exactly or refused (`reading`). The search refuses draws from other generators, wherever
the state holds them, spaces and functions that change, and changes outside the attributes. The replay is for
what that may miss, such as attributes that the user told it to leave out, or a wrapper. With attributes that
a user names as no part of a state, the claim rests on that, and `truth` says so.

The step limit is that of the id or the one at which the environment truncates by itself. A state at the limit
is not terminal, since the environment does not say so, but every action stays there and pays nothing.

Its own observation is a table where the observation space is a Box, of whole numbers (Discrete,
MultiDiscrete, MultiBinary, a Tuple of Discrete), or a Dict with a Box `image`, of which this entry is taken,
as minigrid's `ImgObsWrapper` does. An end is a success if it pays more than 0, and if none does, if it pays
best.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import pickle
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import EnumType
from fractions import Fraction
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from gridworld.base.console import telling_if_slow
from gridworld.base.errors import InputError
from gridworld.base.user_input import check_memory
from gridworld.world.branching import Branching
from gridworld.world.mdp import Mdp
from gridworld.world.outcomes import MOST_ACTIONS, MOST_STATES, mdp_from_outcomes
from gridworld.world.reach import Reach
from gridworld.world.reading import UnreadableError, digest
from gridworld.world.snapshots import Snapshots, random_states
from gridworld.world.sources.beliefs import Beliefs, Node, Step, lumped
from gridworld.world.sources.gymnasium_table import compile_gymnasium, has_table, make_env
from gridworld.world.sources.replay import Replay
from gridworld.world.wrappers import refuse_transformed

_BEYOND = 1_000  # states further than a step limit that are found too, so that a small world is whole
_DEEPEST = 10_000  # steps from the start
_MOST_BYTES = 2**31  # of all copies and observations together
_SAMPLED = 16  # of so many states the copy of one is kept, to name what keeps changing
_FACING = ("right", "down", "left", "up")  # minigrid's directions
_METHODS = ("step", "reset")  # what is read of them
_ELSEWHERE = "draws a random number from another generator than self.np_random, so its outcomes are unknown"
_OVER = -1  # in place of the state in which an episode ends, where there is chance
_MOST_RUNS = 10_000_000  # of a step or a reset, some minutes
_WATCHED, _WATCHED_LATER = 100, 1_009  # first runs after which all that is outside is compared; later one of
_LONGEST_NAME = 60  # of a state that is called by its observation


def enumerate_env(
    env_id: str,
    kwargs: Mapping[str, Any] | None = None,
    *,
    ignore: Sequence[str] = (),
    most_states: int = MOST_STATES,
) -> Mdp:
    """Compile an environment by trying every action in a copy of every state, with every draw of `np_random`.

    Args:
        env_id: its registered id.
        kwargs: the arguments of `gymnasium.make`.
        ignore: attributes of the environment that are not part of its state.
        most_states: more are refused as soon as they are found.

    Returns:
        The world; its `truth` is "enumerated, N states", of what, and without which attributes. Its states
        are what a history of observations and rewards leaves open of the environment's own, see `beliefs`.
    """
    with telling_if_slow(f"enumerating {env_id}"):
        env = make_env(env_id, kwargs)
        try:
            search = Search(env_id, env, ignore, most_states)
            limit = None if env.spec is None else env.spec.max_episode_steps
            limit = limit if limit is not None and limit > 0 else None  # -1 is "none" to `gymnasium.make`
            search.explore(limit)
            mdp = search.compiled(limit)
            found_limit = Replay(search, mdp, partial(make_env, env_id, kwargs)).check()
            refuse_transformed(f"env.id={env_id}", env)
        except UnreadableError as error:
            raise InputError(
                f"env.id={env_id}: its state cannot be compared: {error}; hold numbers, lists and numpy "
                "arrays, or name in env.ignore what nothing depends on"
            ) from error
        finally:
            env.close()
    return replace(mdp, max_episode_steps=found_limit)


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


class Search:
    """Finds the states of an environment, those after a reset first, breadth first.

    It is one object, into which copies of its states are put; `ignore` are attributes that are no state.
    """

    def __init__(self, name: str, env: gym.Env[Any, Any], ignore: Sequence[str], most_states: int) -> None:
        self.name, self.ignore, self._most_states = name, tuple(ignore), most_states
        self.states: list[State] = []
        self.observations: dict[bytes, NDArray[Any] | None] = {}  # by their digests
        self._shown: dict[bytes, str] = {}  # the same as short texts
        self._ends: dict[bytes, Named] = {}  # what ends are called, by their observations
        self.is_random = False
        self._env = env.unwrapped
        self._branching = Branching(f"env.id={name}")
        self._snapshots = Snapshots(self._env, self._branching)
        actions = env.action_space
        if not isinstance(actions, spaces.Discrete) or actions.start != 0 or actions.n > MOST_ACTIONS:
            raise self.refusal(
                f"its actions are {actions}, must be Discrete(n), from 0 to {MOST_ACTIONS} - 1"
            )
        self._num_actions = int(actions.n)
        self._by_key: dict[bytes, State] = {}
        self._by_copy: dict[bytes, State] = {}  # by a digest of a copy, of which a state may have several
        self._num_bytes = self._num_runs = 0
        self._outside, self._before = list[Reach](), list[bytes]()

    def refusal(self, reason: str) -> InputError:
        """An error that says why there is no table of it."""
        return InputError(f"env.id={self.name}: {reason}")

    def _prepare(self) -> None:
        """Find the starts, with the generator that branches wherever the environment holds its own."""
        own = self._env.np_random  # it is made when it is first asked for
        self._snapshots.replace(own, self._branching)
        first = self._snapshots.take()  # before the first reset, which may set what others keep
        try:
            self.starts = self._resets(first)
        except InputError:
            self._reached()  # which may name the reason
            raise
        if unknown := [each for each in self.ignore if each not in vars(self._env)]:
            raise InputError(
                f"env.ignore={list(self.ignore)}: {self.name} has no attribute {unknown[0]}; it has "
                f"{', '.join(vars(self._env))}"
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
        self._check_resets(waiting[0])
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
        self._check_resets(next(each for each in reversed(self.states) if each.copy))

    def _reached(self) -> list[Reach]:
        where = f"env.id={self.name}"
        return [Reach(where, self._env, method, [self._branching], skips=True) for method in _METHODS]

    def _check_outside(self) -> None:
        kept = self._snapshots.changed()
        if kept is not None or [each.content(is_outside=True) for each in self._outside] != self._before:
            raise self.refusal(
                f"a step changes {type(kept).__name__ if kept else 'what is outside of its attributes'}, of "
                "which no copies can be made; hold what changes in attributes: numbers, lists, numpy arrays"
            )

    def _resets(self, copy: bytes) -> list[Step]:
        """What a reset leads to from a copy of a state."""

        def reset() -> tuple[int, bytes, float, bool, bool]:
            self._snapshots.put_back(copy)
            try:
                observation, _ = self._env.reset()
            except Exception as error:  # whatever it raises
                raise self.refusal(f"a reset fails: {error}") from error
            if vars(self._env).get("_np_random") is not self._branching:
                raise self.refusal("reset() makes another np_random; leave that to super().reset(seed=seed)")
            return *self._state_after(observation, 0), 0.0, False, False

        with self._no_other_draws("reset"):
            return self._merged(reset)

    def _check_resets(self, state: State) -> None:
        """A reset must lead to the same from every state."""
        size = len(self.states)
        found = self._resets(state.copy)
        if len(self.states) == size and sorted(found) == sorted(self.starts):
            return
        values: list[dict[str, bytes]] = []
        one, other = ({each.following for each in steps} for steps in (self.starts, found))
        for each in (min(one - other or one), min(other - one or other)):
            self._snapshots.put_back(self.states[each].copy)
            values.append(self._snapshots.keys(self.ignore))
        changed = _listed(name for name, each in values[1].items() if each != values[0].get(name))
        raise self.refusal(
            f"a reset does not always lead to the same state (in {changed}), so its states cannot be "
            "enumerated from one start; set all of it in reset(), or list irrelevant attributes in env.ignore"
        )

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
        actions = range(self._num_actions)
        with self._no_other_draws("step"):
            steps = [self._merged(partial(self._stepped, state, action)) for action in actions]
        if state.number.bit_count() == 1:  # 1, 2, 4, 8 ...
            self._check_resets(state)
        if state.number % _SAMPLED:
            self._num_bytes -= len(state.copy)
            state.copy = b""
        return steps

    def _stepped(self, state: State, action: int) -> tuple[int, bytes, float, bool, bool]:
        self._snapshots.put_back(state.copy)
        try:
            observation, reward, terminated, truncated, _ = self._env.step(action)
            shown = float(reward), bool(terminated), bool(truncated)
        except Exception as error:  # whatever it raises
            raise self.refusal(f"a step with action {action} fails: {error}") from error
        if not math.isfinite(shown[0]):
            raise self.refusal(f"a step with action {action} pays {shown[0]}; must be a finite number")
        return *self._state_after(observation, state.depth + 1, is_over=shown[1]), *shown

    def _merged(self, run: Callable[[], tuple[int, bytes, float, bool, bool]]) -> list[Step]:
        """Its different results, each with its probability."""
        sums: dict[tuple[int, bytes, float, bool, bool], Fraction] = {}
        for probability, result in self._branching.outcomes(run):
            sums[result] = sums.get(result, Fraction(0)) + probability
            self._num_runs += 1
            self.is_random |= self._branching.has_drawn
            if self._num_runs <= _WATCHED or not self._num_runs % _WATCHED_LATER:
                self._check_outside()
        if self._num_runs > _MOST_RUNS:
            raise self.refusal(f"its random outcomes are more than {_MOST_RUNS:,}, too many to try them all")
        return [Step(probability, *result) for result, probability in sums.items()]

    def _state_after(self, observation: Any, depth: int, is_over: bool = False) -> tuple[int, bytes]:
        """The number of the state that the environment is in, and a digest of the observation."""
        try:
            seen = digest(observation)
        except UnreadableError:
            with contextlib.suppress(Exception):
                pickle.dumps(observation)  # a random number in it is refused with its line
            raise
        if seen not in self.observations:
            self.observations[seen] = array = self._as_array(observation)
            shown = " ".join(str(observation).split())
            self._shown[seen] = f"observation {shown}" if len(shown) <= _LONGEST_NAME else ""
            self._num_bytes += 0 if array is None else array.nbytes
        if is_over and seen not in self._ends:
            self._ends[seen] = self._named()
        if is_over and self._branching.has_drawn:
            return _OVER, seen
        try:
            copy = self._snapshots.take()
        except Exception as error:  # whatever the classes in it raise
            raise self.refusal(f"its state cannot be copied: {error}") from error
        short = digest(copy)
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
        place, direction = (getattr(self._env, name, None) for name in ("agent_pos", "agent_dir"))
        try:
            column, row = (int(each) for each in place)  # type: ignore[union-attr]
            facing = f"facing {_FACING[direction]}"  # type: ignore[index]
        except (TypeError, ValueError, IndexError):
            return "", None
        if carried := getattr(getattr(self._env, "carrying", None), "type", None):
            facing += f", carrying a {carried}"
        time = "" if "step_count" in self.ignore else f", step {getattr(self._env, 'step_count', '?')}"
        return f"row {row + 1}, column {column + 1}, {facing}{time}", (facing, row, column)

    def _as_array(self, observation: Any) -> NDArray[Any] | None:
        """An observation as an array, of a Dict the `image`; None where there is none."""
        space = self._env.observation_space
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

    def compiled(self, limit: int | None) -> Mdp:
        """The world of what was found; a state in which nothing was tried stays as it is."""
        steps = [each.steps for each in self.states]
        if self.is_random:  # where an episode is over, nothing but the observation matters
            steps = [
                [
                    [each._replace(following=_OVER) if each.terminated else each for each in row]
                    for row in rows
                ]
                for rows in steps
            ]
        # Else, what differs only in the types of numbers counts as one where the steps are the same.
        classes = lumped(steps, [None if self.is_random else each.alike for each in self.states])
        members: dict[int, list[State]] = {}
        for state, number in zip(self.states, classes, strict=True):
            members.setdefault(number, []).append(state)
        self.members = [*(members[number] for number in range(len(members))), []]
        classes.append(len(members))  # what is over, as the last
        first = [
            [
                [each._replace(following=classes[each.following]) for each in row]
                for row in steps[found[0].number]
            ]
            for found in self.members[:-1]
        ]
        starts = [(each.probability, classes[each.following], each.seen) for each in self.starts]
        self.beliefs = beliefs = Beliefs(starts, [*first, []], self.refusal, MOST_STATES)
        limits = [each for each in (self._own_limit(), limit) if each is not None]
        observations = [self.observations[each.seen] for each in beliefs.nodes]
        shown = [each for each in observations if each is not None]
        check_memory(f"env.id={self.name}: its own observations", sum(each.nbytes for each in shown))
        named = [self._name(each) for each in beliefs.nodes]
        found = [place for _, place in named if place is not None]
        panels, places = list(dict.fromkeys(facing for facing, _, _ in found)), None
        if len(found) == len(named):
            places = np.array([(panels.index(facing), row, column) for facing, row, column in found])
            places[:, 1:] -= places[:, 1:].min(axis=0)  # without the walls around the room
        mdp = mdp_from_outcomes(
            self.name,
            beliefs.outcomes(self.name, self._num_actions),
            action_names=self._action_names(),
            places=places,
            panel_names=panels,
            max_episode_steps=min(limits, default=None),
            own_observation=np.stack(shown) if len(shown) == len(named) else None,
        )
        names = tuple(name for name, _ in named)
        return replace(mdp, state_names=names if all(names) else (), truth=self._truth())

    def possible(self, node: Node) -> list[State]:
        """The environment's own states that a belief does not rule out; none where the episode is over."""
        return [state for number, _ in node.belief for state in self.members[number]]

    def _name(self, node: Node) -> Named:
        """What a reader calls a node: as its states, or where there is chance by what is shown there."""
        found = {(each.name, each.place) for each in self.possible(node)} or {self._ends[node.seen]}
        name, place = found.pop() if len(found) == 1 else ("", None)
        return name or (self._shown[node.seen] if self.is_random else ""), place

    def _truth(self) -> str:
        without = f" without {', '.join(self.ignore)}, as you asked" if self.ignore else ""
        size, nodes = len(self.members) - 1, self.beliefs.nodes
        if all(len(each.belief) == 1 for each in nodes):
            found = f"enumerated, {len(nodes):,} states{without}"
        else:
            found = f"enumerated, {len(nodes):,} beliefs about {size:,} hidden states{without}"
        aliased = self.beliefs.num_aliased() if self.is_random else 0
        return f"{found}; {aliased:,} observations stand for several of them" if aliased else found

    def _own_limit(self) -> int | None:
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

    def _action_names(self) -> list[str] | None:
        """The names in an enumeration `actions`, if the environment has one that fits."""
        actions = getattr(self._env, "actions", None)
        if not isinstance(actions, EnumType):
            return None
        names = {member.value: member.name for member in actions}  # type: ignore[var-annotated]
        numbers = range(self._num_actions)
        return [names[number] for number in numbers] if names.keys() >= set(numbers) else None


def _listed(names: Iterable[str]) -> str:
    return ", ".join(sorted(names)) or "nothing"


def compile_id(env_id: str, kwargs: Mapping[str, Any] | None = None) -> Mdp:
    """Compile an environment by its transition table if it has one, else by enumeration."""
    env = make_env(env_id, kwargs)
    env.close()
    return (compile_gymnasium if has_table(env.unwrapped) else enumerate_env)(env_id, kwargs)
