"""Walks with numpy's own generator, to see what changes and whether it repeats."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from gridworld.world.door.search import Search

_WALKS, _WALK = 20, 10  # walks, and the steps of each


def walk(search: Search, kind: type) -> list[Any]:
    """What some walks with numpy's own generator and actions of a type show."""
    numbers, shown = np.random.default_rng(0), list[Any]()
    search.branching.sampling = np.random.default_rng(1)
    try:
        for _ in range(_WALKS):
            shown.append(search.see(search.layers.env.reset()[0]))
            for _ in range(_WALK):
                observation, reward, *over, _ = search.layers.env.step(
                    kind(numbers.integers(search.num_actions))
                )
                paid = np.asarray(reward, np.float64).tobytes()
                shown += [search.see(observation), paid, *map(bool, over)]
                if any(over):
                    break
    except Exception as error:  # which the search meets too, and refuses
        shown.append(str(error))
    finally:
        search.branching.sampling = None
    return shown
