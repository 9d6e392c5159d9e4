"""Worlds from deterministic Gymnasium environments, enumerated: every action in a copy of every state.

    search    the states and what each action does there; everything that changes is state, the time included
    replay    the environment itself beside the table, thousands of steps: any difference is refused

A state is read exactly or refused (`reading`). The search refuses generators that a step draws from, wherever
the state holds them, spaces and functions that change, and changes outside the attributes. The replay is for
what that may miss, such as attributes that the user told it to leave out, or a wrapper. With attributes that
a user names as no part of a state, the claim rests on that, and `truth` says so.

The step limit is that of the id or the one at which the environment truncates by itself. A state at the limit
is not terminal, since the environment does not say so, but every action stays there and pays nothing.

Its own observation is a table where the observation space is a Box or Discrete, or a Dict with a Box
`image`, of which this entry is taken, as minigrid's `ImgObsWrapper` does. An end is a success if it pays more
than 0, and if none does, if it pays best.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import EnumType
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order

from gridworld.base.console import telling_if_slow
from gridworld.base.errors import InputError
from gridworld.base.user_input import check_memory
from gridworld.world.mdp import BoolArray, Mdp
from gridworld.world.outcomes import MOST_ACTIONS, MOST_STATES, Outcomes, mdp_from_outcomes
from gridworld.world.reach import Reach
from gridworld.world.reading import UnreadableError, digest
from gridworld.world.snapshots import Snapshots, random_states
from gridworld.world.sources.gymnasium_table import make_env
from gridworld.world.wrappers import refuse_transformed

_BEYOND = 1_000  # states further than a step limit that are found too, so that a small world is whole
_DEEPEST = 10_000  # steps from the start
_MOST_BYTES = 2**31  # of all copies and observations together
_SAMPLED = 16  # of so many states the copy of one is kept, to name what keeps changing
_FACING = ("right", "down", "left", "up")  # minigrid's directions
_RESETS = 8  # that must lead to the same state
_STEPS, _EPISODES = 3_000, 5  # of the replay, at least
_LONGEST = 10_000  # steps of its first episode where the time may be left out; who cuts later has no limit
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
        ignore: attributes of the environment that are not part of its state.
        most_states: more are refused as soon as they are found.

    Returns:
        The world; its `truth` is "enumerated, N states", and without which attributes.
    """
    with telling_if_slow(f"enumerating {env_id}"):
        env = make_env(env_id, kwargs)
        try:
            search = _Search(env_id, env, ignore, most_states)
            limit = None if env.spec is None else env.spec.max_episode_steps
            limit = limit if limit is not None and limit > 0 else None  # -1 is "none" to `gymnasium.make`
            search.explore(limit)
            mdp = search.compiled(limit)
            found_limit = _Replay(search, mdp, make_env(env_id, kwargs)).check()
            refuse_transformed(f"env.id={env_id}", env)
        except UnreadableError as error:
            raise InputError(
                f"env.id={env_id}: its state cannot be compared: {error}; hold numbers, lists and numpy "
                "arrays, or name in env.ignore what nothing depends on"
            ) from error
        finally:
            env.close()
    return replace(mdp, max_episode_steps=found_limit)


class _Step(NamedTuple):
    """What an action does: the number of the state that follows, and what the environment returns."""

    following: int
    reward: float
    terminated: bool
    truncated: bool


@dataclass
class _State:
    number: int
    key: bytes
    seen: bytes  # a digest of its observation
    depth: int  # steps from the start
    copy: bytes  # b"" where it is no longer needed
    name: str
    place: tuple[str, int, int] | None  # which way the agent faces, row and column
    observation: NDArray[Any] | None
    is_open: bool = False  # an episode goes on in it
    steps: Sequence[_Step] = ()  # of each action; empty where none was tried


