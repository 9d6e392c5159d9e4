"""Where an action's arrow points: how it moves the agent on the board.

The arrow of an action that moves the same way nearly everywhere points that way everywhere, also where a
border stops it or chance diverts it. The arrow of another one, such as "forward" of an agent that turns,
points where the action leads in each state.
"""

from __future__ import annotations

import numpy as np

from gridworld.envs.board import board_of
from gridworld.world.grid import GridMdp
from gridworld.world.layout import MOVES
from gridworld.world.mdp import FloatArray, IntArray, Mdp

_SAME_WAY = 0.9  # of the moves' lengths that add up in one direction: the exceptions are borders and falls
_MOSTLY = 0.5  # the same, where chance diverts moves


def directions(mdp: Mdp) -> IntArray:
    """How far down and right each action's arrow points, (S, A, 2): -1, 0 or 1; 0, 0 for no arrow."""
    if isinstance(mdp, GridMdp):
        return np.broadcast_to(np.array(MOVES), (mdp.num_states, mdp.num_actions, 2))
    moves, certain = _moves(mdp)
    total, length = moves.sum(axis=0), np.hypot(*np.moveaxis(moves, -1, 0)).sum(axis=0)
    agreement = np.hypot(*total.T) / np.maximum(length, 1e-9)
    usual = np.where((agreement >= _MOSTLY)[:, None], _signs(total), 0)
    by_state = (agreement < _SAME_WAY)[:, None] & certain[..., None]
    return np.where(by_state, _signs(moves), usual)


def moving_actions(mdp: Mdp) -> tuple[int, ...] | None:
    """The actions that move up, right, down and left; None where these are not all that there are."""
    arrows = directions(mdp)
    if mdp.num_actions != len(MOVES) or (arrows != arrows[:1]).any():
        return None
    ways = [tuple(way) for way in arrows[0].tolist()]
    return tuple(ways.index(move) for move in MOVES) if set(ways) == set(MOVES) else None


def _moves(mdp: Mdp) -> tuple[FloatArray, IntArray]:
    """The expected move of each action, (S, A, 2), and where it is a certain one, (S, A).

    Moves to a cell that is not next to the first, as a fall back to the start, count as none.
    """
    board = board_of(mdp)
    cell, has_cell = board.cell, (board.cell >= 0).all(axis=1) & (mdp.reachable & ~mdp.terminal)
    move = cell[mdp.next_state] - cell[:, None, None]
    beside = (np.abs(move).max(axis=-1) == 1) & has_cell[:, None, None]
    chance = mdp.probability * beside * (cell[mdp.next_state] >= 0).all(axis=-1)
    return (chance[..., None] * move).sum(axis=2), chance.max(axis=2) == 1


def _signs(moves: FloatArray) -> IntArray:
    """(..., 2): the nearest of the eight directions."""
    longest = np.abs(moves).max(axis=-1, keepdims=True)
    signs: IntArray = np.rint(moves / np.maximum(longest, 1e-9)).astype(np.intp)
    return signs
