"""Whether what was found is what happens: walks and episodes with numpy's own generator, and resets.

What a step does from a copy of the state may be another thing than what it does in an episode: where it
depends on what is not copied, or on what a user leaves out of the state. And a reset must always lead to the
same, whatever came before it.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction
from functools import partial
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np

from gridworld.base.errors import InputError
from gridworld.world.door.attributes import differing, held_by, innermost, is_plain
from gridworld.world.door.beliefs import Step, summed
from gridworld.world.door.counters import counted
from gridworld.world.shown import content

if TYPE_CHECKING:
    from gridworld.world.door.search import Search

_NOT_REPEATED = (
    "it does not repeat a walk with the same random numbers, so it depends on more than its attributes and "
    "np_random: another generator, a clock, a file, something global"
)
_INTS = (
    "it answers an action that is an int in another way than np.int64, which learners send; take both alike, "
    "e.g. by int(action)"
)
_NO_LIMIT = (
    "it truncates some episodes earlier than others, so it has no single step limit; let step() return "
    "terminated=True where something ends an episode, and truncated=True only after a fixed number of steps"
)
_MORE = (
    "so it depends on more than its attributes: on what its class, its module, a function or a file holds, "
    "or on which object an attribute is"
)
_LONG_SHARE = 0.1  # of the episodes
_CURIOUS = 0.8  # how often the action is taken that was taken least there, by which a walk goes everywhere
_STEPS, _EPISODES = 3_000, 8  # at least
_FEW, _EACH = 200, 20  # steps of any search: at least, and for each state and action, up to _STEPS
_LONGEST, _LONG = 10_000, 300  # steps of the first of them, and of others before any action is taken

_WALKS, _WALK = 20, 10  # walks, and the steps of each
_FEW_STARTS, _SEEDS = 256, 100  # of more starts, those with so many seeds are compared
_MOST_RESETS = 1_000  # that lead to other states than usual; more will not turn out to be alike
Start = tuple[Fraction, int, bytes]  # a probability, the number of a state, a digest of the observation


def walk(search: Search, kind: type, look: Callable[[bool], None] = lambda _: None) -> list[Any]:
    """What some walks with numpy's own generator and actions of a type show.

    `look` is called after each reset and step; with whether the walk is over, too.
    """
    numbers, shown, fails = np.random.default_rng(0), list[Any](), False
    with search.branching.drawing(np.random.default_rng(1)):
        for _ in range(_WALKS):
            try:
                for each in _steps(search, kind, numbers):
                    look(False)
                    shown.append(each)
            except Exception as error:  # which the search meets too, and refuses
                shown.append(str(error))
                fails = True
            for counter in search.layers.counters:
                counter.cuts = False
            look(True)
            if fails:
                break
    return shown


def _steps(search: Search, kind: type, numbers: np.random.Generator) -> Iterator[Any]:
    yield search.seen.digest(search.layers.env.reset(**search.layers.reset_options)[0])
    counters = search.layers.counters
    for took in range(1, _WALK + 1):
        if counters:  # whose stand-ins come with a copy
            search.layers.put(search.layers.take(), took - 1)
            for counter in counters:
                counter.cuts = counter.is_limit and took in counter.limits
        observation, reward, *over, _ = search.layers.env.step(kind(numbers.integers(search.num_actions)))
        yield search.seen.digest(observation), np.asarray(reward, np.float64).tobytes(), *map(bool, over)
        if any(over):
            return


def check_walks(search: Search, shown: list[Any]) -> None:
    """The walks must show the same again, and with plain ints as actions too."""
    for kind, mistake in ((np.int64, _NOT_REPEATED), (int, _INTS)):
        search.layers.put(search.begin)
        if walk(search, kind) != shown:
            search.layers.check_generators()
            raise search.refusal(mistake)


def check_ignored(search: Search, first: bytes) -> None:
    """What `ignore` names must be attributes, at least after a reset from this copy, which may make them."""
    if not set(search.ignore) <= set(search.layers.names()):
        search.merged(partial(search.reset_from, first))
    names = dict.fromkeys(search.layers.names())
    if unknown := [each for each in search.ignore if each not in names]:
        has = f"has no attribute {unknown[0]}; it has {', '.join(names)}"
        raise InputError(f"env.ignore={list(search.ignore)}: {search.where.removeprefix('env.id=')} {has}")


def check_by_word(search: Search) -> int | None:
    """Play with numpy's own generator; returns when the environment cuts episodes, if it does."""
    numbers, steps, episode = np.random.default_rng(0), 0, 0
    limit: int | None = None
    with search.branching.drawing(np.random.default_rng(1)):
        while steps < _STEPS or episode < _EPISODES:
            lives = _LONGEST if episode == 0 else int(numbers.integers(1, _LONG))
            took, is_cut = _episode(search, numbers, lives)
            if (is_cut and limit not in (None, took)) or (limit is not None and took > limit):
                raise search.refusal(_NO_LIMIT)
            limit = took if is_cut else limit
            steps, episode = steps + took, episode + 1
    return limit


