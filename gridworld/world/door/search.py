"""The states of an environment, wrappers included, and what every action does in a copy of each.

A state is what the attributes of all layers hold (`layers`); in place of `np_random` there is a generator
that takes every outcome in turn (`rejection`). States after a reset come first, then breadth first. A reset
is tried from every state and end too: it must always lead to the same.
"""

from __future__ import annotations

import functools
import hashlib
import itertools
import math
import pickle
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, NoReturn

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from gridworld.base.console import ProgressLine
from gridworld.base.errors import GYMNASIUM, InputError, in_short, on_a_line
from gridworld.base.user_input import check_memory
from gridworld.world.door import known
from gridworld.world.door.beliefs import Step, lumped
from gridworld.world.door.layers import Changed, Env, Layers, Limited, Timed, attributes
from gridworld.world.door.observations import leaves
from gridworld.world.door.rejection import Rejecting
from gridworld.world.door.word import check_by_word
from gridworld.world.outcomes import MOST_ACTIONS

OVER = -1  # in place of the state in which an episode ends
MOST_STATES, MOST_SECONDS = 200_000, 120.0
_BEYOND = 1_000  # states further than a step limit that are found too, so that a small world is whole
_DEEPEST = 10_000  # steps from the start
_MOST_BYTES = 2**31  # of all copies and observations together
_SAMPLED = 16  # of so many states the copy of one is kept, to name what keeps changing
_WALKS, _WALK = 20, 10  # walks that show which large attributes change, and their steps
_FACING = ("right", "down", "left", "up")  # minigrid's directions
_MOST_RESETS = 1_000  # that lead to other states than usual; more will not turn out to be alike
_FEW_STARTS = 256  # of more, every outcome of a reset is tried from the first and the last state only
_BETWEEN_LOOKS, _BETWEEN_LINES, _SLOW = 0.5, 3.0, 6.0  # seconds: of progress on a terminal, and elsewhere
_LONGEST_NAME = 60  # of a state that is called by its observation
_NOT_REPEATED = (
    "it does not repeat a walk with the same random numbers, so it depends on more than its attributes and "
    "np_random: another generator, a clock, a file, something global"
)
_INTS = (
    "it answers an action that is an int in another way than np.int64, which learners send; take both alike, "
    "e.g. by int(action)"
)
Named = tuple[str, tuple[str, int, int] | None]  # what a reader calls a state, and its place
Start = tuple[Fraction, int, bytes]  # a probability, the number of a state, a digest of the observation
Result = tuple[int, bytes, float, bool, bool]


class _Missing(Exception):  # noqa: N818
    """An attribute is missing that a wrapper which was left out may have."""


@dataclass
class State:
    """A state of the environment itself, which an agent may not see."""

    number: int
    depth: int  # steps from the start
    copy: bytes  # b"" where it is no longer needed
    name: str
    place: tuple[str, int, int] | None  # which way the agent faces, row and column
    is_open: bool = False  # an episode goes on in it
    steps: Sequence[Sequence[Step]] = ()  # the outcomes of each action; empty where none was tried
    mask: tuple[bool, ...] | None = None  # which actions `action_masks()` allows


