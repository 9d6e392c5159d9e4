"""The board as a canvas: cells in colours, numbers in them, a caption above, a legend below, and paths.

It looks as the environment's own frame does: the same grid, walls, cliffs, traps and goals, and a border of
at least a cell all round, which holds the words. Cells are painted by one look-up for the whole picture, so
40,000 of them cost no more calls than 30.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from gridworld.envs import rendering as drawing
from gridworld.envs.rendering import AGENT, GOAL, UNKNOWN, Colour, Frame, Kind, Point, board_of
from gridworld.visualization.sheet import PAPER, UNREACHABLE, WORDS, ColourArray, Scale, Sheet, Swatch, disc
from gridworld.world.grid import GridMdp
from gridworld.world.layout import MOVES
from gridworld.world.mdp import BoolArray, FloatArray, IntArray, Mdp

_LONGEST_SIDE = 640  # pixels, of the grid with its border; twice as many where it is more than colours
_LONGEST_MOSAIC = 1000  # pixels, of several panels
_LARGEST_CELL = 80  # pixels, or twice as many
_NO_GRID = 8  # pixels; on smaller cells grid lines would hide the colours
_SMALLEST_SEPARATED_CELL = 24  # pixels
_SEPARATOR: Colour = (205, 205, 205)
_SAME_WAY = 0.9  # of the moves' lengths that add up in one direction: the exceptions are borders and falls
_MOSTLY = 0.5  # the same, where chance diverts moves
_MOST_STARTS = 4  # of a distribution; paths from more would cover the map
_COLOURS = {  # of the cells that have no numbers
    Kind.BLANK: PAPER,
    Kind.UNREACHABLE: UNKNOWN,
    Kind.FLOOR: PAPER,
    Kind.WALL: drawing.WALL,
    Kind.CLIFF: drawing.CLIFF,
    Kind.GOAL: GOAL,
    Kind.TRAP: drawing.TRAP,
}
_WITHOUT_GRID = np.array([_COLOURS[kind] for kind in Kind], dtype=np.uint8)
_WITH_GRID = _WITHOUT_GRID.copy()
_WITH_GRID[[Kind.GOAL, Kind.TRAP]] = PAPER  # below what is drawn there
_TRIANGLE = ((0.5, 0.2), (0.8, 0.8), (0.2, 0.8))  # the goal's, as frames have it


class Canvas(Sheet):
    """A picture of a world that has places. Raises `InputError` where it would be too large to draw."""

    def __init__(
        self, mdp: Mdp, cell_size: int | None = None, legend_rows: int = 1, opaque: bool = False
    ) -> None:
        self.mdp, self.board, zoom = mdp, board_of(mdp), 1
        if cell_size is None:
            is_mosaic = len(self.board.panels) > 1
            longest = _LONGEST_MOSAIC if is_mosaic else _LONGEST_SIDE
            cell_size = drawing.fitting_cell_size(mdp, longest, _LARGEST_CELL)
            zoom = 2 if cell_size >= _NO_GRID and not is_mosaic else 1
            cell_size *= zoom
        names = cell_size if mdp.panel_names else 0
        super().__init__(drawing.frame_size(mdp, cell_size), cell_size, legend_rows, opaque, names, zoom)

    def point(self, state: int, right: float, down: float) -> Point:
        """The point that many cells right of and below the state's corner, in pixels of `world`."""
        row, col = self.board.place[state]
        return (col + 1 + right) * self.cell, (row + 1 + down) * self.cell

    @property
    def hidden(self) -> bool:
        """Whether there are cells whose states cannot be reached."""
        return bool((self.board.kind == Kind.UNREACHABLE).any())

    @property
    def path_swatch(self) -> Swatch:
        """What the legend says of `draw_paths`."""
        return Swatch("greedy path from the start" if self.cell >= 24 else "greedy path", AGENT, AGENT)

    @property
    def has_grid(self) -> bool:
        """Whether cells are large enough for lines between them."""
        return self.cell >= _NO_GRID

    def paint(self, colours: ColourArray, parts: NDArray[np.intp] | None = None) -> None:
        """Fill the cells with colours (S, P, 3); `parts` (cell, cell) says which part a pixel belongs to."""
        board, cell = self.board, self.cell
        cells, is_fixed = colours[board.state], board.kind != Kind.FLOOR
        fixed = _WITH_GRID if self.has_grid else _WITHOUT_GRID
        cells[is_fixed] = fixed[board.kind[is_fixed]][:, None]
        packed = np.full((*cells.shape[:3], 4), 255, dtype=np.uint8)
        packed[..., :3] = cells
        packed[board.kind == Kind.BLANK, :, 3] = 0
        pixels = packed.view(np.uint32)[..., 0]
        if parts is None:
            picture = np.repeat(np.repeat(pixels[..., 0], cell, axis=0), cell, axis=1)
        else:
            picture = pixels[:, :, parts].transpose(0, 2, 1, 3)
        size = (board.cols * cell, board.rows * cell)
        image = drawing.import_pygame().image.frombuffer(np.ascontiguousarray(picture), size, "RGBA")
        image.set_alpha(None)  # copied, not blended
        self.world.blit(image, (cell, cell))

    def draw_world(self, paths: Sequence[list[int]] = (), ways: Sequence[list[int]] = ()) -> None:
        """Grid lines, paths, traps and goals over what was painted; on small cells a line around each panel.

        A path is a line through neighbours, also along the way (S, 2) of a state's action, from a disc.
        """
        if self.has_grid:
            drawing.draw_grid(self.world, self.board, self.cell, WORDS)
        for path in paths:
            self._draw_path([state for state in path if self.board.place[state][0] >= 0], ways)
        if self.has_grid:
            for kind, ink, corners in ((Kind.TRAP, drawing.TRAP, disc(1 / 3)), (Kind.GOAL, GOAL, _TRIANGLE)):
                for row, col in self.board.cells[kind]:
                    self.draw_shape(((col + 1.5) * self.cell, (row + 1.5) * self.cell), corners, ink)
            return
        for panel in self.board.panels:
            left, top = (panel.left + 1) * self.cell - 1, (panel.top + 1) * self.cell - 1
            box = (left, top, panel.cols * self.cell + 2, panel.rows * self.cell + 2)
            drawing.import_pygame().draw.rect(self.world, WORDS, box, 1)

    def draw_numbers(self, numbers: FloatArray, scale: Scale, name: str, missing: str, caption: str) -> Frame:
        """The finished picture of numbers (S, 1), or (S, 4) in the order of `MOVES`, a triangle for each.

        NaN is left white, which the legend calls `missing`.
        """
        playable, known, by_move = self.board.floor, np.isfinite(numbers), numbers.shape[1] > 1
        colours = scale.colours(np.where(known, numbers, scale.low))
        colours[~known] = PAPER
        if by_move:
            separators = np.full((len(numbers), 1, 3), _SEPARATOR, dtype=np.uint8)
            self.paint(np.concatenate([colours, separators], axis=1), self._triangles())
        else:
            self.paint(colours)
        self.draw_world()
        known &= playable[:, None]
        size = self.number_size(numbers[known], scale.high, 0.36 if by_move else 0.8)

        def middle(state: int, part: int) -> Point:
            down, right = MOVES[part] if by_move else (0, 0)
            return self.point(state, 0.5 + 0.29 * right, 0.5 + 0.33 * down)

        self.write_numbers(numbers, known, colours, scale.high, size, middle)
        self.caption(caption)
        unknown = [] if known[playable].all() else [Swatch(missing, PAPER)]
        self.legend(scale, name, [*unknown, *([UNREACHABLE] if self.hidden else [])])
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
        thick, dot = max(1, cell // 16), max(1, cell // 2)
        for state in states.tolist():
            left, top = (round(side) for side in self.point(state, 0, 0))
            if not self.has_grid:
                self.world.fill(colour, (left + cell // 4, top + cell // 4, dot, dot))
                continue
            if thick > 1:  # tells it from a colour as light as its own
                inner = cell - 1 - 2 * thick
                rect(self.world, PAPER, (left + 1 + thick, top + 1 + thick, inner, inner), 1)
            rect(self.world, colour, (left + 1, top + 1, cell - 1, cell - 1), thick)

    def _draw_path(self, path: list[int], ways: Sequence[list[int]]) -> None:
        """A thin line, edged in white where cells are large."""
        place, segments = self.board.place, []
        for state, following in pairwise(path):
            down, right = place[following][0] - place[state][0], place[following][1] - place[state][1]
            if abs(down) + abs(right) <= 1 or [down, right] == ways[state]:  # along a diagonal, perhaps
                segments.append((self.point(state, 0.5, 0.5), self.point(following, 0.5, 0.5)))
        half, edge = max(0.5, self.cell / 40), round(self.cell / 50 + 0.2) if self.cell >= 2 * _NO_GRID else 0
        for thick, ink in ((half + edge, PAPER), (half, AGENT)) if edge else ((half, AGENT),):
            for (x, y), (to_x, to_y) in segments:
                if x != to_x and y != to_y:
                    line = drawing.import_pygame().draw.line
                    line(self.world, ink, (x, y), (to_x, to_y), round(2.8 * thick))
                    continue
                left, top = round(min(x, to_x) - thick), round(min(y, to_y) - thick)
                size = round(abs(x - to_x) + 2 * thick), round(abs(y - to_y) + 2 * thick)
                self.world.fill(ink, (left, top, *size))
        if path:
            self.draw_shape(self.point(path[0], 0.5, 0.5), disc(0.22), AGENT, PAPER)

    def write_values(self, values: FloatArray, chosen: BoolArray, colours: ColourArray, high: float) -> None:
        """Write numbers (S,) off the paths, in the corners of the chosen cells (S,) of these colours (S, 3).

        Where corners are too small for them, they are in the middle, on plates.
        """
        corner = self.number_size(values[chosen], high, 0.33)
        size = corner or self.number_size(values[chosen], high, 0.8)
        right = 0.74 if corner else 0.5
        self.write_numbers(
            *(values[:, None], chosen[:, None], colours[:, None], high, size),
            lambda state, _: self.point(state, right, 0.83),
            on_plates=not corner,
        )


def directions(mdp: Mdp) -> IntArray:
    """How far down and right each action's arrow points, (S, A, 2): -1, 0 or 1; 0, 0 for no arrow.

    An action that moves the same way nearly everywhere points that way everywhere, also where a border stops
    it or chance diverts it. Another one, such as "forward" of an agent that turns, points where it leads.
    """
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
    """Follow the greedy policy (S,) from each start, of four at most, until a state comes twice."""
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
