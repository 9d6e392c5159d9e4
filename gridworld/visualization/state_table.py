"""Pictures of a world without places: a table with a row for each state and a column for each action.

The rows are in the order in which an agent comes to the states: by the fewest steps from a start. Where there
are too many states, those remain that training visited most.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gridworld.envs import rendering as drawing
from gridworld.envs.rendering import INK, SMALLEST_TEXT, UNKNOWN, Colour, Frame, Point, text_size, text_width
from gridworld.visualization.sheet import PAPER, Scale, Sheet, Swatch, short, write
from gridworld.world.mdp import BoolArray, FloatArray, IntArray, Mdp

_MOST_ROWS = 24
_ROW = 24  # pixels
_TEXT = 14  # pixels
_WIDTH = 640  # pixels, of all columns
_NARROWEST, _WIDEST = 8, 80  # pixels, of a column


def table_states(mdp: Mdp, visits: NDArray[np.int64] | None = None) -> IntArray:
    """The live states (rows,) of a table, in its order; of many those with most `visits` (S, A)."""
    states = np.flatnonzero(mdp.reachable & ~mdp.terminal)
    states = states[np.argsort(mdp.steps_away[states], kind="stable")]
    counts = np.zeros(len(states)) if visits is None else visits[states].sum(axis=1)
    most_visited = np.argsort(-counts, kind="stable")[:_MOST_ROWS]
    return states[np.sort(most_visited)]


class StateTable(Sheet):
    """A table under construction; `states` (rows,) are those of `table_states`, `columns` are names."""

    def __init__(
        self, mdp: Mdp, states: IntArray, columns: Sequence[str], legend_rows: int = 1, opaque: bool = False
    ) -> None:
        names = [mdp.state_name(state) for state in states.tolist()]
        hidden = int((mdp.reachable & ~mdp.terminal).sum()) - len(states)
        self._label = max((text_width(name, _TEXT) for name in names), default=0) + _ROW // 2
        self._column = max(_NARROWEST, min(_WIDEST, _WIDTH // len(columns)))
        self.states = states
        width = self._label + len(columns) * self._column
        height = (3 + len(states) + (hidden > 0)) * _ROW
        super().__init__((width + 2 * _ROW, height), _ROW, legend_rows, opaque)
        for row, name in enumerate(names):
            write(self.world, name, _ROW, self._middle(row), _TEXT)
        sizes = [text_size(name, _TEXT, self._column - 4) for name in columns]
        for column, (name, size) in enumerate(zip(columns, sizes, strict=True)):
            if size is not None and None not in sizes:
                left = self.box(0, column)[0] + (self._column - text_width(name, size)) // 2
                write(self.world, name, left, self._middle(-1), size)
        if hidden:
            line = f"and {hidden:,} more states, visited less or further from the start"
            size = text_size(line, _TEXT, width) or SMALLEST_TEXT
            write(self.world, line, _ROW, self._middle(len(states)) + 3, size)

    def _middle(self, row: int) -> int:
        return (2 + row) * _ROW + _ROW // 2

    def box(self, row: int, column: int) -> tuple[int, int, int, int]:
        """Left, top, width and height of a cell, in pixels of `world`."""
        left = _ROW + self._label + column * self._column
        return left, (2 + row) * _ROW, self._column + 1, _ROW + 1

    def paint(
        self, table: FloatArray, scale: Scale, known: BoolArray | None = None, written: bool = True
    ) -> None:
        """Fill the cells with numbers (S, columns); NaN is white, rows that are not `known` (S,) grey."""
        values = table[self.states]
        rows = np.ones(len(values), dtype=np.bool_) if known is None else known[self.states]
        there = np.isfinite(values) & rows[:, None]
        colours = scale.colours(np.where(there, values, scale.low))
        colours[~there] = PAPER
        colours[~rows] = UNKNOWN
        for row, column in np.ndindex(*values.shape):
            self.world.fill(colours[row, column].tolist(), self.box(row, column))
            drawing.import_pygame().draw.rect(self.world, INK, self.box(row, column), 1)
        texts = [short(value, scale.high) for value in set(values[there].tolist())]
        size = min((text_size(text, _TEXT, 0.8 * self._column) or 0 for text in texts), default=0)

        def middle(row: int, column: int) -> Point:
            return self.box(row, column)[0] + self._column / 2, self._middle(row)

        self.write_numbers(values, there & written, colours, scale.high, size, middle)

    def mark(self, row: int, column: int, colour: Colour) -> None:
        """A frame inside a cell, edged in white."""
        left, top, width, height = self.box(row, column)
        rect = drawing.import_pygame().draw.rect
        rect(self.world, PAPER, (left + 1, top + 1, width - 2, height - 2), 3)
        rect(self.world, colour, (left + 1, top + 1, width - 2, height - 2), 2)

    def draw_numbers(self, table: FloatArray, scale: Scale, name: str, missing: str, caption: str) -> Frame:
        """The finished picture of numbers (S, columns); see `Canvas.draw_numbers`."""
        self.paint(table, scale)
        self.caption(caption)
        self.legend(scale, name, [] if np.isfinite(table[self.states]).all() else [Swatch(missing, PAPER)])
        return self.frame()
