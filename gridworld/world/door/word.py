"""What a user leaves out of the state must not matter: episodes played beside what was found without it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np

from gridworld.world.door.beliefs import Step

if TYPE_CHECKING:
    from gridworld.world.door.search import Search

NO_LIMIT = "it truncates some episodes earlier than others, so it has no single step limit"
_STEPS, _EPISODES = 3_000, 8  # at least
_LONGEST, _LONG = 10_000, 300  # steps of the first of them, and of others before any action is taken


def check_by_word(search: Search) -> int | None:
    """Play with numpy's own generator; returns when the environment cuts episodes, if it does."""
    numbers, steps, episode = np.random.default_rng(0), 0, 0
    limit: int | None = None
    search.branching.sampling = np.random.default_rng(1)
    try:
        while steps < _STEPS or episode < _EPISODES:
            lives = _LONGEST if episode == 0 else int(numbers.integers(1, _LONG))
            took, is_cut = _episode(search, numbers, lives)
            if (is_cut and limit not in (None, took)) or (limit is not None and took > limit):
                raise search.refusal(NO_LIMIT)
            limit = took if is_cut else limit
            steps, episode = steps + took, episode + 1
    finally:
        search.branching.sampling = None
    return limit


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
        if found not in [tuple(step[1:5]) for step in rows[action]]:
            _refuse(search, took, found, rows[action])
        if terminated or truncated:
            return took, bool(truncated and not terminated)


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
