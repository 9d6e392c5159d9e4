"""Pictures of the world: the board that they lie on, a frame from (mdp, state), and text.

The board has cells in rows and columns. The states of a map lie in one panel; other worlds may have several
(`Mdp.places`), in rows and columns with a blank one between two. A world without places has no panels; its
pictures are tables and cards with a state's name. pygame is imported when the first picture is drawn.
"""

from __future__ import annotations

import functools
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from types import ModuleType
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from gridworld.base.errors import InputError
from gridworld.world.grid import GridMdp
from gridworld.world.mdp import BoolArray, IntArray, Mdp, frozen

Colour = tuple[int, int, int]

CELL_SIZE = 100  # pixels
MARGIN = 10  # pixels

Point = tuple[float, float]
Frame = NDArray[np.uint8]  # (height, width, 3), RGB
Packed = NDArray[np.uint32]  # (height, width), 0xRRGGBB: a number per colour

INK: Colour = (0, 0, 0)
BACKGROUND: Colour = (255, 255, 255)
GRID_LINE: Colour = (0, 0, 0)
UNKNOWN: Colour = (222, 222, 222)  # of states that nothing is known of, or that cannot be reached
WALL: Colour = (150, 150, 150)
CLIFF: Colour = (110, 85, 65)
TRAP: Colour = (50, 50, 50)
GOAL: Colour = (230, 180, 50)
AGENT: Colour = (100, 100, 220)

SMALLEST_TEXT = 10  # pixels
GREYS = 18  # of letters, from paper to ink

MAX_PIXELS = 64_000_000
MAX_SIDE = 65_535  # pixels; GIF counts no further, and hardly a viewer does

_CARD = 1, 4  # rows and columns of the text that stands for a world without places

_fonts: dict[int, Any] = {}  # a font draws its letters once, and takes its time over it


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
        return list(self.cell.tolist())

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

    def summed(self, numbers: NDArray[Any]) -> NDArray[Any]:
        """Numbers (S,), those of states in one cell added up: all of these have the sum."""
        has_place, totals = self.cell[:, 0] >= 0, np.zeros(self.state.shape, numbers.dtype)
        np.add.at(totals, tuple(self.cell[has_place].T), numbers[has_place])
        return np.where(has_place, totals[tuple(self.cell.T)], numbers)


_boards: WeakKeyDictionary[Mdp, Board] = WeakKeyDictionary()


def board_of(mdp: Mdp) -> Board:
    """The board of a world, made once. Of two states in one place the first that can be reached is shown."""
    if mdp not in _boards:
        _boards[mdp] = _board(mdp)
    return _boards[mdp]


def _board(mdp: Mdp) -> Board:
    places = mdp.places
    if places is None:
        tables = np.full((mdp.num_states, 2), -1), np.full(_CARD, -1), np.full(_CARD, Kind.BLANK)
        return Board(*_CARD, (), *map(frozen, tables))
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


@functools.cache
def import_pygame() -> ModuleType:
    """pygame, without its greeting, and without `pkg_resources`, which takes longest to import."""
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    hidden = {"pygame", "pkg_resources"}.isdisjoint(sys.modules)
    if hidden:
        sys.modules["pkg_resources"] = None  # type: ignore[assignment]
    try:
        import pygame
    finally:
        if hidden:
            del sys.modules["pkg_resources"]
    return pygame


def frame_size(mdp: Mdp, cell_size: int = CELL_SIZE) -> tuple[int, int]:
    """Width and height of a frame in pixels: the grid and one empty cell of border all round."""
    board = board_of(mdp)
    width, height = (board.cols + 2) * cell_size, (board.rows + 2) * cell_size
    if width * height > MAX_PIXELS or max(width, height) > MAX_SIDE:
        remedy = f"; use a cell_size below {cell_size}" if cell_size > 1 else ""
        world = f"layout {mdp.name}" if isinstance(mdp, GridMdp) else mdp.name
        raise InputError(f"{world}: a frame of {width} x {height} pixels is too large to draw{remedy}")
    return width, height