def check_by_episodes(search: Search) -> None:
    """Play; of the states that what was shown so far leaves possible, one must lead to what is shown next."""
    numbers, size = np.random.default_rng(0), len(search.states)
    left = min(_STEPS, max(_FEW, _EACH * size * search.num_actions))
    met: dict[int, list[int]] = {}  # how often each action was taken in a state
    short = min(_LONG, 4 * max(each.depth for each in search.states) + 4)
    with search.branching.drawing(np.random.default_rng(2)):
        while left > 0:
            search.layers.put(search.begin)
            seen = search.seen.digest(search.layers.env.reset(**search.layers.reset_options)[0])
            possible = {each.following for each in search.resets.starts if each.seen == seen}
            if not possible:
                raise search.refusal(f"a reset shows what was not enumerated, {_MORE}")
            lives = int(numbers.integers(1, _LONG if numbers.random() < _LONG_SHARE else short))
            for took in range(1, lives + 1):
                rows = [search.states[each].steps if each < size else () for each in possible]
                if not all(rows):
                    break  # beyond the step limit
                here = met.setdefault(min(possible), [0] * search.num_actions)
                least = [a for a, count in enumerate(here) if count == min(here)]
                choice = least if numbers.random() < _CURIOUS else range(search.num_actions)
                action = choice[int(numbers.integers(len(choice)))]
                here[action] += 1
                observation, reward, terminated, truncated, _ = search.layers.env.step(np.int64(action))
                found = search.seen.digest(observation), float(reward), bool(terminated)
                steps = itertools.chain.from_iterable(row[action] for row in rows)
                fits = [s for s in steps if (s.seen, s.reward, s.terminated) == found]
                possible = {each.following for each in fits}
                left -= 1
                cuts = {each.truncated or took == counted(search) for each in fits}
                if not (possible and (terminated or bool(truncated) in cuts)):
                    raise search.refusal(
                        f"step {took} of an episode is none of the outcomes that it has from a copy of its "
                        f"state, {_MORE}"
                    )
                if terminated or truncated:
                    break
            left -= 1


def _episode(search: Search, numbers: np.random.Generator, lives: int) -> tuple[int, bool]:
    """Steps that do not end it for so long, if there are such, then any: how many, and whether it was cut."""
    size, took = len(search.states), 0
    number = search.reset_from(search.first)[0]
    while True:
        rows = search.states[number].steps if number < size else ()
        living = [a for a, row in enumerate(rows) if not any(step.terminated for step in row)]
        choice = living if took < lives and living else range(search.num_actions)
        action = int(choice[int(numbers.integers(len(choice)))])
        if not rows or took >= 2 * lives + _LONG or took >= _LONGEST:
            return took, False
        observation, reward, terminated, truncated, _ = search.layers.env.step(np.int64(action))
        took += 1
        number, seen = search.state_after(observation, took, bool(terminated))
        found = number, seen, float(reward), bool(terminated)
        is_by_state = any(step.truncated and step[2:5] == found[1:] for step in rows[action])
        if found not in [tuple(step[1:5]) for step in rows[action]] and not (truncated and is_by_state):
            _refuse(search, took, found, rows[action])
        if terminated or truncated:
            return took, bool(truncated and not (terminated or is_by_state))


