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
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from gridworld.base.errors import GYMNASIUM, InputError, TooLargeError, in_short, on_a_line
from gridworld.world.door import known
from gridworld.world.door.beliefs import State, Step, lumped
from gridworld.world.door.budget import MOST_SECONDS, MOST_STATES, SAMPLED, Budget
from gridworld.world.door.checks import (
    Resets,
    check_by_episodes,
    check_by_word,
    check_ignored,
    check_walks,
    walk,
)
from gridworld.world.door.copies import Anew
from gridworld.world.door.counters import Counter, Read, check_cuts, counted
from gridworld.world.door.layers import Changed, Env, Layers
from gridworld.world.door.rejection import Rejecting
from gridworld.world.outcomes import MOST_ACTIONS
from gridworld.world.shown import Seen

OVER = -1  # in place of the state in which an episode ends
_BEYOND = 1_000  # states further than a step limit that are found too, so that a small world is whole
_BATCH = 1_000  # states that are tried before a reset is tried from each of them
_DEEPEST = 10_000  # steps from the start
Result = tuple[int, bytes, float, bool, bool]


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
        keeps_copies: whether those of all states are kept, not only of some.
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
        keeps_copies: bool = False,
    ) -> None:
        self.where, self.env, self.ignore = where, env, tuple(ignore)
        self._compares, self._kept = compares, 1 if keeps_copies else SAMPLED  # the copy of one in so many
        self.is_by_word = state is not None
        self._read = state or known.state_reader(env.unwrapped)
        actions = env.action_space
        if not isinstance(actions, spaces.Discrete) or actions.start != 0 or actions.n > MOST_ACTIONS:
            raise self.refusal(
                f"its actions are {actions}; must be Discrete(n) with n up to {MOST_ACTIONS:,}, from 0 on"
            )
        self.num_actions = int(actions.n)
        try:
            has_masks = isinstance(env, gym.Wrapper) and env.has_wrapper_attr("action_masks")
            self.has_masks = has_masks or hasattr(env, "action_masks")
        except Exception as error:  # of its own
            reason = f"its __getattr__ raises {in_short(error)}, must raise AttributeError"
            raise self.refusal(reason) from error
        self.seen = Seen(env, self.refusal)
        self.is_cutting = False  # whether steps are tried as they are at a limit
        self.limit_met: int | None = None  # the time at which it cuts episodes, where the time is no state
        self.num_tried = 0
        self.budget = Budget(self, most_states, most_seconds)

    def refusal(self, reason: str) -> InputError:
        """An error that says why there is no table of it."""
        return InputError(f"{self.where}: {reason}")

    def too_large(self, reason: str) -> TooLargeError:
        """An error that says what there is more of than may be tried."""
        return TooLargeError(f"{self.where}: {reason}")

    def explore(self) -> None:
        """Find all states that can be reached, and what every action does there."""
        how: dict[str, bool] = {}
        with known.clock_watched() as self.clock_readers:
            while not self.budget.is_explored:
                try:
                    self._explored(**how)
                    self.budget.is_explored = True
                except Anew as error:
                    how |= error.how

    def _explored(self, **how: bool) -> None:
        runs = (Search.reset_from.__code__, Search.stepped_from.__code__)
        self.branching = Rejecting(self.where, self._everything, runs, self._read is not None, self._compares)
        self.branching.check_time = self.budget.check_seconds
        self.layers = layers = Layers(self.where, self.env, self.branching, **how)
        with layers.restored():
            self.begin, before = layers.take(), layers.values()
            changing: set[tuple[int, str]] = set()
            series: list[list[dict[Any, Any]]] = [[]]  # the numbers in each walk

            def look(is_over: bool) -> None:
                if not is_over:
                    series[-1].append(layers.numbers())
                    return
                series.append([])
                after = layers.values()
                changing.update(each for each in before | after if before.get(each) != after.get(each))

            as_sent = walk(self, np.int64, look)
            check_walks(self, as_sent)
            while True:
                layers.put(self.begin)
                layers.leave(changing, series)
                self.begin = layers.take(with_counts=True)  # which shares objects with what is left in place
                try:
                    if layers.uncertain():
                        if walk(self, np.int64) != as_sent:
                            raise Read(layers.uncertain())
                        layers.put(self.begin)
                    self._explore()
                    layers.check_left()
                    layers.check_shared()
                    if self.ignore or self._read is not None:
                        self.limit_met = check_by_word(self)
                    else:
                        check_by_episodes(self)
                    layers.check_generators()
                    return
                except Read as error:
                    layers.note_read(error.found, not (self.ignore or self._read or self.has_masks))
                    continue
                except Changed as error:
                    found = error.found
                except InputError as error:
                    layers.check_generators()  # which names a cause that others follow from
                    if not (found := layers.changed_left()):
                        raise self._explained(error) from None
                changing |= set(found)

    def _explained(self, error: InputError) -> InputError:
        space = self.env.observation_space
        is_continuous = isinstance(space, spaces.Box) and space.dtype.kind == "f"
        if not (is_continuous and "more than comparisons" in str(error)):
            return error
        continuous = "its states are continuous: only finite worlds have an exact optimum"
        return self.refusal(f"{continuous} ({str(error).partition(': ')[2]})")

    def _everything(self, *held: Any) -> tuple[bytes, bool]:
        """All that a step's rest depends on, with what the functions between hold; is it all by content?"""
        num_kept = len(self.layers.fixed)  # objects that are kept as they are, which a run may make anew
        if self._read is None:
            found = self.layers.everything(*held)
        else:
            found = self.layers.dump((self._read(self.layers.base), held))
        return found, len(self.layers.fixed) == num_kept

    def _explore(self) -> None:
        self.states: list[State] = []
        self.num_tried = 0
        self.ends: dict[bytes, known.Named] = {}  # what ends are called, by their observations
        # By their cores, and by the time if there are clocks.
        self._states: dict[tuple[bytes, int], State] = {}
        self._rows: dict[Any, Any] = {}  # what follows in a core by an action, and where that holds
        self.cores: dict[bytes, State] = {}  # what states that differ in their clocks have in common
        self._reset_cores: set[bytes] = set()  # from which a reset was tried
        self._ended: set[bytes] = set()
        self._waiting_ends: list[bytes] = []  # copies of new ends, from which no reset was tried yet
        budget, most_states = self.budget, self.budget.most_states
        budget.begin()
        self.first = first = self.layers.take()
        check_ignored(self, first)
        self.resets = Resets(self, first)
        self._waiting: list[State] = []
        self.open(each.following for each in self.resets.starts)
        waiting = self._waiting
        beyond: int | None = None  # where in `waiting` the limit is, with `size` states before it
        size = checked = 0  # of the states in `waiting`, those from which a reset was tried
        for place, state in enumerate(waiting):  # which grows
            budget.show(f"{len(self.states):,} states, {place:,} of them tried")
            limit = counted(self)
            if beyond is None and state.depth >= (limit or _DEEPEST):
                if limit is None:
                    still = f"after {_DEEPEST:,} steps it still finds new states"
                    raise self.too_large(f"{still}, since its {budget.what_changes()}")
                beyond, size = place, len(self.states)
                most_states = min(most_states, size + _BEYOND)
            try:
                budget.most_now = most_states
                state.steps = self._tried(state)
                steps = itertools.chain.from_iterable(state.steps)
                self.open(each.following for each in steps if each.following != OVER)
                if place + 1 == len(waiting) or place + 1 - checked >= _BATCH:
                    self._check_resets(waiting[checked : place + 1])
                    checked = place + 1
            except InputError:
                if beyond is None:
                    raise
                for late in waiting[beyond:]:
                    late.steps = ()
                del self.states[size:]
                self._states = {key: each for key, each in self._states.items() if each.number < size}
                self._check_resets(waiting[checked:beyond])
                break
        self.resets.check(next(each.copy for each in reversed(self.states) if each.copy))
        apart = [(each.mask, each.place) for each in self.states]
        self.classes = lumped([each.steps for each in self.states], apart)
        self.resets.check_others(self.classes)

    def open(self, numbers: Iterable[int]) -> None:
        """An episode goes on in these states, so that what each action does there is tried."""
        for number in numbers:
            if not self.states[number].is_open:
                self.states[number].is_open = True
                self._waiting.append(self.states[number])

    # ---- runs ----

    def reset_from(self, copy: bytes) -> Result:
        self.layers.put(copy, None)
        try:
            returned = self.layers.env.reset(**self.layers.reset_options)
        except Exception as error:  # whatever it raises
            raise self._failed("a reset", error) from error
        if not (isinstance(returned, tuple) and len(returned) == 2 and isinstance(returned[1], dict)):
            raise self.refusal(f"reset() returns {on_a_line(returned)}, as in the old Gym: {GYMNASIUM}")
        return *self.state_after(returned[0], 0), 0.0, False, False

    def stepped_from(self, copy: bytes, depth: int, action: Any) -> Result:
        self.layers.put(copy, depth)
        try:
            returned = self.layers.env.step(action)
        except Exception as error:  # whatever it raises
            raise self._failed(f"a step with action {action}", error) from error
        if not (isinstance(returned, tuple) and len(returned) == 5):
            raise self.refusal(f"step() returns {on_a_line(returned)}, as in the old Gym: {GYMNASIUM}")
        observation, reward, terminated, truncated, _ = returned
        try:
            paid = math.nan if np.ndim(reward) else float(reward)
        except (TypeError, ValueError):
            paid = math.nan
        if not math.isfinite(paid):
            number = f"{on_a_line(reward)}; must be a finite number, and no array"
            raise self.refusal(f"a step with action {action} pays {number}")
        is_over = bool(terminated or truncated)
        return *self.state_after(observation, depth + 1, is_over), paid, bool(terminated), bool(truncated)

    def _failed(self, what: str, error: Exception) -> Exception:
        if isinstance(error, InputError):
            return error
        if counters := self.layers.uncertain():  # which may be why
            raise Read(counters)
        return self.refusal(f"{what} fails: {in_short(error)}")

    def _tried(self, state: State) -> list[list[Step]]:
        """What each action does in a copy of a state."""
        self.budget.check_seconds()
        steps = [self._row(state, action) for action in range(self.num_actions)]
        check_cuts(self, state, steps)
        self.num_tried += 1
        if state.mask is not None:
            self.layers.put(state.copy)
            if self._mask() != state.mask:
                raise self.refusal("its action_masks() does not always allow the same in the same state")
        if state.number.bit_count() <= 1:  # 0, 1, 2, 4, 8 ...
            self.layers.check_left()
        return steps

    def _row(self, state: State, action: int) -> list[Step]:
        """What an action does in a state: what it does at other times, where no clock says otherwise."""
        run = functools.partial(self.stepped_from, state.copy, state.depth, np.int64(action))
        clocks = self.layers.clocks
        found = self._rows.setdefault((state.core, action), []) if clocks else None
        if found is None:  # it reads a clock, or there is none
            return self.merged(run)
        for conditions, row in found:
            if all(map(Counter.holds, clocks, conditions, itertools.repeat(state.depth))):
                return [self._at(step, state.depth + 1) for step in row]
        for clock in clocks:
            clock.asked = {}
        try:
            row = self.merged(run)
            found.append(([clock.asked for clock in clocks], row))
            return row
        except Read as error:
            if not error.found <= {clock.key for clock in clocks}:
                raise
        finally:
            for clock in clocks:
                clock.asked = None
        self._rows[state.core, action] = None
        return self.merged(run)

    def _at(self, step: Step, time: int) -> Step:
        """The same outcome at another time."""
        if step.following == OVER:
            return step
        same = self.states[step.following]
        state = self._states.get((same.core, time))
        return step._replace(following=(state or self._added(same, time)).number)

    def _check_resets(self, states: Sequence[State]) -> None:
        """A reset from these states, and from the ends that were met, must lead to the same.

        After their steps, for a reset may put back what these have changed in place.
        """
        self.layers.check_left()
        for state in states:
            # It was tried, before one further than the step limit was refused, or at another time.
            if not state.copy or state.core in self._reset_cores:
                continue
            self._reset_cores.add(state.core)
            if state.number.bit_count() <= 1:
                self.resets.check(state.copy)
            else:
                self.resets.check_first(state.copy)
            if state.number % self._kept and not self.layers.clocks:
                self.budget.num_bytes -= len(state.copy)
                state.copy = b""
        while self._waiting_ends:
            self.resets.check_first(self._waiting_ends.pop())

    def merged(self, run: Callable[[], Result]) -> list[Step]:
        """The outcomes of a reset or a step."""
        return [Step(probability, *result) for result, probability in self.branching.outcomes(run).items()]

    # ---- states ----

    def state_after(self, observation: Any, depth: int, is_over: bool = False) -> tuple[int, bytes]:
        """The number of the state that the environment is in, and a digest of the observation."""
        seen = self.seen.digest(observation)
        if is_over and seen not in self.ends:
            self.ends[seen] = self._named(*known.place_of(self.layers.base), depth)
        if self.is_cutting:
            return OVER, seen
        if not is_over and self.branching.sampling is None:
            self.layers.check_counters(depth)
        if self._read is not None:
            key = pickle.dumps(self._read(self.layers.base))
        else:
            key = self.layers.take(self.ignore)
        short = hashlib.blake2b(key, digest_size=16).digest()
        if is_over:
            is_new = short not in self._ended and (short, 0) not in self._states
            if is_new and self.branching.sampling is None:
                self._ended.add(short)
                if self._read is None or not len(self._ended) % SAMPLED:  # by the user's word it is all alike
                    self._waiting_ends.append(self.layers.take())
            return OVER, seen
        time = depth if self.layers.clocks else 0
        if (state := self._states.get((short, time))) is None:
            copy = self.layers.take() if self.ignore or self._read else key
            like = State(0, 0, copy, short, *known.place_of(self.layers.base))
            if self.layers.clocks:  # one copy for all times
                like = self.cores.setdefault(short, like)
            state = self._added(like, depth, len(copy) if like.copy is copy else 0)
        return state.number, seen

    def _added(self, like: State, depth: int, num_bytes: int = 0) -> State:
        """A new state, which is like another but for its time."""
        name, place = self._named(like.name.partition(", step")[0], like.place, depth)
        state = State(len(self.states), depth, like.copy, like.core, name, place)
        if self.has_masks:
            state.mask = self._mask()
        self.states.append(state)
        self.budget.add(num_bytes)
        return self._states.setdefault((like.core, depth if self.layers.clocks else 0), state)

    def _named(self, name: str, place: Any, depth: int) -> known.Named:
        """The name of a state, with the step of MiniGrid's environments where that is state."""
        state = {each for _, each in self.layers.clocked | self.layers.read}.difference(self.ignore)
        return f"{name}, step {depth}" if name and "step_count" in state else name, place

    def _mask(self) -> tuple[bool, ...]:
        masks = self.env.get_wrapper_attr("action_masks")()
        return tuple(bool(each) for each in np.reshape(masks, -1))
