"""Worlds from deterministic Gymnasium environments, enumerated: every action in a copy of every state.

    search    the states and what each action does there; everything that changes is state, the time included
    replay    the environment itself beside the table, thousands of steps: any difference is refused

An enumeration may have missed randomness that no generator of the environment shows, state outside of its
attributes or in those that it was told to leave out, or a wrapper. Whatever changes the walks of an agent
shows up in the replay, if it is met. Attributes that a user names are no part of a state; the claim then
rests on that, and `truth` says so.

The step limit is that of the id or the one at which the environment truncates by itself. A state at the limit
is not terminal, since the environment does not say so, but every action stays there and pays nothing.

Its own observation is a table where the observation space is a Box or Discrete, or a Dict with a Box
`image`, of which this entry is taken, as minigrid's `ImgObsWrapper` does. Elsewhere there is none.

An end is a success if it pays more than 0, and if none does, if it pays best.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from enum import EnumType
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order

from gridworld.errors import InputError
from gridworld.process.console import ProgressLine, printable, telling_if_slow
from gridworld.process.memory_budget import check_memory
from gridworld.world.mdp import Mdp
from gridworld.world.outcomes import MOST_ACTIONS, MOST_STATES, Outcomes, mdp_from_outcomes
from gridworld.world.snapshots import Snapshots, key_of, random_states
from gridworld.world.sources.gymnasium_table import make_env
from gridworld.world.wrappers import refuse_transformed

_BEYOND = 1_000  # states further than a step limit that are found too, so that a small world is whole
_DEEPEST = 10_000  # steps from the start
_MANY_STATES = 20_000  # from which on their number is shown
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
        ignore: attributes of the environment that are no part of its state.
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
            limits = [each for each in (search.own_limit(), limit) if each is not None]
            mdp = search.compiled(min(limits, default=None))
            found_limit = _Replay(search, mdp).check(make_env(env_id, kwargs))
            refuse_transformed(f"env.id={env_id}", env)
        finally:
            env.close()
    return replace(mdp, max_episode_steps=found_limit)


class _Search:
    """The N states of an environment, the start first, found breadth first.

    It is one object, into which copies of its states are put; `ignore` are attributes that are no state.

    Attributes:
        keys: N digests of states.
        seen: N digests of observations.
        next_state, reward, terminated, truncated: (N, A); a state that was not tried leads to itself.
    """

    def __init__(self, name: str, env: gym.Env[Any, Any], ignore: Sequence[str], most_states: int) -> None:
        self.name, self.ignore, self._most_states = name, tuple(ignore), most_states
        self._env = env.unwrapped
        self._snapshots = Snapshots(self._env)
        actions = env.action_space
        if not isinstance(actions, spaces.Discrete) or actions.start != 0 or actions.n > MOST_ACTIONS:
            raise self.refusal(
                f"its actions are {actions}, must be Discrete(n), from 0 to {MOST_ACTIONS} - 1"
            )
        self._num_actions = int(actions.n)
        self.seen: list[bytes] = []
        self._depth: list[int] = []
        self._names: list[str] = []
        self._observations: list[NDArray[Any]] = []
        self._copies: list[bytes] = []
        self._num_bytes = 0
        self._rows: dict[int, list[tuple[int, float, bool, bool]]] = {}
        self._state_of_copy: dict[bytes, int] = {}  # by a digest of a copy, of which a state may have several
        self._state: dict[bytes, int] = {}  # by its key
        self._check_start()
        observation, _ = self._env.reset(seed=0)
        self._pending = [self._state_after(self._copy(), observation, 0)]  # still to be tried
        self._goes_on = set(self._pending)

    def refusal(self, reason: str) -> InputError:
        """An error that says why there is no table of it."""
        return InputError(f"env.id={self.name}: {reason}")

    def _check_start(self) -> None:
        self._env.reset(seed=0)
        if unknown := [each for each in self.ignore if each not in vars(self._env)]:
            raise InputError(
                f"env.ignore={list(self.ignore)}: {self.name} has no attribute {unknown[0]}; it has "
                f"{', '.join(vars(self._env))}"
            )
        key, before = self._key(), self._keys()
        for seed in range(_RESETS):
            self._env.reset(seed=seed)
            if self._key() != key:
                changed = _listed(name for name, each in self._keys().items() if each != before.get(name))
                remedy = self._remedy or (
                    "; take an environment with a fixed layout and start, or name in env.ignore what nothing "
                    "depends on"
                )
                raise self.refusal(
                    f"a reset leads to another state with another seed or at another time (in {changed}), so "
                    f"that its states cannot be enumerated from one start{remedy}"
                )

    @property
    def _remedy(self) -> str:
        return "; it has a transition table, so take env=gymnasium" if hasattr(self._env, "P") else ""

    def _keys(self) -> dict[str, bytes]:
        return {name: key for name, key in self._snapshots.keys().items() if name not in self.ignore}

    def _key(self) -> bytes:
        try:
            return self._snapshots.key(self.ignore)
        except (TypeError, ValueError, RecursionError) as error:
            raise self.refusal(f"its state cannot be compared: {error}") from error

    def _copy(self) -> bytes:
        try:
            return self._snapshots.take()
        except Exception as error:  # whatever the classes in it raise
            raise self.refusal(f"its state cannot be copied: {error}") from error

    def explore(self, limit: int | None) -> None:
        """Find all states that can be reached, and what every action does there.

        Episodes are over at the step limit. What lies beyond it is found too if it is little.
        """
        self._go_on(limit or _DEEPEST)
        if self._pending and limit is None:
            raise self.refusal(
                f"after {_DEEPEST:,} steps there are still new states, since its {self._what_changes()}"
            )
        inside, tried = len(self._depth), set(self._rows)
        if self._pending:
            self._most_states = min(self._most_states, inside + _BEYOND)
            try:
                self._go_on(None)
                inside, tried = len(self._depth), set(self._rows)
            except InputError:
                pass
        self._make_tables(inside, tried)

    def _go_on(self, deepest: int | None) -> None:
        """Try what is pending, and what is found by that; states at the depth `deepest` are left pending."""
        left = []
        line = ProgressLine(True)
        for state in self._pending:  # which grows
            if self._depth[state] == deepest:
                left.append(state)
                continue
            self._rows[state] = self._tried(state)
            for following, _, terminated, truncated in self._rows[state]:
                if not (terminated or truncated or following in self._goes_on):
                    self._goes_on.add(following)
                    self._pending.append(following)
            if state % _SAMPLED:
                self._num_bytes -= len(self._copies[state])
                self._copies[state] = b""
            if len(self._depth) > _MANY_STATES and state % 500 == 0:
                line.show(
                    lambda: (
                        f"enumerating {printable(self.name)}: {len(self._depth):,} states so far, at most "
                        f"{self._most_states:,}; Ctrl-C ends it"
                    )
                )
        line.clear()
        self._pending = left

    def _tried(self, state: int) -> list[tuple[int, float, bool, bool]]:
        """Of each action in a copy of a state: the state that follows, the reward, terminated, truncated."""
        row = []
        copy, before = self._copies[state], random_states(self._env)
        for action in range(self._num_actions):
            self._snapshots.put_back(copy)
            try:
                observation, reward, terminated, truncated, _ = self._env.step(action)
            except Exception as error:  # whatever it raises
                raise self.refusal(f"a step with action {action} fails: {error}") from error
            following = self._state_after(self._copy(), observation, self._depth[state] + 1)
            row.append((following, float(reward), bool(terminated), bool(truncated)))
        if random_states(self._env) != before:
            raise self.refusal(f"a step draws a random number, so it is not deterministic{self._remedy}")
        return row

    def _state_after(self, copy: bytes, observation: Any, depth: int) -> int:
        """The number of the state that the environment is in, of which `copy` is one."""
        short, seen = key_of(copy), key_of(observation)
        state = self._state_of_copy.get(short)
        if state is None:
            state = self._state_of_copy[short] = self._state.setdefault(self._key(), len(self._state))
        if state == len(self._depth):
            self._add(copy, seen, observation, depth)
        elif self.seen[state] != seen:
            left_out = ", ".join(self.ignore)
            without = f" without {left_out}, which env.ignore leaves out" if left_out else ""
            raise self.refusal(
                "the same state is shown by different observations, so that what an agent sees is no "
                f"function of the state{without}"
            )
        return state

    def _add(self, copy: bytes, seen: bytes, observation: Any, depth: int) -> None:
        self._depth.append(depth)
        self._copies.append(copy)
        self.seen.append(seen)
        self._names.append(self._state_name())
        self._num_bytes += len(copy)
        if (array := self._as_array(observation)) is not None:
            self._observations.append(array)
            self._num_bytes += array.nbytes
        size = len(self._depth)
        if size > self._most_states:
            raise self.refusal(
                f"more than {self._most_states:,} states can be reached, and more than that cannot be solved "
                f"for, since its {self._what_changes()}"
            )
        if self._num_bytes > _MOST_BYTES:
            raise self.refusal(
                f"copies of the first {size:,} states take more than {_MOST_BYTES / 2**30:.0f} GiB"
            )
        check_memory(f"env.id={self.name}", self._num_bytes)

    def _state_name(self) -> str:
        """What a reader calls its state, by the attributes that minigrid's environments have; else ""."""
        place, direction = (getattr(self._env, name, None) for name in ("agent_pos", "agent_dir"))
        try:
            (col, row), facing = place, _FACING[direction]  # type: ignore[misc, index]
            name = f"row {int(row) + 1}, column {int(col) + 1}, facing {facing}"
        except (TypeError, ValueError, IndexError):
            return ""
        carried = getattr(getattr(self._env, "carrying", None), "type", None)
        time = "" if "step_count" in self.ignore else f", step {getattr(self._env, 'step_count', '?')}"
        return f"{name}{f', carrying a {carried}' if carried else ''}{time}"

    def _as_array(self, observation: Any) -> NDArray[Any] | None:
        """An observation as an array, of a Dict the `image`; None where there is none."""
        space = self._env.observation_space
        of_image = isinstance(space, spaces.Dict)
        part = space.spaces.get("image") if isinstance(space, spaces.Dict) else space
        if not isinstance(part, spaces.Box if of_image else spaces.Box | spaces.Discrete):
            return None
        try:
            array = np.array(observation["image"]) if of_image else np.array(observation, dtype=space.dtype)
            fits = array.shape == part.shape and array.dtype.kind in "biuf"
            if isinstance(part, spaces.Discrete):
                fits = fits and bool(part.start <= array < part.start + part.n)
        except (TypeError, ValueError, KeyError, IndexError, OverflowError):
            fits = False
        if not fits:
            raise self.refusal(
                f"an observation is {' '.join(str(observation).split())[:80]}, which does not fit its "
                f"space {' '.join(str(space).split())[:120]}"
            )
        return array

    def _what_changes(self) -> str:
        """What has most values, the elapsed time among them, and a remedy, as the rest of a sentence."""
        values: dict[str, set[bytes]] = {}
        for copy in [each for each in self._copies[::_SAMPLED] if each][-1000:]:
            self._snapshots.put_back(copy)
            for name, key in self._keys().items():
                values.setdefault(name, set()).add(key)
        most = max(map(len, values.values()))
        names = _listed(name for name, found in values.items() if len(found) == most)
        return (
            f"{names} keeps changing; take a smaller one, set a limit (env.kwargs.max_episode_steps), or "
            f"leave out what nothing depends on, e.g. env.ignore=[{names.split(',')[0]}]"
        )

    def _make_tables(self, size: int, tried: set[int]) -> None:
        """Of the first `size` states, of which all that were not tried stay where they are."""
        for each in (self._depth, self.seen, self._names, self._observations):
            del each[size:]
        self.keys = list(self._state)[:size]
        self._was_tried = np.isin(np.arange(size), list(tried))
        still = [[(state, 0.0, False, False)] * self._num_actions for state in range(size)]
        rows = [self._rows[state] if state in tried else still[state] for state in range(size)]
        columns = np.array(rows, dtype=np.float64).reshape(size, self._num_actions, 4)
        self.next_state, self.reward = columns[:, :, 0].astype(np.int64), columns[:, :, 1]
        self.terminated, self.truncated = columns[:, :, 2] > 0, columns[:, :, 3] > 0

    def own_limit(self) -> int | None:
        """The time at which the environment itself truncates all episodes, if any."""
        times = np.broadcast_to(np.array(self._depth)[:, None] + 1, self.truncated.shape)
        truncating = self.truncated & ~self.terminated
        if not truncating.any():
            return None
        limit = int(times[truncating].min())
        if (self.truncated != (times >= limit))[self._was_tried[:, None] & ~self.terminated].any():
            raise self.refusal(
                "it truncates some episodes earlier than others, which no step limit of the world says"
            )
        return limit

    def compiled(self, limit: int | None) -> Mdp:
        """The world of the tables."""
        observations = None
        if self._observations:
            size = len(self.keys) * self._observations[0].nbytes
            check_memory(f"env.id={self.name}: its own observations", size)
            observations = np.stack(self._observations)
        paid = self.terminated & (self.reward > 0)
        mdp = mdp_from_outcomes(
            self.name,
            Outcomes(
                next_state=self.next_state[:, :, None],
                probability=np.ones((*self.next_state.shape, 1)),
                reward=self.reward[:, :, None],
                terminated=self.terminated[:, :, None],
                start=np.eye(1, len(self.next_state))[0],
                success=paid[:, :, None] if paid.any() else None,
            ),
            action_names=self._action_names(),
            max_episode_steps=limit,
            own_observation=observations,
        )
        without = f" without {', '.join(self.ignore)} as told" if self.ignore else ""
        return replace(
            mdp,
            state_names=tuple(self._names) if self._names[0] else (),
            truth=f"enumerated, {mdp.num_states:,} states{without}",
        )

    def _action_names(self) -> list[str] | None:
        """The names in an enumeration `actions`, if the environment has one that fits."""
        actions = getattr(self._env, "actions", None)
        if not isinstance(actions, EnumType):
            return None
        names = {member.value: member.name for member in actions}  # type: ignore[var-annotated]
        numbers = range(self._num_actions)
        return [names[number] for number in numbers] if names.keys() >= set(numbers) else None


