"""The board as a canvas: cells in colours, numbers in them, a caption above, a legend below.

It looks as the environment's own frame does: the same grid, walls, cliffs, traps and goals, and a border of
at least a cell all round, which holds the words. Cells are painted by one look-up for the whole picture, so
40,000 of them cost no more calls than 30.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gridworld.envs import rendering as drawing
from gridworld.envs.board import Kind, board_of
from gridworld.envs.rendering import UNKNOWN, Colour, Frame, Point
from gridworld.visualization.sheet import (
    INK,
    PAPER,
    UNREACHABLE,
    ColourArray,
    Scale,
    Sheet,
    Swatch,
    is_dark,
    short,
)
from gridworld.world.layout import MOVES
from gridworld.world.mdp import BoolArray, FloatArray, IntArray, Mdp

_LONGEST_SIDE = 640  # pixels, of the grid with its border
_LONGEST_MOSAIC = 1000  # pixels, of several panels
_LARGEST_CELL = 80  # pixels
_NO_GRID = 8  # pixels; on smaller cells grid lines would hide the colours
_SMALLEST_SEPARATED_CELL = 24  # pixels
_SEPARATOR: Colour = (205, 205, 205)
_FLOOR = int(Kind.FLOOR)
_COLOURS = {  # of the cells that have no numbers
    Kind.BLANK: PAPER,
    Kind.UNREACHABLE: UNKNOWN,
    Kind.FLOOR: PAPER,
    Kind.WALL: drawing.WALL,
    Kind.CLIFF: drawing.CLIFF,
    Kind.GOAL: drawing.GOAL,
    Kind.TRAP: drawing.TRAP,
}
_WITHOUT_GRID = np.array([_COLOURS[kind] for kind in Kind], dtype=np.uint8)
_WITH_GRID = _WITHOUT_GRID.copy()
_WITH_GRID[[Kind.GOAL, Kind.TRAP]] = PAPER  # below what is drawn there


class Canvas(Sheet):
    """A picture of a world that has places. Raises `InputError` where it would be too large to draw."""

    def __init__(self, mdp: Mdp, cell_size: int | None = None, legend_rows: int = 1) -> None:
        self.mdp, self.board = mdp, board_of(mdp)
        if cell_size is None:
            longest = _LONGEST_SIDE if len(self.board.panels) <= 1 else _LONGEST_MOSAIC
            cell_size = drawing.fitting_cell_size(mdp, longest, _LARGEST_CELL)
        width, height = drawing.frame_size(mdp, cell_size)
        super().__init__(width, height, cell_size, legend_rows, cell_size if mdp.panel_names else 0)

    def point(self, state: int, right: float, down: float) -> Point:
        """The point that many cells right of and below the state's corner, in pixels of `world`."""
        row, col = self.board.place[state]
        return (col + 1 + right) * self.cell, (row + 1 + down) * self.cell

    @property
    def hidden(self) -> bool:
        """Whether there are cells whose states cannot be reached."""
        return bool((self.board.kind == Kind.UNREACHABLE).any())

    @property
    def has_grid(self) -> bool:
        """Whether cells are large enough for lines between them."""
        return self.cell >= _NO_GRID

    def paint(self, colours: ColourArray, parts: NDArray[np.intp] | None = None) -> None:
        """Fill the cells with the colours (S, P, 3) of their P parts.

        `parts` (cell, cell) says which part each pixel of a cell belongs to; None: all to the first.
        """
        board, cell = self.board, self.cell
        cells, is_fixed = colours[board.state], board.kind != _FLOOR
        fixed = _WITH_GRID if self.has_grid else _WITHOUT_GRID
        cells[is_fixed] = fixed[board.kind[is_fixed]][:, None]
        packed = np.full((*cells.shape[:3], 4), 255, dtype=np.uint8)
        packed[..., :3] = cells
        pixels = packed.view(np.uint32)[..., 0]
        if parts is None:
            picture = np.repeat(np.repeat(pixels[..., 0], cell, axis=0), cell, axis=1)
        else:
            picture = pixels[:, :, parts].transpose(0, 2, 1, 3)
        size = (board.cols * cell, board.rows * cell)
        image = drawing.import_pygame().image.frombuffer(np.ascontiguousarray(picture), size, "RGBX")
        self.world.blit(image, (cell, cell))

    def draw_world(self) -> None:
        """Grid lines, traps and goals over what was painted; on small cells a line around each panel."""
        if self.has_grid:
            drawing.draw_grid(self.world, self.board, self.cell)
            drawing.draw_terminals(self.world, self.board, self.cell)
            return
        for panel in self.board.panels:
            left, top = (panel.left + 1) * self.cell - 1, (panel.top + 1) * self.cell - 1
            box = (left, top, panel.cols * self.cell + 2, panel.rows * self.cell + 2)
            drawing.import_pygame().draw.rect(self.world, INK, box, 1)

    def draw_numbers(
        self, numbers: FloatArray, scale: Scale, low: str, high: str, missing: str, caption: str
    ) -> Frame:
        """The finished picture of numbers (S, 1), or (S, 4) in the order of `MOVES`, a triangle for each.

        NaN is left white, which the legend calls `missing`; `low` and `high` name the scale's ends.
        """
        playable, known, by_move = shown(self.mdp), np.isfinite(numbers), numbers.shape[1] > 1
        colours = scale.colours(np.where(known, numbers, scale.low))
        colours[~known] = PAPER
        if by_move:
            separators = np.full((len(numbers), 1, 3), _SEPARATOR, dtype=np.uint8)
            self.paint(np.concatenate([colours, separators], axis=1), self._triangles())
        else:
            self.paint(colours)
        self.draw_world()
        known &= playable[:, None]
        texts = {number: short(number, scale.high) for number in set(numbers[known].tolist())}
        size = self.number_size(0.36 if by_move else 0.8, texts.values())
        dark = is_dark(colours)
        for state, part in np.argwhere(known).tolist() if size is not None else []:
            down, right = MOVES[part] if by_move else (0, 0)
            middle = self.point(state, 0.5 + 0.29 * right, 0.5 + 0.33 * down)
            ink = PAPER if dark[state, part] else INK
            self.number(texts[float(numbers[state, part])], middle, size or 0, ink)
        self.caption(caption)
        unknown = [] if known[playable].all() else [Swatch(missing)]
        self.legend(scale, low, high, [*unknown, *([UNREACHABLE] if self.hidden else [])])
        return self.frame()

    def _triangles(self) -> NDArray[np.intp]:
        """(cell, cell), the number in `MOVES` of the triangle a pixel is in; 4 on the lines between them."""
        down, right = np.mgrid[: self.cell, : self.cell]
        upper, other = down - right, down + right - self.cell  # signs tell the side of the two diagonals
        parts = np.where(upper < 0, np.where(other < 0, 0, 1), np.where(other < 0, 3, 2))
        if self.cell >= _SMALLEST_SEPARATED_CELL:
            parts[(upper == 0) | (other == 0)] = len(MOVES)
        return parts.astype(np.intp)

    def mark(self, states: IntArray, colour: Colour) -> None:
        """A frame inside each of these cells, edged in white; a dot where the cells are small."""
        rect, cell = drawing.import_pygame().draw.rect, self.cell
        thick, dot = max(1, cell // 14), max(1, cell // 2)
        for state in states.tolist():
            left, top = (round(side) for side in self.point(state, 0, 0))
            if not self.has_grid:
                self.world.fill(colour, (left + cell // 4, top + cell // 4, dot, dot))
                continue
            if thick > 1:  # tells it from a colour as light as its own
                inner = cell - 1 - 2 * thick
                rect(self.world, PAPER, (left + 1 + thick, top + 1 + thick, inner, inner), 1)
            rect(self.world, colour, (left + 1, top + 1, cell - 1, cell - 1), thick)

    def line(self, segments: Sequence[tuple[Point, Point]], colour: Colour) -> None:
        """Draw lines between points of `world`, edged in white; thin on small cells."""
        thick = max(1, self.cell // 10)
        edge = 2 if self.cell >= 5 * _NO_GRID else 1 if self.cell >= 2 * _NO_GRID else 0
        for half, ink in ((thick / 2 + edge, PAPER), (thick / 2, colour)) if edge else ((0.5, colour),):
            for (x, y), (to_x, to_y) in segments:
                if x != to_x and y != to_y:
                    draw = drawing.import_pygame().draw
                    draw.line(self.world, ink, (x, y), (to_x, to_y), round(2.8 * half))
                    continue
                left, top = round(min(x, to_x) - half), round(min(y, to_y) - half)
                size = round(abs(x - to_x) + 2 * half), round(abs(y - to_y) + 2 * half)
                self.world.fill(ink, (left, top, *size))

    def ring(self, middle: Point, colour: Colour) -> None:
        """Draw a ring around a point of `world`, edged in white; a dot on small cells."""
        circle = drawing.import_pygame().draw.circle
        radius, thick = max(2, round(0.36 * self.cell)), max(1, self.cell // 14)
        if self.cell >= 2 * _NO_GRID:
            circle(self.world, PAPER, middle, radius + 1, thick + 3)
        circle(self.world, colour, middle, radius, thick if self.has_grid else 0)


def shown(mdp: Mdp) -> BoolArray:
    """Which states' cells an agent can act in, (S,)."""
    return board_of(mdp).floor
