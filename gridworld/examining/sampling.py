"""What is seen of an environment: sampled episodes, and the same actions replayed with seeds that are known.

Episodes have actions at random, held for a while, or always the same, so that the ends that a random policy
hardly comes to are seen too. A replay seeds the generators of `random` and `numpy.random` as well: who then
repeats with one seed and not with another draws from them.
"""

from __future__ import annotations

import copy
import itertools
import random
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from gridworld.base.errors import in_short
from gridworld.world.door.attributes import (
    GENERATORS,
    differing,
    generators_of,
    held_by,
    holders_of,
    innermost,
    is_plain,
    layers_of,
    own_spaces,
    random_states,
    spaces_in,
    state_of,
)
from gridworld.world.door.world import contents
from gridworld.world.mdp import BoolArray, FloatArray, IntArray
from gridworld.world.shown import content

Env = gym.Env[Any, Any]
Play = list[tuple[bytes, float, bool, bool]]  # observation, reward, terminated, truncated; of reset first
Held = tuple[dict[str, bytes], dict[str, bytes]]  # the content of attributes, and of what is held in them
LONGEST = 5_000  # steps of an episode, then it is given up
SEEDS = range(3)  # of replays
_HORIZON = 100  # steps of a replay
_POOL = 8  # actions that are held and repeated
_MOST_HELD = 12  # steps for which one is held
_WATCHED = 300  # first steps, in which returned arrays and generators are watched
_MOST_NUMBERS = 256  # of an observation; more, as of an image, are not looked at
_SECONDS = 15.0  # for the sample
_REPLAYED = 10.0  # seconds, for the replays; fewer steps where that is not enough
_MOST_SEEDS, _DOUBTED = 60, 2.0  # of replays, and more seconds, while no action does anything
_ENDED, _TRIES = 3.0, 20  # seconds and episodes, for those that end as some of the sample did
_ITS = "its generator"


@dataclass
class Steps:
    """Sampled steps, in order; observations and actions by numbers."""

    episode: IntArray
    time: IntArray  # steps before, in the episode
    before: IntArray  # the observation acted on
    action: IntArray
    reward: FloatArray
    after: IntArray
    terminated: BoolArray
    truncated: BoolArray
    at_random: BoolArray  # whether all actions of the episode are independent and uniform
    vectors: FloatArray | None  # (observations, d), the numbers in their boxes
    outside: dict[int, str]  # observations that are not in their space, and why
    changed: int  # arrays that the next step changed, of the first that were returned
    draws: bool  # whether a step changed the state of a random generator
    failure: str  # what a step raised, if one did
    mistyped: str  # what is wrong with the type of a flag
    acts: list[Any]  # the actions by their numbers
    # Of observations that SB3 takes for images, by their names, the largest numbers, also below 255.
    pixels: dict[str, set[int]]

    @property
    def last(self) -> IntArray:
        """The last step of each episode."""
        return np.flatnonzero(np.append(np.diff(self.episode) != 0, True))

    @property
    def first(self) -> IntArray:
        """The first step of each episode."""
        return np.flatnonzero(self.time == 0)


@dataclass
class Replays:
    """What replays of the same actions say; `plays` are of other actions, by the seed, for comparison."""

    repeats: bool = True
    causes: list[str] = field(default_factory=list)  # what it draws from besides `np_random`
    survivors: list[str] = field(default_factory=list)  # attributes that a reset does not restore
    after: str = "other"  # the episodes after which it does not
    shared: list[str] = field(default_factory=list)  # attributes that another environment changes
    plays: list[list[Play]] = field(default_factory=list)

    @property
    def does_nothing(self) -> bool:
        """Whether no action does anything: with each seed, all plays are the same."""
        return bool(self.plays) and all(play == each[0] for each in self.plays for play in each)


