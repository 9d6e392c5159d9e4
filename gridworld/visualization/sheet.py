"""A picture with words: a caption above, in the middle whatever is drawn, a legend below."""

from __future__ import annotations

import functools
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gridworld.envs.rendering import (
    BACKGROUND,
    SMALLEST_TEXT,
    UNKNOWN,
    Colour,
    Frame,
    Packed,
    Point,
    font,
    import_pygame,
    surface_to_frame,
    text_width,
    write,
)
from gridworld.envs.rendering import INK as INK
from gridworld.visualization.colormaps import ColourArray, Scale

PAPER: Colour = BACKGROUND
DISAGREES: Colour = (213, 60, 50)  # the colour of a greedy action that is not optimal
UNKNOWN_INK: Colour = (170, 170, 170)

Box = tuple[int, int, int, int]  # left, top, width, height


@dataclass(frozen=True)
class Swatch:
    """An entry of the legend: a little cell, filled or framed, and what it means."""

    label: str
    fill: Colour = PAPER
    frame: Colour = INK
    thick: int = 1


NEVER_VISITED = Swatch("never visited", UNKNOWN, UNKNOWN_INK)
UNREACHABLE = Swatch("cannot be reached", UNKNOWN, UNKNOWN_INK)


class Sheet:
    """A picture under construction.

    Args:
        width: of the middle, in pixels, its border included.
        height: of the middle.
        cell: the width of its border in pixels, and the unit of what is drawn in it.
        legend_rows: 1 or 2.
        names: the height of what is written into the upper border itself, in pixels.

    Attributes:
        cell: see there.
        text_size: of caption and legend, in pixels.
    """

    def __init__(self, width: int, height: int, cell: int, legend_rows: int = 1, names: int = 0) -> None:
        self.cell = cell
        self.text_size = min(max(cell // 4, 15), 20)
        self._legend_rows = legend_rows
        # The border of a cell is extended where words would not fit into it.
        below = 1.1 + 1.5 * legend_rows
        self._names = names
        top = names + max(0, round(2.2 * self.text_size) - cell)
        bottom = max(0, round(below * self.text_size) - cell)
        side = max(0, 21 * self.text_size - width + 1) // 2
        self._surface = import_pygame().Surface((width + 2 * side, top + height + bottom), 0, 32)
        self._surface.fill(PAPER)
        self._world = self._surface.subsurface((side, top, width, height))

    @property
    def world(self) -> Any:
        """The surface of the grid and its border of a cell."""
        return self._world

    def number_size(self, room: float, texts: Collection[str]) -> int | None:
        """Choose a font size for numbers in cells.

        Args:
            room: how wide a text may be, in cells.
            texts: all that will be written.

        Returns:
            The font size in pixels; None where it would be too small to read.
        """
        size = min(round(0.3 * self.cell), 20)
        if size < SMALLEST_TEXT or not texts:
            return None
        widest = max(text_width(text, size) for text in set(texts))
        fitting = int(size * min(1.0, room * self.cell / widest))
        return fitting if fitting >= SMALLEST_TEXT else None

    def number(
        self, text: str, middle: Point, size: int, ink: Colour, plate: ColourArray | None = None
    ) -> None:
        """Write a text around a point of `world`, on a plate of that colour where something lies below it."""
        image = font(size).render(text, True, ink)
        box = image.get_rect(center=middle)
        if plate is not None:
            self._world.fill(plate.tolist(), box)
        self._world.blit(image, box)

    def caption(self, text: str) -> None:
        """Write one line above the grid, smaller where it is long."""
        self._line(text, (self._world.get_offset()[1] + self.cell - self._names) // 2)

    def footer(self, text: str) -> None:
        """Write one line below the grid."""
        bottom = self._world.get_offset()[1] + self._world.get_height() - self.cell
        self._line(text, (bottom + self._surface.get_height()) // 2)

    def _line(self, text: str, middle: int) -> None:
        if not text:
            return
        width = self._surface.get_width()
        size = self.text_size
        left = min(self._world.get_offset()[0] + self.cell, max(6, (width - text_width(text, size)) // 2))
        room = width - left - 6
        size = max(SMALLEST_TEXT, int(size * min(1.0, room / max(1, text_width(text, size)))))
        write(self._surface, text, left, middle, size)

    def legend(self, scale: Scale, low: str, high: str, swatches: Sequence[Swatch] = ()) -> None:
        """Draw the legend below the grid: the colour bar between the names of its ends, then the swatches.

        The swatches have a row of their own in a canvas with two rows of legend.
        """
        total, offset = self._surface.get_width(), self._world.get_offset()
        edge = offset[0] + self.cell
        bottom = offset[1] + self._world.get_height() - self.cell
        rows = (0.5,) if self._legend_rows == 1 else (0.32, 0.74)  # heights within what is below the grid
        middles = [bottom + round((self._surface.get_height() - bottom) * row) for row in rows]
        size, gap = self.text_size, self.text_size // 2
        beside = self._swatches_width(swatches, size) if len(rows) == 1 else 0
        ends = text_width(low, size) + text_width(high, size) + 2 * gap
        bar = max(3 * size, min(12 * size, total - 2 * gap - beside - ends))
        left = max(4, min(edge, (total - bar - beside - ends) // 2))
        middle = middles[0]
        left = write(self._surface, low, left, middle, size) + gap
        self._draw_bar(scale, (left, middle - size // 2, bar, size))
        left = write(self._surface, high, left + bar + gap, middle, size) + 2 * gap
        if len(rows) > 1:
            wide = self._swatches_width(swatches, size)
            size = max(SMALLEST_TEXT, int(size * min(1.0, (total - 8) / max(1, wide))))
            left = max(4, min(edge, (total - self._swatches_width(swatches, size)) // 2))
        self._draw_swatches(swatches, left, middles[-1], size)

    def _swatches_width(self, swatches: Sequence[Swatch], size: int) -> int:
        return sum(size + 3 * (size // 2) + text_width(swatch.label, size) for swatch in swatches)

    def _draw_swatches(self, swatches: Sequence[Swatch], left: int, middle: int, size: int) -> None:
        for swatch in swatches:
            box = (left, middle - size // 2, size, size)
            self._surface.fill(swatch.fill, box)
            import_pygame().draw.rect(self._surface, swatch.frame, box, swatch.thick)
            left = write(self._surface, swatch.label, left + size + size // 4, middle, size) + size

    def frame(self) -> Frame:
        """The picture's pixels."""
        return surface_to_frame(self._surface)

    def packed(self) -> Packed:
        """The same with one number per pixel, a fresh array."""
        columns = np.asarray(self._surface.get_view("2"))
        return columns.T & np.uint32(0xFFFFFF)

    def _draw_bar(self, scale: Scale, box: Box) -> None:
        left, top, width, height = box
        image = _bar(scale.ramp.tobytes(), width, height)
        self._surface.blit(image, (left, top))
        import_pygame().draw.rect(self._surface, INK, box, 1)


@functools.lru_cache(maxsize=32)
def _bar(ramp: bytes, width: int, height: int) -> Any:
    """A ramp of colours, (steps, 3) bytes, from left to right."""
    colours = np.frombuffer(ramp, dtype=np.uint8).reshape(-1, 3)
    steps = np.linspace(0, len(colours) - 1, width).round().astype(np.intp)
    row = np.full((width, 4), 255, dtype=np.uint8)
    row[:, :3] = colours[steps]
    return import_pygame().image.frombuffer(np.tile(row, (height, 1, 1)), (width, height), "RGBX")


def short(number: float, largest: float | None = None) -> str:
    """Format a number in few characters: 873, 1.2k, 23k; 0.93, 12.5, 4e-5. `largest` fixes the decimals."""
    size = abs(number)
    for unit, name in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if size >= 0.9995 * unit:
            scaled = number / unit
            return f"{scaled:.1f}{name}" if abs(scaled) < 9.95 else f"{scaled:.0f}{name}"
    if number == int(number):
        return str(int(number))
    most = max(size, abs(largest or 0.0))
    if most < 0.002:
        mantissa, exponent = f"{number:.0e}".split("e")
        return f"{mantissa}e{int(exponent)}"
    decimals = 3 if most < 0.1 else 2 if most < 9.995 else 1 if most < 99.95 else 0
    text = f"{number:.{decimals}f}"
    return "0" if float(text) == 0 else text