def _listed(names: Any) -> str:
    return ", ".join(sorted(names)) or "nothing"


class _Replay:
    """Walks through an environment that must be those of its table."""

    def __init__(self, search: _Search, mdp: Mdp) -> None:
        self._search, self._mdp = search, mdp
        self._random = np.random.default_rng(_SEED)
        self._limit = mdp.max_episode_steps
        origins = np.repeat(np.arange(mdp.num_states), mdp.num_actions)
        leads = np.ones(len(origins)), (origins, mdp.next_state.ravel())
        self._moves = csr_array(leads, shape=(mdp.num_states, mdp.num_states))

    def check(self, env: gym.Env[Any, Any]) -> int | None:
        """Walk a new environment, with the wrappers of its id, to states drawn at random, and close it.

        Returns the step limit: the table's, or what the walks found.
        """
        snapshots = Snapshots(env.unwrapped)
        steps = episodes = 0
        try:
            while steps < _STEPS or episodes < _EPISODES:
                most = _LONGEST if self._search.ignore and not episodes else _LONG
                steps += self._episode(env, snapshots, most, episodes % 3 * _AT_RANDOM)
                episodes += 1
        finally:
            env.close()
        return self._limit

    def _episode(self, env: gym.Env[Any, Any], snapshots: Snapshots, most: int, at_random: int) -> int:
        """Walk to one state after the other, with random steps between, until it ends; the steps."""
        mdp, state, steps = self._mdp, int(self._mdp.start_states[0]), 0
        observation, _ = env.reset(seed=int(self._random.integers(2**31)))
        self._compare_state(snapshots, steps, observation, state)
        actions: list[int] = []
        while steps < most and not mdp.terminal[state]:
            if not actions:
                actions = self._way_from(state)
                actions += self._random.integers(mdp.num_actions, size=at_random).tolist()
            action = actions.pop(0)
            observation, reward, terminated, truncated, _ = env.step(action)
            steps += 1
            self._compare("reward", steps, float(reward), float(mdp.reward[state, action, 0]))
            state = int(mdp.next_state[state, action, 0])
            cut = bool(truncated and not terminated)
            if cut and self._limit is None and self._search.ignore:
                self._limit = steps
            over = bool(mdp.terminal[state])
            expected = [over, steps >= (self._limit or np.inf) and not over]
            self._compare("end (terminated, truncated)", steps, [bool(terminated), cut], expected)
            self._compare_state(snapshots, steps, observation, state)
            if cut:
                break
        return steps

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

    def _compare_state(self, snapshots: Snapshots, steps: int, observation: Any, state: int) -> None:
        number = self._mdp.number[state]
        found = snapshots.key(self._search.ignore), key_of(observation)
        self._compare("state", steps, found, (self._search.keys[number], self._search.seen[number]))

    def _compare(self, what: str, steps: int, found: Any, expected: Any) -> None:
        if found != expected:
            shown = f" ({found}, enumerated as {expected})" if what != "state" else ""
            left_out = ", ".join(self._search.ignore)
            depends = f"depends on {left_out}, which env.ignore leaves out, " if left_out else ""
            raise self._search.refusal(
                f"after {steps} steps of an episode its {what} is not the enumerated one{shown}, so it "
                f"{depends}is random, has state outside of its attributes, or a wrapper that changes it"
            )