def fitting_cell_size(mdp: Mdp, longest_side: int, largest: int = CELL_SIZE) -> int:
    """The cell size with which a frame's longest side is about `longest_side`, at most `largest`; pixels."""
    board = board_of(mdp)
    cells = max(board.rows, board.cols) + 2
    return max(2 if 2 * cells <= MAX_SIDE else 1, min(largest, longest_side // cells))


def draw_frame(mdp: Mdp, state: int | None, cell_size: int = CELL_SIZE) -> Frame:
    """A frame (height, width, 3), uint8, RGB, a fresh array; `state` None: without an agent."""
    pygame = import_pygame()
    surface = pygame.Surface(frame_size(mdp, cell_size))
    draw_world(surface, mdp, state, cell_size)
    return surface_to_frame(surface)


def surface_to_frame(surface: Any, form: str = "RGB") -> Frame:
    """The pixels of pygame's surface as a fresh array (height, width, 3), uint8; or 4, in the form RGBA."""
    width, height = surface.get_size()
    pixels = import_pygame().image.tobytes(surface, form)
    return np.frombuffer(pixels, dtype=np.uint8).reshape(height, width, len(form)).copy()


def pack(frame: Frame) -> Packed:
    """The frame with one number per pixel, a fresh array."""
    packed = frame[..., 0].astype(np.uint32)
    for channel in (1, 2):
        packed <<= 8
        packed |= frame[..., channel]
    return packed


def draw_world(surface: Any, mdp: Mdp, state: int | None, cell_size: int = CELL_SIZE) -> None:
    """Draw cells, grid, traps, goals and the agent, in this order; see `draw_frame`."""
    surface.fill(BACKGROUND)
    board = board_of(mdp)
    if not board.panels:
        draw_card(surface, [] if state is None else [mdp.state_name(state)])
        return
    for colour, kind in ((UNKNOWN, Kind.UNREACHABLE), (WALL, Kind.WALL), (CLIFF, Kind.CLIFF)):
        for row, col in board.cells[kind]:
            surface.fill(colour, ((col + 1) * cell_size, (row + 1) * cell_size, cell_size, cell_size))
    draw_grid(surface, board, cell_size)
    draw = import_pygame().draw
    for row, col in board.cells[Kind.TRAP]:
        draw.circle(surface, TRAP, cell_centre(row, col, cell_size), cell_size // 3)
    for row, col in board.cells[Kind.GOAL]:
        x, y = (col + 1) * cell_size, (row + 1) * cell_size
        corners = [(0.5, 0.2), (0.8, 0.8), (0.2, 0.8)]
        points = [(x + round(right * cell_size), y + round(down * cell_size)) for right, down in corners]
        draw.polygon(surface, GOAL, points)
    if state is not None:
        surface.fill(AGENT, agent_box(mdp, state, cell_size))


def draw_card(surface: Any, lines: Sequence[str]) -> None:
    """Write lines of text, the first one larger; none where they could not be read."""
    surface.fill(BACKGROUND)
    width, height = surface.get_size()
    unit = height / (2.5 * len(lines) + 1.5)
    top = unit
    for number, line in enumerate(lines):
        size = 2 * unit if number == 0 else 1.5 * unit
        fitting = text_size(line, round(size), 0.9 * width)
        if fitting is not None:
            write(surface, line, round(0.05 * width), round(top + 0.7 * size), fitting)
        top += size + unit


def agent_box(mdp: Mdp, state: int, cell_size: int = CELL_SIZE) -> tuple[int, int, int, int]:
    """Left, top, width and height of the agent's square in a frame, in pixels; nothing without a place."""
    row, col = board_of(mdp).cell[state].tolist()
    inset, side = round(0.2 * cell_size), round(0.6 * cell_size) if row >= 0 else 0
    return (col + 1) * cell_size + inset, (row + 1) * cell_size + inset, side, side


def draw_grid(surface: Any, board: Board, cell_size: int, ink: Colour = INK) -> None:
    """Lines of one pixel at the edges of the cells that show a state; in ink the names of panels above."""
    draw = import_pygame().draw
    for panel in board.panels:
        rows, cols = slice(panel.top, panel.top + panel.rows), slice(panel.left, panel.left + panel.cols)
        left, top = (panel.left + 1) * cell_size, (panel.top + 1) * cell_size
        for row, col in np.argwhere(board.state[rows, cols] >= 0).tolist():
            box = left + col * cell_size, top + row * cell_size, cell_size + 1, cell_size + 1
            draw.rect(surface, GRID_LINE, box, 1)
        size = text_size(panel.name, min(round(0.6 * cell_size), 16), panel.cols * cell_size)
        if panel.name and size is not None:
            write(surface, panel.name, left, round((panel.top + 0.5) * cell_size), size, ink)


def cell_centre(row: int, col: int, cell_size: int = CELL_SIZE) -> Point:
    """The middle (x, y) of a cell in a frame, in pixels."""
    return (col + 1.5) * cell_size, (row + 1.5) * cell_size


def ansi(mdp: Mdp, state: int) -> str:
    """The board as text, in the signs of maps, with the agent as 'A', and a newline at the end."""
    board = board_of(mdp)
    if not board.panels:
        return f"{mdp.state_name(state)}\n"
    signs = np.array(list(" ..#CGT"))[board.kind]
    for each, sign in [*((start, "S") for start in mdp.start_states.tolist()), (state, "A")]:
        row, col = board.cell[each].tolist()
        if row >= 0:
            signs[row, col] = sign
    return "\n".join(map("".join, signs.tolist())) + "\n"


def has_display() -> bool:
    """Whether a window could be seen: a screen, or an SDL driver that somebody chose on purpose."""
    chosen = ("SDL_VIDEODRIVER", "DISPLAY", "WAYLAND_DISPLAY")
    return not sys.platform.startswith("linux") or any(os.environ.get(name) for name in chosen)


def font(size: int) -> Any:
    """pygame's font of a size in pixels."""
    pygame = import_pygame()
    if not (_fonts and pygame.font.get_init()):
        _fonts.clear()
        pygame.font.init()
        pygame.register_quit(_fonts.clear)  # they end with pygame
    if size not in _fonts:
        _fonts[size] = pygame.font.Font(None, round(1.2 * size))
    return _fonts[size]


@functools.lru_cache(maxsize=1 << 12)
def text_width(text: str, size: int) -> int:
    """The width of a text in pixels."""
    return int(font(size).size(text)[0])


def text_size(text: str, size: int, room: float) -> int | None:
    """The size, at most `size`, at which a text is at most `room` pixels wide; None: too small to read."""
    if size < SMALLEST_TEXT:
        return None
    fitting = int(size * min(1.0, room / max(1, text_width(text, size))))
    return fitting if fitting >= SMALLEST_TEXT else None


def write(surface: Any, text: str, left: int, middle: int, size: int, ink: Colour = INK) -> int:
    """Write a text on paper, in few shades for the palettes of animations; where it ends, in pixels."""
    image = in_greys(text, size, ink)
    surface.blit(image, (left, middle - image.get_height() // 2))
    return left + int(image.get_width())


@functools.lru_cache(maxsize=1 << 7)  # captions and legends of a run's pictures have many words in common
def in_greys(text: str, size: int, ink: Colour = INK) -> Any:
    """A text in a colour; the opacity of its pixels is one of `GREYS` steps."""
    image = font(size).render(text, True, ink)
    alpha = import_pygame().surfarray.pixels_alpha(image)
    step = 255 // (GREYS - 1)
    alpha[...] = alpha // step * step
    del alpha  # unlocks the image
    return image
