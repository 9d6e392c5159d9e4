"""Pictures of the world: a frame from (mdp, state), and the window of human mode.

A frame shows the world's board; that of a world without places is a card with the state's name. pygame is
imported when the first picture is drawn; drawing goes to a plain surface, and only `Window` opens a display.
"""

from __future__ import annotations

import functools
import logging
import os
import sys
import time
from collections.abc import Sequence
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gridworld.envs.board import Board, Kind, board_of
from gridworld.errors import InputError
from gridworld.world.grid import GridMdp
from gridworld.world.mdp import Mdp

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
_GREYS = 17  # steps between ink and paper at the edge of a letter

MAX_PIXELS = 64_000_000
MAX_SIDE = 65_535  # pixels; GIF counts no further, and hardly a viewer does

_log = logging.getLogger("gridworld")
_fonts: dict[int, Any] = {}  # a font draws its letters once, and takes its time over it


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
        remedy = f"; take a cell_size below {cell_size}" if cell_size > 1 else ""
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


def surface_to_frame(surface: Any) -> Frame:
    """The pixels of pygame's surface as a fresh array (height, width, 3), uint8, RGB."""
    width, height = surface.get_size()
    pixels = import_pygame().image.tobytes(surface, "RGB")
    return np.frombuffer(pixels, dtype=np.uint8).reshape(height, width, 3).copy()


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
    draw_terminals(surface, board, cell_size)
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


def draw_grid(surface: Any, board: Board, cell_size: int) -> None:
    """Lines of one pixel at the edges of the cells that show a state; the names of panels above them."""
    draw = import_pygame().draw
    for panel in board.panels:
        rows, cols = slice(panel.top, panel.top + panel.rows), slice(panel.left, panel.left + panel.cols)
        left, top = (panel.left + 1) * cell_size, (panel.top + 1) * cell_size
        shown = board.state[rows, cols] >= 0
        if shown.all():
            width, height = panel.cols * cell_size, panel.rows * cell_size
            for x in range(0, width + 1, cell_size):
                surface.fill(GRID_LINE, (left + x, top, 1, height + 1))
            for y in range(0, height + 1, cell_size):
                surface.fill(GRID_LINE, (left, top + y, width + 1, 1))
        else:
            for row, col in np.argwhere(shown).tolist():
                box = left + col * cell_size, top + row * cell_size, cell_size + 1, cell_size + 1
                draw.rect(surface, GRID_LINE, box, 1)
        size = text_size(panel.name, min(round(0.6 * cell_size), 16), panel.cols * cell_size)
        if panel.name and size is not None:
            write(surface, panel.name, left, round((panel.top + 0.5) * cell_size), size)


def draw_terminals(surface: Any, board: Board, cell_size: int) -> None:
    """Traps as discs, goals as triangles."""
    draw = import_pygame().draw
    for row, col in board.cells[Kind.TRAP]:
        draw.circle(surface, TRAP, cell_centre(row, col, cell_size), cell_size // 3)
    for row, col in board.cells[Kind.GOAL]:
        x, y = (col + 1) * cell_size, (row + 1) * cell_size
        corners = [(0.5, 0.2), (0.8, 0.8), (0.2, 0.8)]
        points = [(x + round(right * cell_size), y + round(down * cell_size)) for right, down in corners]
        draw.polygon(surface, GOAL, points)


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


class Window:
    """The window of human mode, of a size in pixels. `surface` and `clock` are pygame's."""

    def __init__(self, size: tuple[int, int], title: str) -> None:
        pygame = import_pygame()
        if not has_display():
            # A log line and no exception: SDL then draws off screen, where every call still works.
            _log.warning(
                "human mode found no display, so its window cannot be seen; "
                "set DISPLAY, or use render_mode='rgb_array'"
            )
        self._size, self._title = size, title
        self.clock = pygame.time.Clock()
        self._open()

    def _open(self) -> None:
        display = import_pygame().display
        display.init()  # not pygame.init(), which would look for a sound card too
        self.surface = display.set_mode(self._size)
        display.set_caption(self._title)

    def show(self, mdp: Mdp, state: int, cell_size: int, fps: int, delay: float) -> None:
        """Draw and show one frame; keep `fps`, then wait. SystemExit if the user closed the window."""
        pygame = import_pygame()
        if not pygame.display.get_init():  # pygame has one display a process, and another window closed it
            self._open()
        draw_world(self.surface, mdp, state, cell_size)
        for event in pygame.event.get():
            if event.type == pygame.QUIT:
                self.close()
                raise SystemExit
        pygame.display.flip()
        self.clock.tick(fps)
        time.sleep(delay)

    def close(self) -> None:
        """Close the window and shut pygame down."""
        import_pygame().quit()


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


def write(surface: Any, text: str, left: int, middle: int, size: int) -> int:
    """Write a text on paper, in few greys for the palettes of animations; where it ends, in pixels."""
    image = _in_greys(text, size)
    surface.blit(image, (left, middle - image.get_height() // 2))
    return left + int(image.get_width())


@functools.lru_cache(maxsize=1 << 7)  # captions and legends of a run's pictures have many words in common
def _in_greys(text: str, size: int) -> Any:
    image = font(size).render(text, True, INK)
    alpha = import_pygame().surfarray.pixels_alpha(image)
    step = 255 // (_GREYS - 1)
    alpha[...] = alpha // step * step
    del alpha  # unlocks the image
    return image