class _Search:
    """Finds the states of an environment, the start first, breadth first.

    It is one object, into which copies of its states are put; `ignore` are attributes that are no state.
    """

    def __init__(self, name: str, env: gym.Env[Any, Any], ignore: Sequence[str], most_states: int) -> None:
        self.name, self.ignore, self._most_states = name, tuple(ignore), most_states
        self.states: list[_State] = []
        self._env = env.unwrapped
        self._snapshots = Snapshots(self._env)
        actions = env.action_space
        if not isinstance(actions, spaces.Discrete) or actions.start != 0 or actions.n > MOST_ACTIONS:
            raise self.refusal(
                f"its actions are {actions}, must be Discrete(n), from 0 to {MOST_ACTIONS} - 1"
            )
        self._num_actions = int(actions.n)
        self._by_key: dict[bytes, _State] = {}
        self._by_copy: dict[bytes, _State] = {}  # by a digest of a copy, of which a state may have several
        self._num_bytes = 0
        self._check_start()

    def refusal(self, reason: str) -> InputError:
        """An error that says why there is no table of it."""
        return InputError(f"env.id={self.name}: {reason}")

    def _check_start(self) -> None:
        self._env.reset(seed=0)
        assert self._env.np_random is not None  # it is made when it is first asked for
        if unknown := [each for each in self.ignore if each not in vars(self._env)]:
            raise InputError(
                f"env.ignore={list(self.ignore)}: {self.name} has no attribute {unknown[0]}; it has "
                f"{', '.join(vars(self._env))}"
            )
        key, before = self._snapshots.key(self.ignore), self._snapshots.keys(self.ignore)
        for seed in range(_RESETS):
            self._env.reset(seed=seed)
            if self._snapshots.key(self.ignore) != key:
                now = self._snapshots.keys(self.ignore)
                changed = _listed(name for name, each in now.items() if each != before.get(name))
                remedy = self._remedy or (
                    "; use an environment with a fixed layout and start, or list irrelevant attributes in "
                    "env.ignore"
                )
                raise self.refusal(
                    f"a reset does not always lead to the same state (in {changed}), so its states cannot "
                    f"be enumerated from one start{remedy}"
                )

    @property
    def _remedy(self) -> str:
        return "; it has a transition table, so use env=gymnasium" if hasattr(self._env, "P") else ""

    def explore(self, limit: int | None) -> None:
        """Find all states that can be reached, and what every action does there.

        Episodes are over at the step limit. What lies beyond it is kept too if it is little.
        """
        observation, _ = self._env.reset(seed=0)
        outside = Reach(f"env.id={self.name}", self._env, "step", skips=True)
        before = outside.content(is_outside=True)
        start = self._state_after(observation, 0)
        start.is_open = True
        waiting, size = [start], 0
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
            for step in state.steps:
                following = self.states[step.following]
                if not (step.terminated or step.truncated or following.is_open):
                    following.is_open = True
                    waiting.append(following)
        kept = self._snapshots.changed()
        if kept is not None or outside.content(is_outside=True) != before:
            raise self.refusal(
                f"a step changes {type(kept).__name__ if kept else 'what is outside of its attributes'}, of "
                "which no copies can be made; hold what changes in attributes: numbers, lists, numpy arrays"
            )

    def _tried(self, state: _State) -> list[_Step]:
        """What each action does in a copy of a state."""
        steps, before = [], (self._snapshots.random_states(), random_states())
        for action in range(self._num_actions):
            self._snapshots.put_back(state.copy)
            try:
                observation, reward, terminated, truncated, _ = self._env.step(action)
            except Exception as error:  # whatever it raises
                raise self.refusal(f"a step with action {action} fails: {error}") from error
            following = self._state_after(observation, state.depth + 1)
            steps.append(_Step(following.number, float(reward), bool(terminated), bool(truncated)))
        if (self._snapshots.random_states(), random_states()) != before:
            raise self.refusal(f"a step draws a random number, so it is not deterministic{self._remedy}")
        if state.number % _SAMPLED:
            self._num_bytes -= len(state.copy)
            state.copy = b""
        return steps

    def _state_after(self, observation: Any, depth: int) -> _State:
        """The state that the environment is in."""
        try:
            copy = self._snapshots.take()
        except Exception as error:  # whatever the classes in it raise
            raise self.refusal(f"its state cannot be copied: {error}") from error
        short, seen = digest(copy), digest(observation)
        if (state := self._by_copy.get(short)) is None:
            key = self._snapshots.key(self.ignore)
            state = self._by_key.get(key) or self._added(key, seen, depth, copy, observation)
            self._by_copy[short] = state
        if state.seen != seen:
            left_out = ", ".join(self.ignore)
            without = f" without {left_out}, which env.ignore leaves out" if left_out else ""
            raise self.refusal(
                f"the same state has different observations, so they are not a function of the state{without}"
            )
        return state

    def _added(self, key: bytes, seen: bytes, depth: int, copy: bytes, observation: Any) -> _State:
        array, size = self._as_array(observation), 1 + len(self.states)
        state = _State(size - 1, key, seen, depth, copy, *self._named(), array)
        self._by_key[key] = state
        self.states.append(state)
        self._num_bytes += len(copy) + (0 if array is None else array.nbytes)
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

    def _named(self) -> tuple[str, tuple[str, int, int] | None]:
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
        if not isinstance(part, spaces.Box | spaces.Discrete):
            return None
        try:
            array = np.array(observation, part.dtype) if part is space else np.array(observation["image"])
            fits = array.shape == part.shape and array.dtype.kind in "biuf"
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
        stay = [[_Step(each.number, 0.0, False, False)] * self._num_actions for each in self.states]
        rows = [each.steps or still for each, still in zip(self.states, stay, strict=True)]
        columns = np.array(rows, dtype=np.float64)  # (N, A, 4)
        reward, terminated, truncated = columns[:, :, 1], columns[:, :, 2] > 0, columns[:, :, 3] > 0
        limits = [each for each in (self._own_limit(terminated, truncated), limit) if each is not None]
        paid = terminated & (reward > 0)
        observations = [each.observation for each in self.states if each.observation is not None]
        found = [each.place for each in self.states if each.place is not None]
        panels, places = list(dict.fromkeys(facing for facing, _, _ in found)), None
        if len(found) == len(self.states):
            places = np.array([(panels.index(facing), row, column) for facing, row, column in found])
            places[:, 1:] -= places[:, 1:].min(axis=0)  # without the walls around the room
        check_memory(f"env.id={self.name}: its own observations", sum(each.nbytes for each in observations))
        mdp = mdp_from_outcomes(
            self.name,
            Outcomes(
                next_state=columns[:, :, 0].astype(np.int64)[:, :, None],
                probability=np.ones((*reward.shape, 1)),
                reward=reward[:, :, None],
                terminated=terminated[:, :, None],
                start=np.eye(1, len(rows))[0],
                success=paid[:, :, None] if paid.any() else None,
            ),
            action_names=self._action_names(),
            places=places,
            panel_names=panels,
            max_episode_steps=min(limits, default=None),
            own_observation=np.stack(observations) if observations else None,
        )
        names = tuple(each.name for each in self.states)
        without = f" without {', '.join(self.ignore)}, as you asked" if self.ignore else ""
        truth = f"enumerated, {mdp.num_states:,} states{without}"
        return replace(mdp, state_names=names if names[0] else (), truth=truth)

    def _own_limit(self, terminated: BoolArray, truncated: BoolArray) -> int | None:
        """The time at which the environment itself truncates all episodes, if any."""
        time = np.array([[each.depth + 1] * self._num_actions for each in self.states])
        tried = np.array([[bool(each.steps)] for each in self.states])
        if not (truncated & ~terminated).any():
            return None
        limit = int(time[truncated & ~terminated].min())
        if ((truncated != (time >= limit)) & tried & ~terminated).any():
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


