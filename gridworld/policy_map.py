"""A picture of what an agent believes: values as colours, greedy actions as arrows.

The look is the environment's own frame's. Colours run over viridis, which colour-blind readers can order
too. A cell whose greedy action is not among the optimal ones has a red frame.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from gridworld import render as drawing
from gridworld.layout import MOVES
from gridworld.mdp import BoolArray, FloatArray, IntArray, Mdp
from gridworld.render import Colour, Frame

DISAGREES: Colour = (213, 60, 50)

_VIRIDIS = np.array(
    [(68, 1, 84), (59, 82, 139), (33, 145, 140), (94, 201, 98), (253, 231, 37)], dtype=np.float64
)
_LONGEST_SIDE = 640  # pixels
_SMALLEST_ARROW_CELL = 12  # pixels; below it an arrow is a blot


def draw_policy_map(
    mdp: Mdp,
    values: FloatArray,
    greedy: IntArray,
    optimal: BoolArray,
    caption: str = "",
    cell_size: int | None = None,
) -> Frame:
    """`values` (S,), `greedy` (S,) and `optimal` (S, A) as a frame with caption and colour scale."""
    pygame = drawing.import_pygame()
    layout = mdp.layout
    cell = drawing.fitting_cell_size(mdp, _LONGEST_SIDE, largest=64) if cell_size is None else cell_size
    cell = max(4, cell)
    surface = pygame.Surface(drawing.frame_size(mdp, cell))
    surface.fill(drawing.BACKGROUND)
    shown = ~(mdp.terminal | mdp.wall)
    low, high = float(values[shown].min()), float(values[shown].max())
    level = (values - low) / (high - low) if high > low else np.full(len(values), 0.5)
    for state, place in enumerate(layout.cells()):
        if mdp.wall[state]:
            drawing.fill_cell(surface, place, drawing.WALL, cell)
        elif shown[state]:
            drawing.fill_cell(surface, place, viridis(level[state]), cell)
    drawing.draw_grid(surface, mdp, cell)
    drawing.draw_terminals(surface, mdp, cell)
    for state in np.flatnonzero(shown).tolist():
        action = int(greedy[state])
        row, col = divmod(state, layout.num_cols)
        if not optimal[state, action]:
            box = ((col + 1) * cell + 1, (row + 1) * cell + 1, cell - 1, cell - 1)
            pygame.draw.rect(surface, DISAGREES, box, width=max(1, cell // 16))
        if cell >= _SMALLEST_ARROW_CELL:
            ink = (255, 255, 255) if level[state] < 0.6 else (0, 0, 0)
            _draw_arrow(surface, row, col, action, cell, ink)
    if cell >= 2 * _SMALLEST_ARROW_CELL:
        _write(surface, caption, (cell, cell // 2), cell)
        _draw_scale(surface, low, high, cell)
    return drawing.surface_to_frame(surface)


def viridis(level: float) -> Colour:
    """The colour at `level` from 0 to 1, between five anchors of matplotlib's map of that name."""
    position = min(max(float(level), 0.0), 1.0) * (len(_VIRIDIS) - 1)
    below = min(int(position), len(_VIRIDIS) - 2)
    red, green, blue = _VIRIDIS[below] + (position - below) * (_VIRIDIS[below + 1] - _VIRIDIS[below])
    return round(red), round(green), round(blue)


def _draw_arrow(surface: Any, row: int, col: int, action: int, cell: int, ink: Colour) -> None:
    x, y = drawing.cell_centre(row, col, cell)
    down, right = MOVES[action]
    shape = [
        (-0.28, 0.05),
        (0.04, 0.05),
        (0.04, 0.17),
        (0.3, 0.0),
        (0.04, -0.17),
        (0.04, -0.05),
        (-0.28, -0.05),
    ]
    points = [
        (x + cell * (along * right - across * down), y + cell * (along * down + across * right))
        for along, across in shape
    ]
    drawing.import_pygame().draw.polygon(surface, ink, points)


def _draw_scale(surface: Any, low: float, high: float, cell: int) -> None:
    """A colour bar with its two ends' values, in the border below the grid."""
    width, height = surface.get_size()
    left, right, top = int(2.2 * cell), width - int(2.2 * cell), height - int(0.65 * cell)
    thick = max(3, cell // 4)
    for x in range(left, right):
        surface.fill(viridis((x - left) / max(1, right - left - 1)), (x, top, 1, thick))
    middle = top + thick // 2
    _write(surface, f"{low:.3g}", (left - cell // 8, middle), cell, align="right")
    _write(surface, f"{high:.3g}", (right + cell // 8, middle), cell)


def _write(surface: Any, text: str, place: tuple[int, int], cell: int, align: str = "left") -> None:
    """Text beside `place`, at its height."""
    pygame = drawing.import_pygame()
    pygame.font.init()
    image = pygame.font.Font(None, max(14, int(0.4 * cell))).render(text, True, drawing.GRID_LINE)
    x = place[0] - image.get_width() if align == "right" else place[0]
    surface.blit(image, (x, place[1] - image.get_height() // 2))
