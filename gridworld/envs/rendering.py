"""Pictures of the world: a frame from (mdp, state), and the window of human mode.

pygame is imported when the first picture is drawn. Drawing goes to a plain surface, which needs no display;
only `Window` opens one.
"""

from __future__ import annotations

import logging
import os
import sys
import time
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gridworld.errors import InputError
from gridworld.world.layout import Cell
from gridworld.world.mdp import Mdp

CELL_SIZE = 100  # pixels
MARGIN = 10  # pixels

Colour = tuple[int, int, int]
Point = tuple[float, float]
Frame = NDArray[np.uint8]  # (height, width, 3), RGB

BACKGROUND: Colour = (255, 255, 255)
GRID_LINE: Colour = (0, 0, 0)
WALL: Colour = (150, 150, 150)
CLIFF: Colour = (110, 85, 65)
TRAP: Colour = (50, 50, 50)
GOAL: Colour = (230, 180, 50)
AGENT: Colour = (100, 100, 220)

MAX_PIXELS = 64_000_000
MAX_SIDE = 65_535  # pixels; GIF counts no further, and hardly a viewer does

_log = logging.getLogger("gridworld")


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
    """Width and height of a frame in pixels: the grid and one empty cell of border all round.

    Raises:
        InputError: the frame is too large to draw.
    """
    width, height = (mdp.layout.num_cols + 2) * cell_size, (mdp.layout.num_rows + 2) * cell_size
    if width * height > MAX_PIXELS or max(width, height) > MAX_SIDE:
        remedy = f"; take a cell_size below {cell_size}" if cell_size > 1 else ""
        raise InputError(
            f"layout {mdp.layout.name}: a frame of {width} x {height} pixels is too large to draw{remedy}"
        )
    return width, height


def fitting_cell_size(mdp: Mdp, longest_side: int, largest: int = CELL_SIZE) -> int:
    """The cell size with which a frame's longest side is about `longest_side`, at most `largest`; pixels."""
    cells = max(mdp.layout.num_rows, mdp.layout.num_cols) + 2
    return max(2 if 2 * cells <= MAX_SIDE else 1, min(largest, longest_side // cells))


def draw_frame(mdp: Mdp, state: int | None, cell_size: int = CELL_SIZE) -> Frame:
    """Draw a frame.

    Args:
        mdp: the world.
        state: where the agent is; None: without an agent.
        cell_size: pixels.

    Returns:
        (height, width, 3), uint8, RGB, a fresh array.

    Raises:
        InputError: the frame is too large to draw.
    """
    pygame = import_pygame()
    surface = pygame.Surface(frame_size(mdp, cell_size))
    draw_world(surface, mdp, state, cell_size)
    return surface_to_frame(surface)


def surface_to_frame(surface: Any) -> Frame:
    """The pixels of pygame's surface as a fresh array (height, width, 3), uint8, RGB."""
    width, height = surface.get_size()
    pixels = import_pygame().image.tobytes(surface, "RGB")
    return np.frombuffer(pixels, dtype=np.uint8).reshape(height, width, 3).copy()


def draw_world(surface: Any, mdp: Mdp, state: int | None, cell_size: int = CELL_SIZE) -> None:
    """Draw background, walls, cliffs, grid, traps, goals and the agent, in this order; see `draw_frame`."""
    surface.fill(BACKGROUND)
    for colour, cells in ((WALL, mdp.layout.walls), (CLIFF, mdp.layout.cliffs)):
        for cell in cells:
            fill_cell(surface, cell, colour, cell_size)
    draw_grid(surface, mdp, cell_size)
    draw_terminals(surface, mdp, cell_size)
    if state is not None:
        surface.fill(AGENT, agent_box(mdp, state, cell_size))


def agent_box(mdp: Mdp, state: int, cell_size: int = CELL_SIZE) -> tuple[int, int, int, int]:
    """Left, top, width and height of the agent's square in a frame, in pixels."""
    row, col = divmod(state, mdp.layout.num_cols)
    inset, side = round(0.2 * cell_size), round(0.6 * cell_size)
    return (col + 1) * cell_size + inset, (row + 1) * cell_size + inset, side, side


def fill_cell(surface: Any, cell: Cell, colour: Colour, cell_size: int) -> None:
    """Fill a whole cell (row, column) of a frame."""
    surface.fill(colour, ((cell[1] + 1) * cell_size, (cell[0] + 1) * cell_size, cell_size, cell_size))


def draw_grid(surface: Any, mdp: Mdp, cell_size: int) -> None:
    """Lines of one pixel at every cell's edge."""
    line = import_pygame().draw.line
    right, bottom = (mdp.layout.num_cols + 1) * cell_size, (mdp.layout.num_rows + 1) * cell_size
    for x in range(cell_size, right + 1, cell_size):
        line(surface, GRID_LINE, (x, cell_size), (x, bottom))
    for y in range(cell_size, bottom + 1, cell_size):
        line(surface, GRID_LINE, (cell_size, y), (right, y))


def draw_terminals(surface: Any, mdp: Mdp, cell_size: int) -> None:
    """Traps as discs, goals as triangles."""
    draw = import_pygame().draw
    for row, col in mdp.layout.traps:
        draw.circle(surface, TRAP, cell_centre(row, col, cell_size), cell_size // 3)
    for row, col in mdp.layout.goals:
        x, y = (col + 1) * cell_size, (row + 1) * cell_size
        corners = [(0.5, 0.2), (0.8, 0.8), (0.2, 0.8)]
        points = [(x + round(right * cell_size), y + round(down * cell_size)) for right, down in corners]
        draw.polygon(surface, GOAL, points)


def cell_centre(row: int, col: int, cell_size: int = CELL_SIZE) -> Point:
    """The middle (x, y) of a cell in a frame, in pixels."""
    return (col + 1.5) * cell_size, (row + 1.5) * cell_size


def ansi(mdp: Mdp, state: int) -> str:
    """The map as text, with the agent as 'A', and a newline at the end."""
    rows = [list(line) for line in mdp.layout.text().split("\n")]
    row, col = divmod(state, mdp.layout.num_cols)
    rows[row][col] = "A"
    return "\n".join(map("".join, rows)) + "\n"


def has_display() -> bool:
    """Whether a window could be seen: a screen, or an SDL driver that somebody chose on purpose."""
    if os.environ.get("SDL_VIDEODRIVER"):
        return True
    if not sys.platform.startswith("linux"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


class Window:
    """The window of human mode. `surface` and `clock` are pygame's.

    Args:
        size: width and height in pixels.
        title: of the window.
    """

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
        """Draw and show one frame.

        Args:
            mdp: the world.
            state: where the agent is.
            cell_size: pixels.
            fps: frames per second to keep to.
            delay: seconds to wait after that.

        Raises:
            SystemExit: the user closed the window, which shuts pygame down.
        """
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
        pygame = import_pygame()
        pygame.display.quit()
        pygame.quit()