class Actions:
    """Actions of a space, with a generator of its own."""

    def __init__(self, space: gym.Space[Any], seed: int) -> None:
        self._space = copy.deepcopy(space)
        seed = int(np.random.SeedSequence((seed, 1)).generate_state(1)[0])  # `reset` gets the seed itself
        self._space.seed(seed)
        if isinstance(space, spaces.Discrete):
            self.pool = [space.start + index for index in range(min(int(space.n), _POOL))]
        else:
            self.pool = [self._space.sample() for _ in range(_POOL)]
            if isinstance(space, spaces.Box):
                ends = [np.clip(bound, -1e3, 1e3).astype(space.dtype) for bound in (space.low, space.high)]
                self.pool[:2] = ends
        self._draw = np.random.default_rng(seed)

    def of_episode(self, number: int) -> Iterator[Any]:
        """The actions of an episode: of every six, three at random; one each of the pool, held, constant."""
        kind, held = number % 6, 0
        action = self.pool[number // 6 % len(self.pool)]
        while True:
            if kind % 2 == 0:
                action = self._space.sample()
            elif kind == 1 or (kind == 3 and held == 0):
                action = self.pool[self._draw.integers(len(self.pool))]
                held = int(self._draw.integers(1, _MOST_HELD))
            held -= 1
            yield action


@contextmanager
def generators_restored(env: Any) -> Iterator[None]:
    """Leave the generators that all share, and those of an environment's spaces, as they were."""
    states, layers = (random.getstate(), np.random.get_state()), layers_of(env)
    own = [(each, vars(each).get("_np_random")) for layer in layers for each in spaces_in(own_spaces(layer))]
    try:
        yield
    finally:
        random.setstate(states[0])
        np.random.set_state(states[1])
        for space, generator in own:
            vars(space)["_np_random"] = generator


def sample(env: Env, actions: Actions, most: int, seed: int) -> Steps:
    """Take about so many steps, with one seed for everything; what a space draws differs from `actions`."""
    seed_all(env, seed + 1)
    rows: list[tuple[Any, ...]] = []
    numbers: dict[bytes, int] = {}
    acts: dict[bytes, int] = {}
    taken_acts: list[Any] = []
    vectors: list[FloatArray | None] = []
    outside: dict[int, str] = {}
    changed, draws, failure, mistyped, episode, until = 0, False, "", "", 0, time.monotonic() + _SECONDS
    pixels: dict[str, set[int]] = {}

    def number(observation: Any, key: bytes) -> int:
        if key not in numbers:
            numbers[key] = len(numbers)
            if reason := _outside(env.observation_space, observation):
                outside[numbers[key]] = reason
            parts = [*parts_of(env.observation_space, observation)]
            vectors.append(_vector(parts))
            for name, space, part in parts:
                if is_image(space) and isinstance(part, np.ndarray):
                    lower = np.max(part, initial=0, where=part < 255)
                    pixels.setdefault(name, set()).update((int(lower), int(np.max(part, initial=0))))
        return numbers[key]

    while len(rows) < most and time.monotonic() < until and not failure:
        action: Any = None
        taken = 0
        try:
            observation, _ = env.reset(seed=seed if episode == 0 else None)
            key = content(observation)
            generators = all_generators(env)[2:] if len(rows) < _WATCHED else []
            for taken, action in enumerate(actions.of_episode(episode)):
                before = number(observation, key)
                states = _states(env, generators) if len(rows) < _WATCHED else None
                after, reward, terminated, truncated, _ = env.step(copy.copy(action))
                if states is not None:
                    draws |= states != _states(env, generators)
                    changed += content(observation) != key
                observation, key = after, content(after)
                mistyped = mistyped or _mistyped(terminated, truncated)
                ends = bool(terminated), bool(truncated)
                act = acts.setdefault(content(action), len(acts))
                taken_acts += [action] * (act == len(taken_acts))
                row = (episode, taken, before, act, float(reward), number(after, key), *ends)
                rows.append((*row, episode % 2 == 0))
                if any(ends) or taken + 1 >= LONGEST:
                    break
        except Exception as error:  # the environment may be anybody's
            failure = f"step {taken + 1} of an episode, with action {action}, raises {in_short(error)}"
        episode += 1
    names = ("episode", "time", "before", "action", "reward", "after", "terminated", "truncated", "at_random")
    kinds = [*[np.int64] * 4, np.float64, np.int64, *[np.bool_] * 3]
    columns: Any = zip(*rows, strict=True) if rows else [()] * len(names)
    arrays: Any = {name: np.array(each, kind) for name, kind, each in zip(names, kinds, columns, strict=True)}
    known = [each for each in vectors if each is not None]
    alike = len(known) == len(vectors) and len({each.shape for each in known}) == 1
    return Steps(
        **arrays,
        vectors=np.array(known) if alike else None,
        outside=outside,
        changed=changed,
        draws=draws,
        failure=failure,
        mistyped=mistyped,
        acts=taken_acts,
        pixels=pixels,
    )


def replays(make: Callable[[], Env], actions: Actions, sampled: Steps, rate: float) -> Replays:
    """Replay actions in one environment, in a new one, and with other seeds of what it draws from."""
    found, drawn = Replays(), set[str]()
    steps = int(np.clip(_REPLAYED * rate / (len(SEEDS) * (6 * 3 + _POOL)), 5, _HORIZON))
    lists = [list(itertools.islice(actions.of_episode(kind), steps)) for kind in (0, 1, 3)]

    def plays(env: Env, which: Sequence[list[Any]], other: str = "") -> list[list[Play]]:
        return [[_play(env, each, seed, drawn, other) for each in which] for seed in SEEDS]

    env = make()
    base, again, new = plays(env, lists), plays(env, lists), plays(make(), lists)
    found.causes = [name for name in sorted(drawn) if plays(make(), lists, name) != new]
    if base != again or base != new:
        if new == plays(make(), lists):
            found.survivors = _survivors(make(), env)
        else:  # made or drawn from as the environment is made, or by a reset
            own = [name for name, _ in all_generators(env) if name.startswith(_ITS)]
            found.causes += [name for name in own if name not in found.causes]
    elif not found.causes:
        found.shared = _shared(make, lists[0], base[0][0])
        _try_ends(found, make, sampled, _ENDED * rate, (lists[0], base[0][0]))
    found.repeats = base == again == new and not found.causes and not found.survivors
    if base == new:
        held = [[action] * steps for action in actions.pool]
        found.plays = [one + two for one, two in zip(base, plays(make(), held), strict=True)]
        env, until = make(), time.monotonic() + _DOUBTED
        while found.does_nothing and len(found.plays) < _MOST_SEEDS and time.monotonic() < until:
            found.plays.append([_play(env, each, len(found.plays), drawn) for each in [*lists, *held]])
    return found


def _try_ends(found: Replays, make: Callable[[], Env], sampled: Steps, left: float, usual: Any) -> None:
    """Look for what a reset does not restore after episodes that end as some of the sample did."""
    for name in ("truncated", "terminated"):
        ends = sampled.last[getattr(sampled, name)[sampled.last]]
        ends = ends[np.unique(sampled.after[ends], return_index=True)[1]]
        for end in ends[np.argsort(sampled.time[ends], kind="stable")][:_TRIES].tolist():
            begin = end - int(sampled.time[end])
            if (left := left - (end - begin)) < 0:
                return
            actions = [sampled.acts[act] for act in sampled.action[begin : end + 1]]
            used, same = make(), make()
            for env in (used, same):
                _play(env, actions, begin, set())
            if _play(used, usual[0], SEEDS[0], set()) != usual[1]:
                found.survivors, found.after = _survivors(make(), same), name
                return


def _survivors(fresh: Env, used: Env) -> list[str]:
    """The attributes that a reset leaves as an earlier episode made them; "" for one that is not found."""

    def held(env: Env) -> Held:
        seed_all(env, 1)
        env.reset(seed=SEEDS[0])
        return _held(env)

    return _changed(lambda: held(fresh), lambda: held(used))


def _shared(make: Callable[[], Env], actions: list[Any], usual: Play) -> list[str]:
    """The attributes of an environment that another one changes; none where an episode stays as it is."""
    env, other = make(), make()

    def after_another() -> Held:
        _play(other, actions, SEEDS[1], set())
        return _held(env)

    if _play(env, actions, SEEDS[0], set(), beside=other) == usual:
        return []
    return _changed(lambda: _held(env), after_another)


def _held(env: Env) -> Held:
    inner = {name: content(each) for name, each in held_by(env.unwrapped) if is_plain(each)}
    return contents(env.unwrapped), inner


def _changed(before: Callable[[], Held], after: Callable[[], Held]) -> list[str]:
    """The names of what an environment holds that differ; "" where none is found."""
    try:
        names, inner = map(differing, before(), after())
    except Exception:  # whatever cannot be copied
        return [""]
    return innermost(names, inner) or [""]


def _play(
    env: Env, actions: Sequence[Any], seed: int, drawn: set[str], other: str = "", beside: Env | None = None
) -> Play:
    """Play with known seeds, of the generator `other` with another; `drawn` gets those that it draws from.

    An environment `beside` it begins an episode before each step.
    """
    generators = seed_all(env, 1, other)
    before = [_state(each) for _, each in generators]
    observation, _ = env.reset(seed=seed)
    found: Play = [(content(observation), 0.0, False, False)]
    for action in actions:
        if beside is not None:
            beside.reset(seed=SEEDS[1])
            beside.step(copy.copy(action))
        observation, reward, terminated, truncated, _ = env.step(copy.copy(action))
        found.append((content(observation), float(reward), bool(terminated), bool(truncated)))
        if terminated or truncated:
            break
    drawn |= {name for (name, each), then in zip(generators, before, strict=True) if _state(each) != then}
    return found


def all_generators(env: Env) -> list[tuple[str, Any]]:
    """The generators that an environment may draw from besides `np_random`, or spaces, with their names."""
    everybodys: Any = (random.seed, np.random.get_state)
    names = ("the module random", "numpy.random")
    found = [(name, method.__self__) for name, method in zip(names, everybodys, strict=True)]
    for layer in layers_of(env):
        held = [(f"{_ITS} {name}", each) for name, each in held_by(layer) if name != "_np_random"]
        held += generators_of(holders_of(type(layer).__mro__))
        found += [(name, each) for name, each in held if type(each) in GENERATORS]
        for name in ("action_space", "observation_space"):
            found += [(f"{name}.sample()", each) for each in spaces_in([getattr(layer, name, None)])]
    return found


def seed_all(env: Env, seed: int, other: str = "") -> list[tuple[str, Any]]:
    """Seed `all_generators`, `other` with another seed."""
    found = all_generators(env)
    for name, each in found:
        own = seed + (name == other)
        if isinstance(each, np.random.Generator):
            kind: Any = type(each.bit_generator)
            each.bit_generator.state = kind(own).state
        else:
            each.seed(own)
    return found


def _state(generator: Any) -> bytes:
    return state_of(generator.np_random if isinstance(generator, gym.Space) else generator)


def _states(env: Env, generators: Sequence[tuple[str, Any]]) -> list[Any]:
    return [state_of(env.unwrapped.np_random), *(_state(each) for _, each in generators), *random_states()]


def _outside(space: gym.Space[Any], observation: Any) -> str:
    """How an observation is outside of its space, as the rest of a sentence; "" where it is inside."""
    if not isinstance(space, spaces.Box):
        return "" if space.contains(observation) else f"is {_short(observation)}"
    try:
        values = np.asarray(observation, np.float64)
    except (TypeError, ValueError):
        return f"is {_short(observation)}"
    if values.shape != space.shape:
        kind = type(observation).__name__
        return f"is a {kind} of shape {values.shape}, must be an array of shape {space.shape}"
    if not np.isfinite(values).all():
        return f"contains {values[~np.isfinite(values)].flat[0]}"
    slack = 1e-5 * np.maximum(1.0, np.abs(values))
    wrong = (values < space.low - slack) | (values > space.high + slack)
    if not wrong.any():
        return ""
    place = np.unravel_index(int(np.argmax(wrong)), wrong.shape) if wrong.ndim else ()
    low, high = space.low[place], space.high[place]
    return f"has {values[place]:.4g} at {[*map(int, place)]}, must be from {low:.4g} to {high:.4g}"


def _short(value: Any) -> str:
    return f"{type(value).__name__} {' '.join(str(value).split())[:60]}"


def _mistyped(terminated: Any, truncated: Any) -> str:
    """What is wrong with the type of a flag, as the rest of a sentence; "" for nothing."""
    for name, flag in (("terminated", terminated), ("truncated", truncated)):
        if not isinstance(flag, bool | np.bool_):
            return f"returns {name}={flag} of type {type(flag).__name__}; must be a bool"
    return ""


def parts_of(
    space: gym.Space[Any], observation: Any = None, name: str = ""
) -> Iterator[tuple[str, gym.Space[Any], Any]]:
    """The spaces in a space, each with its name, and the part of an observation that is of it."""
    if not isinstance(space, spaces.Dict | spaces.Tuple):
        yield name, space, observation
        return
    for key, each in space.items() if isinstance(space, spaces.Dict) else enumerate(space.spaces):
        yield from parts_of(each, None if observation is None else observation[key], f"{name}[{key!r}]")


def is_image(space: gym.Space[Any]) -> bool:
    """Whether SB3 takes observations of a space for images, which it divides by 255."""
    if not isinstance(space, spaces.Box) or len(space.shape) != 3 or space.dtype != np.uint8:
        return False
    return bool((space.low == 0).all() and (space.high == 255).all())


def _vector(parts: Sequence[tuple[str, gym.Space[Any], Any]]) -> FloatArray | None:
    boxes = [part for _, space, part in parts if isinstance(space, spaces.Box)]
    if not boxes or sum(map(np.size, boxes)) > _MOST_NUMBERS:
        return None
    try:
        return np.concatenate([np.asarray(part, np.float64).ravel() for part in boxes])
    except (TypeError, ValueError):
        return None
