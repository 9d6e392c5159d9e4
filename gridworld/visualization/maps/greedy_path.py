"""Where a greedy policy leads from the start, and which cells training knows anything of."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gridworld.world.mdp import BoolArray, IntArray, Mdp

_MOST_STARTS = 4  # of a distribution; paths from more would cover the map


def greedy_paths(mdp: Mdp, greedy: IntArray) -> list[list[int]]:
    """Follow the greedy policy, each time to the most probable next state.

    Args:
        mdp: the world.
        greedy: (S,), the action taken in each state.

    Returns:
        For each start state the states from it to the end of the episode, or to the first that comes twice;
        no path where there are more than four start states.
    """
    starts = mdp.start_states.tolist()
    likely = mdp.probability[np.arange(mdp.num_states), greedy].argmax(axis=1)
    following = mdp.next_state[np.arange(mdp.num_states), greedy, likely].tolist()
    paths = []
    for start in starts if len(starts) <= _MOST_STARTS else []:
        path, met = [start], {start}
        while not mdp.terminal[path[-1]]:
            path.append(following[path[-1]])
            if path[-1] in met:
                break
            met.add(path[-1])
        paths.append(path)
    return paths


def explored(mdp: Mdp, visits: NDArray[np.int64] | None) -> BoolArray:
    """Which states an agent can know of.

    Args:
        mdp: the world.
        visits: (S, A), how often training took each action in each state.

    Returns:
        (S,), those that training acted in; without any visits, those that can be reached from the start.
    """
    if visits is not None and visits.any():
        return np.asarray(visits.any(axis=1))
    return mdp.reachable