class _Replay:
    """Walks through an environment that must be those of its table."""

    def __init__(self, search: _Search, mdp: Mdp, env: gym.Env[Any, Any]) -> None:
        self._search, self._mdp, self._limit = search, mdp, mdp.max_episode_steps
        self._random = np.random.default_rng(_SEED)
        self._env, self._snapshots = env, Snapshots(env.unwrapped)
        self._steps = 0  # of this episode
        origins = np.repeat(np.arange(mdp.num_states), mdp.num_actions)
        leads = np.ones(len(origins)), (origins, mdp.next_state.ravel())
        self._moves = csr_array(leads, shape=(mdp.num_states, mdp.num_states))

    def check(self) -> int | None:
        """Walk the new environment, with the wrappers of its id, to states drawn at random, and close it.

        Returns the step limit: the table's, or what the walks found.
        """
        steps = episodes = 0
        try:
            while steps < _STEPS or episodes < _EPISODES:
                most = _LONGEST if self._search.ignore and not episodes else _LONG
                self._walk(most, episodes % 3 * _AT_RANDOM)
                steps, episodes = steps + self._steps, episodes + 1
        finally:
            self._env.close()
        return self._limit

    def _walk(self, most: int, at_random: int) -> None:
        """Walk to one state after the other, with random steps between, until the episode ends."""
        mdp, state, actions = self._mdp, int(self._mdp.start_states[0]), list[int]()
        observation, _ = self._env.reset(seed=int(self._random.integers(2**31)))
        self._steps, truncated = 0, False
        self._compare_state(observation, state)
        while self._steps < most and not mdp.terminal[state] and not truncated:
            if not actions:
                actions = self._way_from(state)
                actions += self._random.integers(mdp.num_actions, size=at_random).tolist()
            action = actions.pop(0)
            observation, reward, terminated, truncated, _ = self._env.step(action)
            self._steps += 1
            self._compare("reward", float(reward), float(mdp.reward[state, action, 0]))
            state = int(mdp.next_state[state, action, 0])
            truncated = bool(truncated and not terminated)
            if truncated and self._limit is None and self._search.ignore:
                self._limit = self._steps
            is_end = bool(mdp.terminal[state])
            is_cut = not is_end and self._limit is not None and self._steps >= self._limit
            self._compare("end (terminated, truncated)", [bool(terminated), truncated], [is_end, is_cut])
            self._compare_state(observation, state)

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

    def _compare_state(self, observation: Any, state: int) -> None:
        expected = self._search.states[self._mdp.number[state]]
        found = self._snapshots.key(self._search.ignore), digest(observation)
        self._compare("state", found, (expected.key, expected.seen))

    def _compare(self, what: str, found: Any, expected: Any) -> None:
        if found != expected:
            shown = f" ({found}, enumerated as {expected})" if what != "state" else ""
            left_out = ", ".join(self._search.ignore)
            depends = f"depends on {left_out}, which env.ignore leaves out, " if left_out else ""
            raise self._search.refusal(
                f"after {self._steps} steps of an episode its {what} is not the enumerated one{shown}, so "
                f"it {depends}is random, has state outside its attributes, or has a wrapper that changes it"
            )
