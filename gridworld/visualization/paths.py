"""Where actions and policies lead on the board: arrows, and the greedy path from the start.

The arrow of an action that moves the same way nearly everywhere points that way everywhere, also where a
border stops it or chance diverts it. The arrow of another one, such as "forward" of an agent that turns,
points where the action leads in each state.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from gridworld.envs.board import board_of
from gridworld.envs.rendering import AGENT
from gridworld.visualization.canvas import Canvas
from gridworld.world.grid import GridMdp
from gridworld.world.layout import MOVES
from gridworld.world.mdp import BoolArray, FloatArray, IntArray, Mdp

_SAME_WAY = 0.9  # of the moves' lengths that add up in one direction: the exceptions are borders and falls
_MOSTLY = 0.5  # the same, where chance diverts moves
_MOST_STARTS = 4  # of a distribution; paths from more would cover the map


def directions(mdp: Mdp) -> IntArray:
    """How far down and right each action's arrow points, (S, A, 2): -1, 0 or 1; 0, 0 for no arrow."""
    if isinstance(mdp, GridMdp):
        return np.broadcast_to(np.array(MOVES), (mdp.num_states, mdp.num_actions, 2))
    cell = board_of(mdp).cell
    can_act = (cell >= 0).all(axis=1) & (mdp.reachable & ~mdp.terminal)
    move = cell[mdp.next_state] - cell[:, None, None]
    # Moves to a cell that is not next to the first, as a fall back to the start, count as none.
    is_near = (np.abs(move).max(axis=-1) == 1) & can_act[:, None, None]
    chance = mdp.probability * is_near * (cell[mdp.next_state] >= 0).all(axis=-1)
    moves, certain = (chance[..., None] * move).sum(axis=2), chance.max(axis=2) == 1
    total, length = moves.sum(axis=0), np.hypot(*np.moveaxis(moves, -1, 0)).sum(axis=0)
    agreement = np.hypot(*total.T) / np.maximum(length, 1e-9)
    usual = np.where((agreement >= _MOSTLY)[:, None], _signs(total), 0)
    by_state = (agreement < _SAME_WAY)[:, None] & certain[..., None]
    return np.where(by_state, _signs(moves), usual)


def _signs(moves: FloatArray) -> IntArray:
    """(..., 2): the nearest of the eight directions."""
    longest = np.abs(moves).max(axis=-1, keepdims=True)
    signs: IntArray = np.rint(moves / np.maximum(longest, 1e-9)).astype(np.intp)
    return signs


def moving_actions(mdp: Mdp) -> tuple[int, ...] | None:
    """The actions that move up, right, down and left; None where these are not all that there are."""
    arrows = directions(mdp)
    if mdp.num_actions != len(MOVES) or (arrows != arrows[:1]).any():
        return None
    ways = [tuple(way) for way in arrows[0].tolist()]
    return tuple(ways.index(move) for move in MOVES) if set(ways) == set(MOVES) else None


def greedy_paths(mdp: Mdp, greedy: IntArray) -> list[list[int]]:
    """Follow the greedy policy (S,) from each start, each time to the most probable next state.

    A path ends with the episode, or with the first state that comes twice. There are none from more than four
    start states.
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


def draw_paths(canvas: Canvas, paths: list[list[int]], ways: list[list[int]], middle: float) -> None:
    """A ring around each start, and lines through the states where one is next to the last.

    `ways` are each state's arrow, down and right; lines are `middle` of a cell below its upper edge.
    """
    place = canvas.board.place
    for path in paths:
        placed, lines = [state for state in path if place[state][0] >= 0], []
        for state, following in pairwise(placed):
            down, right = place[following][0] - place[state][0], place[following][1] - place[state][1]
            if abs(down) + abs(right) <= 1 or [down, right] == ways[state]:  # which may be along a diagonal
                lines.append((canvas.point(state, 0.5, middle), canvas.point(following, 0.5, middle)))
                if canvas.mdp.terminal[following] and canvas.has_grid:  # what is drawn there stays whole
                    (x, y), (to_x, to_y) = lines[-1]
                    lines[-1] = (x, y), ((x + to_x) / 2, (y + to_y) / 2)
        canvas.line(lines, AGENT)
        if placed:
            canvas.ring(canvas.point(placed[0], 0.5, middle), AGENT)


def explored(mdp: Mdp, visits: NDArray[np.int64] | None) -> BoolArray:
    """The states (S,) that training acted in; without visits (S, A), those that can be reached."""
    if visits is not None and visits.any():
        return np.asarray(visits.any(axis=1))
    return mdp.reachable
