"""Small worlds from the literature on exploration and prediction.

A state's place in pictures is its place in the literature's drawings: a row of states, or a square of them.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from gridworld.base.errors import InputError
from gridworld.world.mdp import Mdp, grid_places
from gridworld.world.outcomes import MOST_ACTIONS, MOST_STATES
from gridworld.world.sources.arrays import mdp_from_arrays

LEFT, RIGHT = 0, 1
_LEFT_RIGHT = ("left", "right")


def river_swim(length: int = 6) -> Mdp:
    """RiverSwim: against the current to a large reward, or with it to a small one.

    States 0 to length - 1 lie along a river. `left` swims one state back, with certainty; in state 0 it stays
    and pays 0.005. `right` swims against the current:

        state           one back   stays   one on
        0               -          0.4     0.6
        in between      0.05       0.6     0.35
        length - 1      0.4        0.6     -

    `right` in the last state pays 1, whatever its outcome; nothing else pays. Episodes start in state 0 and
    never terminate. The step limit is 20 for the 6 states of the literature, and in proportion to `length`.

    Sources: A. L. Strehl and M. L. Littman, An analysis of model-based interval estimation for Markov
    decision processes, 2008; the numbers are those of I. Osband, D. Russo and B. Van Roy, (More) efficient
    reinforcement learning via posterior sampling, 2013, whose published code has the step limit.
    """
    _check_whole("length", length, 2, MOST_STATES)
    state = np.arange(length)
    next_state = np.empty((length, 2, 3), dtype=np.int64)
    next_state[:, LEFT] = np.maximum(state - 1, 0)[:, None]
    next_state[:, RIGHT] = np.clip(state[:, None] + (-1, 0, 1), 0, length - 1)
    probability = np.zeros(next_state.shape)
    probability[:, LEFT, 0] = 1.0
    probability[:, RIGHT] = 0.05, 0.6, 0.35
    probability[0, RIGHT] = 0.0, 0.4, 0.6
    probability[-1, RIGHT] = 0.4, 0.6, 0.0
    reward = np.zeros(next_state.shape)
    reward[0, LEFT], reward[-1, RIGHT] = 0.005, 1.0
    return _world(
        f"RiverSwim {length}",
        next_state=next_state,
        reward=reward,
        terminated=np.zeros(next_state.shape, dtype=np.bool_),
        probability=probability,
        action_names=_LEFT_RIGHT,
        places=grid_places(1, length),
        max_episode_steps=-(-20 * length // 6),
    )


def deep_sea(size: int = 10, seed: int | None = None) -> Mdp:
    """DeepSea: one way of 2 ** size leads to the treasure, and each of its steps costs.

    A diver starts at the top left of a square of `size` by `size` cells and sinks one row a step. `right`
    moves one column to the right and costs 0.01 / size, `left` moves one to the left for nothing; at a border
    the column stays. `right` from the bottom right cell pays 1 more: the treasure. The step from the bottom
    row ends the episode, in a state without a place, with or without the treasure; only with it, it is a
    success. The best return is 0.99, by `right` all the way, that of never moving right is 0.

    With a `seed`, which action is right is drawn for each cell, as bsuite draws it for the same
    `mapping_seed`; without one it is action 1 everywhere. The step limit is `size`.

    Source: I. Osband et al., Behaviour suite for reinforcement learning, 2020: its deterministic `deep_sea`.
    """
    _check_whole("size", size, 2, 500)
    cells = size * size
    row, col = np.divmod(np.arange(cells), size)
    right = np.ones(cells, dtype=np.int64)
    if seed is not None:
        _check_whole("seed", seed, 0, 2**32 - 1)
        right = np.random.RandomState(seed).binomial(1, 0.5, [size, size]).reshape(-1)
    moves_right = np.arange(2)[None] == right[:, None]  # (cells, A)
    column = np.clip(col[:, None] + np.where(moves_right, 1, -1), 0, size - 1)
    bottom = (row == size - 1)[:, None]
    treasure = bottom & moves_right & (col == size - 1)[:, None]
    next_state = np.full((cells + 1, 2), cells)  # the last one is the end
    next_state[:cells] = np.where(bottom, cells, (row[:, None] + 1) * size + column)
    reward, terminated = np.zeros((cells + 1, 2)), np.ones((cells + 1, 2), np.bool_)
    reward[:cells] = np.where(moves_right, -0.01 / size, 0.0) + treasure
    terminated[:cells] = bottom
    success = np.zeros((cells + 1, 2), np.bool_)
    success[:cells] = treasure
    places = np.stack([np.zeros(cells, np.int64), row, col], axis=1)
    return _world(
        f"DeepSea {size}",
        next_state=next_state,
        reward=reward,
        terminated=terminated,
        success=success,
        action_names=_LEFT_RIGHT if seed is None else ("0", "1"),
        places=np.concatenate([places, [[-1, -1, -1]]]),
        max_episode_steps=size,
    )


def combination_lock(length: int = 10, num_actions: int = 2, seed: int | None = None) -> Mdp:
    """A combination lock: each state has one right action, and a wrong one leads back to the start.

    States 0 to length - 1 lie in a row; the episode starts in state 0. The right action of a state leads to
    the next one, any other to state 0, and nothing pays but the right action of the last state: 1, and the
    episode ends in the open lock, state `length`. A random policy needs about num_actions ** length steps.
    The step limit is 10 * length: of an attempt with each of ten random actions.

    With a `seed` the right actions are drawn; without one it is the last action of every state.

    Sources: S. D. Whitehead, Complexity and cooperation in Q-learning, 1991; S. Koenig and R. G. Simmons,
    Complexity analysis of real-time reinforcement learning, 1993 (the "reset state space").
    """
    _check_whole("length", length, 1, MOST_STATES - 1)
    _check_whole("num_actions", num_actions, 2, MOST_ACTIONS)
    right = np.full(length, num_actions - 1)
    if seed is not None:
        _check_whole("seed", seed, 0, 2**32 - 1)
        right = np.random.default_rng(seed).integers(num_actions, size=length)
    state = np.arange(length)
    next_state = np.zeros((length + 1, num_actions), dtype=np.int64)
    next_state[state, right] = state + 1
    reward, terminated = np.zeros(next_state.shape), np.zeros(next_state.shape, dtype=np.bool_)
    reward[length - 1, right[-1]], terminated[length - 1, right[-1]] = 1.0, True
    next_state[length], terminated[length] = length, True
    return _world(
        f"combination lock {length}",
        next_state=next_state,
        reward=reward,
        terminated=terminated,
        places=grid_places(1, length + 1),
        max_episode_steps=10 * length,
    )


def random_walk(length: int = 5) -> Mdp:
    """The random walk of Sutton and Barto: a chain whose right end pays 1.

    States 1 to length lie in a row (A to E in the book), with an end on either side, states 0 and length + 1.
    Episodes start in the middle. `left` and `right` move one state with certainty; entering the right end
    pays 1, all else nothing.

    In the book the walk is a Markov reward process without actions, for prediction. Here the agent chooses:
    the uniform policy is the book's process, with values 1/6, 2/6, ..., 5/6 at a discount of 1, and control
    has something to find. Its value is `Chain(mdp, uniform).value(1.0)`. The walk has no step limit.

    Source: R. Sutton and A. Barto, Reinforcement Learning, 2nd ed., 2018, example 6.2.
    """
    _check_whole("length", length, 1, MOST_STATES - 2)
    if length % 2 == 0:
        raise InputError(f"length={length}: must be odd, to start in the middle")
    state = np.arange(length + 2)
    next_state = np.stack([np.maximum(state - 1, 0), np.minimum(state + 1, length + 1)], axis=1)
    reward = np.zeros(next_state.shape)
    reward[length, RIGHT] = 1.0
    terminated = (next_state == 0) | (next_state == length + 1)
    return _world(
        f"random walk {length}",
        next_state=next_state,
        reward=reward,
        terminated=terminated,
        start=(length + 1) // 2,
        action_names=_LEFT_RIGHT,
        places=grid_places(1, length + 2),
    )


def _world(name: str, start: int = 0, **arrays: Any) -> Mdp:
    """The world of arrays, in the terms of `gridworld.world.sources.arrays`, that starts in one state."""
    first = np.eye(1, len(arrays["next_state"]), start)[0]
    return mdp_from_arrays(name, {"start": first, **arrays}, name)


def _check_whole(key: str, value: Any, least: int, most: int) -> None:
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or not least <= value <= most:
        raise InputError(f"{key}={str(value)[:50]}: must be a whole number from {least} to {most}")