def _refuse(search: Search, took: int, found: Any, row: Sequence[Step]) -> NoReturn:
    what, shown = "state", ""
    if row and found[2] not in [step.reward for step in row]:
        what, shown = "reward", f" ({found[2]}, enumerated as {row[0].reward})"
    ignored = ", ".join(search.ignore)
    word = f"{ignored}, which env.ignore leaves out" if ignored else "more than state= says"
    raise search.refusal(
        f"after {took} steps of an episode its {what} is not the enumerated one{shown}, so it depends on "
        f"{word}"
    )


class Resets:
    """The resets of a search, which begins with one from a copy of the environment as it is."""

    def __init__(self, search: Search, first: bytes) -> None:
        self._search, self._first = search, first
        self.starts = search.merged(partial(search.reset_from, first))
        self._first_start = search.branching.first(partial(search.reset_from, first))[:2]
        self._others: dict[Any, bytes] = {}  # a copy before each reset that leads to other states

    def check_first(self, copy: bytes) -> None:
        """The first outcome of its draws must lead to the same."""
        number, seen = self._search.branching.first(partial(self._search.reset_from, copy))[:2]
        self._compare([(Fraction(1), *self._first_start)], [(Fraction(1), number, seen)], copy)

    def check(self, copy: bytes) -> None:
        """It must lead to the same, whatever it draws; of many outcomes, some that numpy draws are tried."""
        if len(self.starts) > _FEW_STARTS and all(map(partial(self._is_same, copy), range(_SEEDS))):
            return
        found = self._search.merged(partial(self._search.reset_from, copy))
        self._compare([each[:3] for each in self.starts], [each[:3] for each in found], copy)

    def _is_same(self, copy: bytes, seed: int) -> bool:
        """Whether it leads to the same as the first with the same draws."""
        after = []
        for each in (self._first, copy):
            with self._search.branching.drawing(np.random.default_rng(seed)):
                after.append(self._search.reset_from(each)[:2])
        return after[0] == after[1]

    def _compare(self, usual: list[Start], found: list[Start], copy: bytes) -> None:
        """Both must be the same, or states that turn out to be alike, which are tried too."""
        if sorted(usual) == sorted(found):
            return
        self._others.setdefault((tuple(usual), tuple(found)), copy)
        if len(self._others) > _MOST_RESETS:
            self._refuse(copy)
        self._search.open(number for _, number, _ in found)

    def check_others(self, classes: Sequence[int]) -> None:
        """Those that led elsewhere must have led to states of the same classes."""
        for (usual, found), copy in self._others.items():
            before, after = (
                summed(((classes[number], seen), probability) for probability, number, seen in starts)
                for starts in (usual, found)
            )
            if before != after:
                self._refuse(copy)

    def _refuse(self, copy: bytes) -> NoReturn:
        usual, found = self._values_after(self._first), self._values_after(copy)
        outer, inner = (differing(*each) for each in zip(usual, found, strict=True))
        changed = ", ".join(innermost(outer, inner)) or "nothing"
        raise self._search.refusal(
            f"a reset does not always lead to the same state (in {changed}), so its "
            "states cannot be enumerated from one start; set all of it in reset(), or name what does not "
            "matter in env.ignore"
        )

    def _values_after(self, copy: bytes) -> tuple[dict[str, set[bytes]], dict[str, set[bytes]]]:
        """The contents of attributes, and of what they hold, after all outcomes of a reset."""
        values: dict[str, set[bytes]] = {}
        inner: dict[str, set[bytes]] = {}
        search = self._search

        def reset() -> Any:
            result = search.reset_from(copy)
            for (_, name), value in search.layers.values(search.ignore).items():
                values.setdefault(name, set()).add(value)
            for name, held in (each for layer in search.layers.layers for each in held_by(layer)):
                if is_plain(held):
                    inner.setdefault(name, set()).add(content(held))
            return result

        search.branching.outcomes(reset)
        return values, inner
