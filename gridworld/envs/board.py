"""What a picture of a world lies on: cells in rows and columns, and what is in each.

The states of a map lie in one panel. Other worlds may have several (`Mdp.places`), in rows and columns with a
blank one between two. A world without places has no panels; its pictures are tables and cards of text.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from enum import IntEnum
from weakref import WeakKeyDictionary

import numpy as np

from gridworld.world.grid import GridMdp
from gridworld.world.mdp import BoolArray, IntArray, Mdp, frozen

_CARD = 1, 4  # rows and columns of the text that stands for a world without places


class Kind(IntEnum):
    """What is in a cell: no state, one that no episode comes to, and so on."""

    BLANK = 0
    UNREACHABLE = 1
    FLOOR = 2
    WALL = 3
    CLIFF = 4
    GOAL = 5
    TRAP = 6


@dataclass(frozen=True)
class Panel:
    """A part of the board, from its first cell on."""

    top: int
    left: int
    rows: int
    cols: int
    name: str = ""


@dataclass(frozen=True, eq=False)
class Board:
    """The cells of a world's pictures, `rows` high and `cols` wide."""

    rows: int
    cols: int
    panels: tuple[Panel, ...]  # none for a world without places
    cell: IntArray  # (S, 2), row and column of each state's cell; -1 where it has none
    state: IntArray  # (rows, cols), the state that each cell shows; -1 where it shows none
    kind: IntArray  # (rows, cols), a `Kind` each

    @functools.cached_property
    def place(self) -> list[list[int]]:
        """`cell` as a list, which is faster to ask for one state after the other."""
        places: list[list[int]] = self.cell.tolist()
        return places

    @functools.cached_property
    def cells(self) -> dict[Kind, list[list[int]]]:
        """Row and column of all cells of each kind."""
        return {kind: np.argwhere(self.kind == kind).tolist() for kind in Kind}

    @functools.cached_property
    def floor(self) -> BoolArray:
        """(S,), the states that are shown and that an agent can act in."""
        shown = np.zeros(len(self.cell), dtype=np.bool_)
        shown[self.state[self.kind == Kind.FLOOR]] = True
        return frozen(shown)


_boards: WeakKeyDictionary[Mdp, Board] = WeakKeyDictionary()


def board_of(mdp: Mdp) -> Board:
    """The board of a world, made once. Of two states in one place the first that can be reached is shown."""
    if mdp not in _boards:
        if mdp.places is None:
            tables = np.full((mdp.num_states, 2), -1), np.full(_CARD, -1), np.full(_CARD, Kind.BLANK)
            _boards[mdp] = Board(*_CARD, (), *map(frozen, tables))
        else:
            _boards[mdp] = _board(mdp, mdp.places)
    return _boards[mdp]


def _board(mdp: Mdp, places: IntArray) -> Board:
    panels = _mosaic(mdp, places)
    rows = max(panel.top + panel.rows for panel in panels)
    cols = max(panel.left + panel.cols for panel in panels)
    has_place: BoolArray = np.all(places >= 0, axis=1)
    corners = np.array([(panel.top, panel.left) for panel in panels])
    cell = np.where(has_place[:, None], places[:, 1:] + corners[places[:, 0]], -1)

    known = np.ones(mdp.num_states, dtype=np.bool_) if isinstance(mdp, GridMdp) else mdp.reachable
    order = np.argsort(~known, kind="stable")
    drawn = order[has_place[order]][::-1]  # of several in a cell the last one written is the first in order
    state = np.full((rows, cols), -1)
    state[tuple(cell[drawn].T)] = drawn

    kinds = np.where(known, Kind.FLOOR, Kind.UNREACHABLE)
    if isinstance(mdp, GridMdp):
        kinds[mdp.wall], kinds[mdp.cliff] = Kind.WALL, Kind.CLIFF
    kinds[mdp.goal], kinds[mdp.trap] = Kind.GOAL, Kind.TRAP
    kind = np.where(state >= 0, kinds[state], Kind.BLANK)
    return Board(rows, cols, panels, frozen(cell), frozen(state), frozen(kind))


def _mosaic(mdp: Mdp, places: IntArray) -> tuple[Panel, ...]:
    """Panels of one size in an arrangement as near to a square as possible."""
    count, rows, cols = (int(last) + 1 for last in places.max(axis=0))

    def longest_side(across: int) -> int:
        return max(across * (cols + 1), -(-count // across) * (rows + 1))

    across = min(range(1, count + 1), key=longest_side)
    names = (*mdp.panel_names, *[""] * count)
    return tuple(
        Panel(number // across * (rows + 1), number % across * (cols + 1), rows, cols, names[number])
        for number in range(count)
    )
