"""Walks with numpy's own generator, to see what changes and whether it repeats."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from gridworld.world.door.search import Search

_WALKS, _WALK = 20, 10  # walks, and the steps of each


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
            look(True)
            if fails:
                break
    return shown


def _steps(search: Search, kind: type, numbers: np.random.Generator) -> Iterator[Any]:
    yield search.seen.digest(search.layers.env.reset(**search.layers.reset_options)[0])
    for _ in range(_WALK):
        if search.layers.counters:  # whose stand-ins come with a copy
            search.layers.put(search.layers.take())
        observation, reward, *over, _ = search.layers.env.step(kind(numbers.integers(search.num_actions)))
        yield search.seen.digest(observation), np.asarray(reward, np.float64).tobytes(), *map(bool, over)
        if any(over):
            return
