"""Pictures of a world without places: a table with a row for each state and a column for each action.

The rows are in the order in which an agent comes to the states: by the fewest steps from a start. Where there
are too many states, those remain that training visited most.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gridworld.agents import PolicySnapshot
from gridworld.envs.rendering import (
    AGENT,
    SMALLEST_TEXT,
    UNKNOWN,
    Colour,
    Frame,
    import_pygame,
    text_size,
    text_width,
    write,
)
from gridworld.visualization.colormaps import BLUES, ORANGES, VIRIDIS, Scale, counting, is_dark, linear
from gridworld.visualization.sheet import DISAGREES, INK, NEVER_VISITED, PAPER, Sheet, Swatch, short
from gridworld.world.mdp import BoolArray, FloatArray, IntArray, Mdp

_MOST_ROWS = 24
_ROW = 24  # pixels
_TEXT = 14  # pixels
_WIDTH = 640  # pixels, of all columns
_NARROWEST, _WIDEST = 8, 80  # pixels, of a column

_GREEDY = Swatch("greedy action", frame=AGENT, thick=2)
_WRONG = Swatch("greedy, not optimal", frame=DISAGREES, thick=2)


def table_states(mdp: Mdp, visits: NDArray[np.int64] | None = None) -> IntArray:
    """Choose the states of a table.

    Args:
        mdp: the world.
        visits: (S, A), how often training took each action in each state.

    Returns:
        (rows,), in the order of the table; states that are over or cannot be reached are none of them.
    """
    states = np.flatnonzero(mdp.reachable & ~mdp.terminal)
    states = states[np.argsort(mdp.steps_away[states], kind="stable")]
    counts = np.zeros(len(states)) if visits is None else visits[states].sum(axis=1)
    most_visited = np.argsort(-counts, kind="stable")[:_MOST_ROWS]
    return states[np.sort(most_visited)]


@dataclass(frozen=True, eq=False)
class Numbers:
    """What a policy's table shows of each action.

    Attributes:
        name: of the numbers.
        table: (S, A); NaN is left white.
        scale: their colours.
        written: whether they are written into their cells too.
    """

    name: str
    table: FloatArray
    scale: Scale
    written: bool = True


def held(snapshot: PolicySnapshot, states: IntArray) -> Numbers:
    """What an agent holds of its actions, scaled by these states: Q, or probabilities where it has no Q."""
    if snapshot.q is None:
        return Numbers("probability", snapshot.sampled, Scale(VIRIDIS, 0.0, 1.0))
    return Numbers("Q", snapshot.q, linear(VIRIDIS, snapshot.q[states]))


class StateTable(Sheet):
    """A table under construction.

    Args:
        mdp: the world.
        states: (rows,), see `table_states`.
        columns: their names.
        legend_rows: 1 or 2.
    """

    def __init__(self, mdp: Mdp, states: IntArray, columns: Sequence[str], legend_rows: int = 1) -> None:
        names = [mdp.state_name(state) for state in states.tolist()]
        hidden = int((mdp.reachable & ~mdp.terminal).sum()) - len(states)
        self._label = max((text_width(name, _TEXT) for name in names), default=0) + _ROW // 2
        self._column = max(_NARROWEST, min(_WIDEST, _WIDTH // len(columns)))
        self._states = states
        width = self._label + len(columns) * self._column
        rows = 1 + len(states) + (hidden > 0)
        super().__init__(width + 2 * _ROW, (rows + 2) * _ROW, _ROW, legend_rows)
        for row, name in enumerate(names):
            write(self.world, name, _ROW, self._middle(row), _TEXT)
        room = self._column - 4
        sizes = [text_size(name, _TEXT, room) for name in columns]
        for column, (name, size) in enumerate(zip(columns, sizes, strict=True)):
            if size is not None and None not in sizes:
                left = self._left(column) + (self._column - text_width(name, size)) // 2
                write(self.world, name, left, self._middle(-1), size)
        if hidden:
            line = f"and {hidden:,} more states, visited less or further from the start"
            size = text_size(line, _TEXT, width) or SMALLEST_TEXT
            write(self.world, line, _ROW, self._middle(len(states)) + 3, size)

    def _left(self, column: int) -> int:
        return _ROW + self._label + column * self._column

    def _middle(self, row: int) -> int:
        return (2 + row) * _ROW + _ROW // 2

    def paint(self, numbers: Numbers, known: BoolArray | None = None) -> None:
        """Fill the cells.

        Args:
            numbers: a column for each of the table's.
            known: (S,), the states whose numbers mean anything; the rows of others are grey. None: all.
        """
        values = numbers.table[self._states]
        rows = np.ones(len(values), dtype=np.bool_) if known is None else known[self._states]
        there = np.isfinite(values) & rows[:, None]
        colours = numbers.scale.colours(np.where(there, values, numbers.scale.low))
        colours[~there] = PAPER
        colours[~rows] = UNKNOWN
        for row, column in np.ndindex(*values.shape):
            self.world.fill(colours[row, column].tolist(), self._box(row, column))
            import_pygame().draw.rect(self.world, INK, self._box(row, column), 1)
        texts = {value: short(value, numbers.scale.high) for value in set(values[there].tolist())}
        size = min((text_size(text, _TEXT, 0.8 * self._column) or 0 for text in texts.values()), default=0)
        dark = is_dark(colours)
        for row, column in np.argwhere(there).tolist() if numbers.written and size else []:
            middle = self._left(column) + self._column / 2, self._middle(row)
            ink = PAPER if dark[row, column] else INK
            self.number(texts[float(values[row, column])], middle, size, ink)

    def mark(self, row: int, column: int, colour: Colour) -> None:
        """A frame inside a cell, edged in white."""
        left, top, width, height = self._box(row, column)
        rect = import_pygame().draw.rect
        rect(self.world, PAPER, (left + 1, top + 1, width - 2, height - 2), 3)
        rect(self.world, colour, (left + 1, top + 1, width - 2, height - 2), 2)

    def _box(self, row: int, column: int) -> tuple[int, int, int, int]:
        return self._left(column), (2 + row) * _ROW, self._column + 1, _ROW + 1


def draw_policy_table(
    mdp: Mdp,
    states: IntArray,
    numbers: Numbers,
    greedy: IntArray,
    optimal: BoolArray,
    known: BoolArray,
    caption: str = "",
) -> Sheet:
    """Draw what an agent holds of its actions as colours, with a frame around the greedy one.

    Args:
        mdp: the world.
        states: (rows,), see `table_states`.
        numbers: see there.
        greedy: (S,), the action that it would take.
        optimal: (S, A), whether an action is optimal.
        known: (S,), the states that training acted in; the others are grey.
        caption: a line above the table.

    Returns:
        The finished picture.
    """
    table = StateTable(mdp, states, mdp.action_names, legend_rows=2)
    table.paint(numbers, known)
    for row, state in enumerate(states.tolist()):
        action = int(greedy[state])
        table.mark(row, action, AGENT if optimal[state, action] else DISAGREES)
    table.caption(caption)
    never = [] if known[states].all() else [NEVER_VISITED]
    low, high = short(numbers.scale.low, numbers.scale.high), short(numbers.scale.high)
    table.legend(numbers.scale, f"{numbers.name} {low}", high, [_GREEDY, _WRONG, *never])
    return table


def draw_error_table(mdp: Mdp, states: IntArray, error: FloatArray, caption: str = "") -> Frame:
    """Draw errors (S, A), or (S, 1) of values, as colours; NaN is left white."""
    table = StateTable(mdp, states, mdp.action_names if error.shape[1] == mdp.num_actions else ["V"])
    scale = linear(ORANGES, error[states], low=0.0)
    table.paint(Numbers("error", error, scale))
    table.caption(caption)
    swatches = [] if np.isfinite(error[states]).all() else [Swatch("no finite optimum")]
    table.legend(scale, "error 0", short(scale.high), swatches)
    return table.frame()


def draw_visit_table(mdp: Mdp, states: IntArray, visits: NDArray[np.int64], caption: str = "") -> Frame:
    """Draw counts (S, A) as colours, on a logarithmic scale where they span decades."""
    table = StateTable(mdp, states, mdp.action_names)
    scale = counting(BLUES, visits[states])
    table.paint(Numbers("visits", np.where(visits > 0, visits, np.nan), scale))
    table.caption(caption)
    kind = ", log scale" if scale.logarithmic else ""
    never = [Swatch("never")] if (visits[states] == 0).any() else []
    table.legend(scale, f"visits {short(scale.low)}", f"{short(scale.high)}{kind}", never)
    return table.frame()