class Search:
    """Finds the states of an environment.

    Args:
        where: what messages call it.
        env: the environment, which is left as it was.
        ignore: attributes that are no state, by the user's word.
        state: a function of the environment without wrappers that is all of its state, by the user's word.
        most_states: more are refused.
        most_seconds: what takes longer is refused.
        compares: whether shares found by rejection are compared with real draws.
    """

    def __init__(
        self,
        where: str,
        env: Env,
        ignore: Sequence[str] = (),
        state: Callable[[Any], Any] | None = None,
        most_states: int = MOST_STATES,
        most_seconds: float = MOST_SECONDS,
        compares: bool = True,
    ) -> None:
        self.where, self.env, self.ignore = where, env, tuple(ignore)
        self._most_states, self._most_seconds, self._compares = most_states, most_seconds, compares
        self._read = state or known.state_reader(env.unwrapped)
        actions = env.action_space
        if not isinstance(actions, spaces.Discrete) or actions.start != 0 or actions.n > MOST_ACTIONS:
            raise self.refusal(
                f"its actions are {actions}, must be Discrete(n), from 0 to {MOST_ACTIONS} - 1"
            )
        self.num_actions = int(actions.n)
        self.has_masks = isinstance(env, gym.Wrapper) and env.has_wrapper_attr("action_masks")
        self.has_masks = self.has_masks or hasattr(env, "action_masks")
        self.observations: dict[bytes, Any] = {}  # by their digests
        self.shown: dict[bytes, str] = {}  # the same as short texts
        self._num_bytes = 0
        self.limit_met: int | None = None  # the time at which it cuts episodes, where the time is no state
        self._began = time.monotonic()
        self._line, self._due = ProgressLine(enabled=True, seconds_between_lines=_BETWEEN_LINES), 1.0
        self._growing = ""

    def refusal(self, reason: str) -> InputError:
        """An error that says why there is no table of it."""
        return InputError(f"{self.where}: {reason}")

    @property
    def _name(self) -> str:
        return self.where.removeprefix("env.id=")

    def seconds_left(self) -> float:
        """Of those that it may take."""
        return self._most_seconds - self._seconds()

    def _seconds(self) -> float:
        return time.monotonic() - self._began

    def show(self, what: str) -> None:
        """Show how far it is, from the first second on, and later what keeps growing, too."""
        seconds = self._seconds()
        if seconds >= self._due:
            self._due = seconds + _BETWEEN_LOOKS
            if seconds > _SLOW and not self._growing:
                self._growing = f"; {self._most_values()} keeps changing"
            self._line.show(lambda: f"{self.where}: {what}, {seconds:.0f} s{self._growing}; Ctrl-C ends it")

    def clear(self) -> None:
        """Remove that line from a terminal."""
        self._line.clear()

    def explore(self) -> None:
        """Find all states that can be reached, and what every action does there."""
        try:
            self._explored(counts_time=False)
        except (_Missing, Timed):  # something reads what is around it: a time limit's count, say
            self._explored(counts_time=True)

    def _explored(self, counts_time: bool) -> None:
        runs = (Search.reset_from.__code__, Search.stepped_from.__code__)
        self.branching = Rejecting(self.where, self._everything, runs, self._read is not None, self._compares)
        self.layers = layers = Layers(self.where, self.env, self.branching, counts_time)
        self._is_complete = counts_time  # nothing that an environment may read is left out
        with layers.restored():
            begin, before = layers.take(), layers.values()
            as_sent = self.walk(np.int64)
            after = layers.values()
            changing = {each for each in before | after if before.get(each) != after.get(each)}
            for kind, mistake in ((np.int64, _NOT_REPEATED), (int, _INTS)):
                layers.put(begin)
                if self.walk(kind) != as_sent:
                    layers.check_generators()
                    raise self.refusal(mistake)
            while True:
                layers.put(begin)
                layers.leave(changing)
                try:
                    self._explore(layers.limit)
                    layers.check_left()
                    if self.ignore or self._read is not None:
                        self.limit_met = check_by_word(self)
                    layers.check_generators()
                    return
                except Changed as error:
                    changing |= set(error.found)
                    layers.leave_nothing()
                except InputError as error:
                    layers.check_generators()  # which names a cause that others follow from
                    if "more than comparisons" in str(error) and _is_continuous(self.env.observation_space):
                        continuous = "its states are continuous, and only finite worlds have an exact optimum"
                        raise self.refusal(f"{continuous} ({str(error).partition(': ')[2]})") from None
                    raise

    def _everything(self, *held: Any) -> bytes:
        """All that a step's rest depends on, with what the functions between hold."""
        if self._read is None:
            return self.layers.everything(*held)
        return self.layers.copy_of((self._read(self.layers.base), held))

    def walk(self, kind: type) -> list[Any]:
        """What some walks with numpy's own generator and actions of a type show."""
        numbers, shown = np.random.default_rng(0), list[Any]()
        self.branching.sampling = np.random.default_rng(1)
        try:
            for _ in range(_WALKS):
                shown.append(self._see(self.layers.env.reset()[0]))
                for _ in range(_WALK):
                    observation, reward, *over, _ = self.layers.env.step(
                        kind(numbers.integers(self.num_actions))
                    )
                    paid = np.asarray(reward, np.float64).tobytes()
                    shown += [self._see(observation), paid, *map(bool, over)]
                    if any(over):
                        break
        except Exception as error:  # which the search meets too, and refuses
            shown.append(str(error))
        finally:
            self.branching.sampling = None
        return shown

    def _explore(self, limit: int | None) -> None:
        self.states: list[State] = []
        self.ends: dict[bytes, Named] = {}  # what ends are called, by their observations
        self._by_copy: dict[bytes, State] = {}
        self._ended: set[bytes] = set()
        self._waiting_ends: list[bytes] = []  # copies of new ends, from which no reset was tried yet
        self._most_now = self._most_states
        self._other_resets: dict[Any, bytes] = {}  # a copy before each reset that leads to other states
        self._num_bytes = 0
        most_states = self._most_states
        first = self.layers.take()
        if unknown := [each for each in self.ignore if each not in self.layers.names()]:
            self._merged(functools.partial(self.reset_from, first))  # which may make it
            if each := next((each for each in unknown if each not in self.layers.names()), None):
                raise InputError(
                    f"env.ignore={list(self.ignore)}: {self._name} has no attribute {each}; it has "
                    f"{', '.join(dict.fromkeys(self.layers.names()))}"
                )
        self.first = first
        self.starts = self._merged(functools.partial(self.reset_from, first))
        self._first_start = self.branching.first(functools.partial(self.reset_from, first))[:2]
        self._waiting: list[State] = []
        self._open(each.following for each in self.starts)
        waiting = self._waiting
        beyond: int | None = None  # where in `waiting` the limit is, with `size` states before it
        size = 0
        for place, state in enumerate(waiting):  # which grows
            self.show(f"{len(self.states):,} states, {place:,} of them tried")
            if beyond is None and state.depth >= (limit or _DEEPEST):
                if limit is None:
                    still = f"after {_DEEPEST:,} steps it still finds new states"
                    raise self.refusal(f"{still}, since its {self._what_changes()}")
                beyond, size = place, len(self.states)
                most_states = self._most_now = min(most_states, size + _BEYOND)
            try:
                self._most_now = most_states
                state.steps = self._tried(state)
            except InputError:
                if beyond is None:
                    raise
                for late in waiting[beyond:]:
                    late.steps = ()
                del self.states[size:]
                break
            steps = itertools.chain.from_iterable(state.steps)
            self._open(each.following for each in steps if not (each.terminated or each.truncated))
        self._check_resets(next(each.copy for each in reversed(self.states) if each.copy))
        apart = [(each.mask, each.place) for each in self.states]
        self.classes = lumped([each.steps for each in self.states], apart)
        self._check_other_resets()

    def _open(self, numbers: Iterable[int]) -> None:
        """An episode goes on in these states, so that what each action does there is tried."""
        for number in numbers:
            if not self.states[number].is_open:
                self.states[number].is_open = True
                self._waiting.append(self.states[number])

    # ---- runs ----

    def reset_from(self, copy: bytes) -> Result:
        self.layers.put(copy)
        try:
            returned = self.layers.env.reset()
        except Exception as error:  # whatever it raises
            raise self._failed("a reset", error) from error
        if not (isinstance(returned, tuple) and len(returned) == 2 and isinstance(returned[1], dict)):
            raise self.refusal(f"reset() returns {on_a_line(returned)}, as in the old Gym: {GYMNASIUM}")
        return *self.state_after(returned[0], 0), 0.0, False, False

    def stepped_from(self, copy: bytes, depth: int, action: Any) -> Result:
        self.layers.put(copy)
        limited = self.layers.limited
        if limited is not None:
            limited.steps = 0
        try:
            returned = self.layers.env.step(action)
        except Exception as error:  # whatever it raises
            raise self._failed(f"a step with action {action}", error) from error
        if limited is not None and limited.steps != 1:
            raise Timed
        if not (isinstance(returned, tuple) and len(returned) == 5):
            raise self.refusal(f"step() returns {on_a_line(returned)}, as in the old Gym: {GYMNASIUM}")
        observation, reward, terminated, truncated, _ = returned
        if np.ndim(reward):
            raise self.refusal(
                f"a step with action {action} pays an array of shape {np.shape(reward)}; must be a number"
            )
        try:
            paid = float(reward)
        except (TypeError, ValueError):
            paid = math.nan
        if not math.isfinite(paid):
            raise self.refusal(
                f"a step with action {action} pays {on_a_line(reward)}; must be a finite number"
            )
        is_over = bool(terminated)
        return *self.state_after(observation, depth + 1, is_over), paid, is_over, bool(truncated)

    def _failed(self, what: str, error: Exception) -> Exception:
        if isinstance(error, InputError):
            return error
        if isinstance(error, AttributeError) and not self._is_complete:
            return _Missing()
        return self.refusal(f"{what} fails: {in_short(error)}")

    def _tried(self, state: State) -> list[list[Step]]:
        """What each action does in a copy of a state."""
        if self.seconds_left() < 0:
            raise self.refusal(
                f"after {self._most_seconds:.0f} s it still finds new states ({len(self.states):,} so "
                "far), since "
                f"its {self._what_changes()}"
            )
        steps = [
            self._merged(functools.partial(self.stepped_from, state.copy, state.depth, np.int64(action)))
            for action in range(self.num_actions)
        ]
        if self.layers.limited is not None and self.layers.may_see_cuts:
            self._check_cut(state, steps, self.layers.limited)
        if state.mask is not None:
            self.layers.put(state.copy)
            if self._mask() != state.mask:
                raise self.refusal("its action_masks() does not always allow the same in the same state")
        if is_marked := state.number.bit_count() <= 1:  # 0, 1, 2, 4, 8 ...
            self.layers.check_left()
        if is_marked and (len(self.starts) <= _FEW_STARTS or not state.number):
            self._check_resets(state.copy)
        else:
            self._check_first_reset(state.copy)
        while self._waiting_ends:
            self._check_first_reset(self._waiting_ends.pop())
        if state.number % _SAMPLED:
            self._num_bytes -= len(state.copy)
            state.copy = b""
        return steps

    def _merged(self, run: Callable[[], Result]) -> list[Step]:
        found = self.branching.outcomes(run)
        return [Step(probability, *result) for result, probability in found.items()]

    def _check_cut(self, state: State, steps: list[list[Step]], limited: Limited) -> None:
        """A wrapper around a time limit must pass the cut on, and otherwise do what it does without."""
        limited.cuts = True
        try:
            for action, usual in enumerate(steps):
                run = functools.partial(self.stepped_from, state.copy, state.depth, np.int64(action))
                cut: dict[Any, Fraction] = {}
                for (_, *shown), probability in self.branching.outcomes(run).items():
                    key = (*shown[:3], shown[2] or shown[3])
                    cut[key] = cut.get(key, Fraction(0)) + probability
                whole: dict[Any, Fraction] = {}
                for each in usual:
                    key = (each.seen, each.reward, each.terminated, True)
                    whole[key] = whole.get(key, Fraction(0)) + each.probability
                if cut != whole:
                    raise Timed
        finally:
            limited.cuts = False

    # ---- resets ----

    def _check_first_reset(self, copy: bytes) -> None:
        number, seen = self.branching.first(functools.partial(self.reset_from, copy))[:2]
        self._compare_resets([(Fraction(1), *self._first_start)], [(Fraction(1), number, seen)], copy)

    def _check_resets(self, copy: bytes) -> None:
        """A reset must lead to the same, whatever it draws."""
        found = self._merged(functools.partial(self.reset_from, copy))
        self._compare_resets([each[:3] for each in self.starts], [each[:3] for each in found], copy)

    def _compare_resets(self, usual: list[Start], found: list[Start], copy: bytes) -> None:
        """They must lead to the same, or to states that turn out to be alike, which are tried too."""
        if sorted(usual) == sorted(found):
            return
        self._other_resets.setdefault((tuple(usual), tuple(found)), copy)
        if len(self._other_resets) > _MOST_RESETS:
            self._refuse_reset(copy)
        self._open(number for _, number, _ in found)

    def _check_other_resets(self) -> None:
        for (usual, found), copy in self._other_resets.items():
            shares: list[dict[Any, Fraction]] = [{}, {}]
            for share, starts in zip(shares, (usual, found), strict=True):
                for probability, number, seen in starts:
                    key = self.classes[number], seen
                    share[key] = share.get(key, Fraction(0)) + probability
            if shares[0] != shares[1]:
                self._refuse_reset(copy)

    def _refuse_reset(self, copy: bytes) -> NoReturn:
        usual, found = self._values_after_resets(self.first), self._values_after_resets(copy)
        changed = _listed(name for name in usual | found if usual.get(name) != found.get(name))
        raise self.refusal(
            f"a reset does not always lead to the same state (in {changed}), so its states cannot be "
            "enumerated "
            "from one start; set all of it in reset(), or name what does not matter in env.ignore"
        )

    def _values_after_resets(self, copy: bytes) -> dict[str, set[bytes]]:
        values: dict[str, set[bytes]] = {}

        def reset() -> Result:
            result = self.reset_from(copy)
            for (_, name), value in self.layers.values(self.ignore).items():
                values.setdefault(name, set()).add(value)
            return result

        self.branching.outcomes(reset)
        return values

    # ---- states ----

    def state_after(self, observation: Any, depth: int, is_over: bool = False) -> tuple[int, bytes]:
        """The number of the state that the environment is in, and a digest of the observation."""
        seen = self._see(observation)
        if is_over and seen not in self.ends:
            self.ends[seen] = self._named()
        if self.layers.limited is not None and self.layers.limited.cuts:
            return OVER, seen
        if self._read is not None:
            key = pickle.dumps(self._read(self.layers.base))
        else:
            key = self._copied(self.ignore)
        short = hashlib.blake2b(key, digest_size=16).digest()
        if is_over:
            if short not in self._ended and short not in self._by_copy and self.branching.sampling is None:
                self._ended.add(short)
                self._waiting_ends.append(self._copied())
            return OVER, seen
        if (state := self._by_copy.get(short)) is None:
            copy = self._copied() if self.ignore or self._read else key
            state = self._by_copy[short] = self._added(copy, depth)
        return state.number, seen

    def _copied(self, without: Sequence[str] = ()) -> bytes:
        try:
            return self.layers.take(without)
        except (Changed, InputError):
            raise
        except Exception as error:  # whatever the classes in it raise
            raise self.refusal(f"its state cannot be copied: {in_short(error)}") from error

    def _added(self, copy: bytes, depth: int) -> State:
        name, place = self._named()
        state = State(len(self.states), depth, copy, name, place)
        if self.has_masks:
            state.mask = self._mask()
        self.states.append(state)
        self._num_bytes += len(copy)
        if len(self.states) > self._most_now:
            raise self.refusal(
                f"more than {self._most_now:,} states can be reached, too many to solve, since its "
                f"{self._what_changes()}"
            )
        if self._num_bytes > _MOST_BYTES:
            raise self.refusal(
                f"copies of the first {len(self.states):,} states take more than "
                f"{_MOST_BYTES / 2**30:.0f} GiB"
            )
        check_memory(self.where, self._num_bytes)
        return state

    def _mask(self) -> tuple[bool, ...]:
        masks = self.env.get_wrapper_attr("action_masks")()
        return tuple(bool(each) for each in np.reshape(masks, -1))

    def _named(self) -> Named:
        """What a reader calls its state, and its place, by attributes that minigrid's environments have."""
        base = self.layers.base
        place, direction = (getattr(base, name, None) for name in ("agent_pos", "agent_dir"))
        try:
            column, row = (int(each) for each in place)  # type: ignore[union-attr]
            facing = f"facing {_FACING[direction]}"  # type: ignore[index]
        except (TypeError, ValueError, IndexError):
            return "", None
        if carried := getattr(getattr(base, "carrying", None), "type", None):
            facing += f", carrying a {carried}"
        shown = "" if "step_count" in self.ignore else f", step {getattr(base, 'step_count', '?')}"
        return f"row {row + 1}, column {column + 1}, {facing}{shown}", (facing, row, column)

    def _see(self, observation: Any) -> bytes:
        """A digest of an observation as a learner gets it, in the types of its space."""
        parts = list(leaves(observation, self.env.observation_space, self.refusal))  # whose sizes are known
        whole = b"".join(each.tobytes() if isinstance(each, np.ndarray) else each for each in parts)
        seen = whole if len(whole) <= 16 else hashlib.blake2b(whole, digest_size=17).digest()
        if seen not in self.observations:
            self.observations[seen] = parts
            shown = " ".join(str(observation).split())
            self.shown[seen] = f"observation {shown}" if len(shown) <= _LONGEST_NAME else ""
            self._num_bytes += sum(each.nbytes for each in parts if isinstance(each, np.ndarray))
        return seen

    # ---- what is said of it ----

    def _most_values(self) -> str:
        """The attributes with the most values, the elapsed time among them."""
        values: dict[str, set[bytes]] = {}
        for copy in [each.copy for each in self.states[::_SAMPLED] if each.copy][-1000:]:
            self.layers.put(copy)
            for (_, name), key in self.layers.values(self.ignore).items():
                values.setdefault(name, set()).add(key)
        most = max(map(len, values.values()), default=0)
        return _listed(name for name, found in values.items() if len(found) == most)

    def _what_changes(self) -> str:
        """What keeps changing, and a remedy, as the rest of a sentence."""
        names = self._most_values()
        first, by_settings = names.split(",")[0], self.where.startswith("env.id")
        limit = "env.kwargs.max_episode_steps" if by_settings else "gymnasium.wrappers.TimeLimit"
        ignored = f"env.ignore=[{first}]" if by_settings else f'ignore=["{first}"]'
        return (
            f"{names} keeps changing; use a smaller one, set a limit ({limit}), or ignore irrelevant "
            f"attributes, e.g. {ignored}"
        )


def traits(env: Env) -> Any:
    """What two environments that are one task have in common: a walk, and what never changes."""
    search = Search("env", env)
    branching = Rejecting("env", bytes, ())
    search.layers, search.branching = Layers("env", env, branching), branching
    with search.layers.restored():
        held = {
            (number, name): value
            for number, layer in enumerate(search.layers.layers)
            for name, value in attributes(layer).items()
        }
        before = search.layers.values()
        shown = search.walk(np.int64)
        after = search.layers.values()
    constant: dict[Any, Any] = {
        key: held[key] if isinstance(held[key], gym.Space) else value
        for key, value in before.items()
        if after.get(key) == value and held[key] is not branching
    }
    return [type(each) for each in search.layers.layers], search.layers.limit, constant, shown


def _is_continuous(space: gym.Space[Any]) -> bool:
    return isinstance(space, spaces.Box) and space.dtype.kind == "f"


def _listed(names: Iterable[str]) -> str:
    return ", ".join(sorted(names)) or "nothing"
