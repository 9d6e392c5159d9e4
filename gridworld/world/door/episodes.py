"""Episodes with numpy's own generator, played next to what was found: each step must be one of its outcomes.

What a step does from a copy of the state may be another thing than what it does in an episode: where it
depends on what is not copied, or on what a user leaves out of the state.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np

from gridworld.world.door.beliefs import Step
from gridworld.world.door.limits import counted

if TYPE_CHECKING:
    from gridworld.world.door.search import Search

NO_LIMIT = (
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


def check_by_word(search: Search) -> int | None:
    """Play with numpy's own generator; returns when the environment cuts episodes, if it does."""
    numbers, steps, episode = np.random.default_rng(0), 0, 0
    limit: int | None = None
    with search.branching.drawing(np.random.default_rng(1)):
        while steps < _STEPS or episode < _EPISODES:
            lives = _LONGEST if episode == 0 else int(numbers.integers(1, _LONG))
            took, is_cut = _episode(search, numbers, lives)
            if (is_cut and limit not in (None, took)) or (limit is not None and took > limit):
                raise search.refusal(NO_LIMIT)
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
