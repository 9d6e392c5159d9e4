"""A picture with words: a caption above, in the middle whatever is drawn, a legend below; and colour scales.

Lightness rises or falls steadily along each scale, so that colour-blind readers see the order of numbers too,
and a grey print keeps it. A scale has a limited number of colours, which keeps animations within the 256 of a
GIF.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gridworld.envs import rendering
from gridworld.envs.rendering import (
    BACKGROUND,
    INK,
    SMALLEST_TEXT,
    UNKNOWN,
    Colour,
    Frame,
    Packed,
    Point,
    font,
    import_pygame,
    surface_to_frame,
    text_size,
    text_width,
)
from gridworld.world.mdp import BoolArray, FloatArray

ColourArray = NDArray[np.uint8]  # (..., 3), RGB

PAPER: Colour = BACKGROUND
DISAGREES: Colour = (213, 60, 50)  # the colour of a greedy action that is not optimal
UNKNOWN_INK: Colour = (170, 170, 170)
WORDS: Colour = (107, 118, 134)  # on the ground: a contrast of 4.6 with white and with black
write = functools.partial(rendering.write, ink=WORDS)

_STEPS = 128  # colours of a scale
_FINER = 4  # times, to which shapes are drawn and made smaller again, for smooth edges
_DECADES = 2.0  # a logarithmic scale from here on: below, a linear one still tells the cells apart


def _ramp(*anchors: tuple[int, int, int]) -> ColourArray:
    """(128, 3), in straight lines between the anchors."""
    places, points = np.linspace(0, len(anchors) - 1, _STEPS), np.arange(len(anchors))
    channels = [np.interp(places, points, channel) for channel in zip(*anchors, strict=True)]
    return np.stack(channels, axis=1).round().astype(np.uint8)


# matplotlib's viridis at five points, and two of C. Brewer's sequential schemes, https://colorbrewer2.org
VIRIDIS = _ramp((68, 1, 84), (59, 82, 139), (33, 145, 140), (94, 201, 98), (253, 231, 37))
ORANGES = _ramp((255, 247, 236), (253, 212, 158), (252, 141, 89), (215, 48, 31), (127, 0, 0))
BLUES = _ramp((222, 235, 247), (158, 202, 225), (66, 146, 198), (8, 81, 156), (8, 36, 88))


@dataclass(frozen=True, eq=False)
class Scale:
    """A range of numbers laid out over a ramp of colours (steps, 3)."""

    ramp: ColourArray
    low: float
    high: float
    logarithmic: bool = False

    def colours(self, values: FloatArray) -> ColourArray:
        """The colours (..., 3) of numbers (...,); those beyond the range get the colour of its end."""
        low, high = self.low, self.high
        if self.logarithmic:
            values, low, high = np.log(np.maximum(values, low)), np.log(low), np.log(high)
        level = (values - low) / (high - low) if high > low else np.zeros(np.shape(values))
        steps = np.rint(np.clip(level, 0.0, 1.0) * (len(self.ramp) - 1))
        colours: ColourArray = self.ramp[steps.astype(np.intp)]
        return colours


def linear(ramp: ColourArray, values: FloatArray, low: float | None = None) -> Scale:
    """A scale from `low`, or the smallest finite value, to the largest; from 0 to 0 where none is finite."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return Scale(ramp, 0.0, 0.0)
    return Scale(ramp, float(finite.min()) if low is None else low, float(finite.max()))


def counting(ramp: ColourArray, counts: NDArray[Any]) -> Scale:
    """A scale of the counts above zero, logarithmic where they span decades; from 0 to 0 without any."""
    positive = counts[counts > 0]
    if not positive.size:
        return Scale(ramp, 0.0, 0.0)
    low, high = float(positive.min()), float(positive.max())
    return Scale(ramp, low, high, logarithmic=high >= low * 10**_DECADES)


def is_dark(colours: ColourArray) -> BoolArray:
    """Whether white is easier to read than black on colours (..., 3), as (...,)."""
    dark: BoolArray = colours @ np.array([0.299, 0.587, 0.114]) < 120
    return dark


Size = tuple[int, int]  # width and height
Corners = tuple[Point, ...]  # of a shape in a cell, from (0, 0) to (1, 1)


@functools.cache
def disc(radius: float) -> Corners:
    """The corners of a polygon that looks like a disc in the middle of a cell."""
    turns = [index * math.tau / 64 for index in range(64)]
    return tuple((0.5 + radius * math.cos(turn), 0.5 + radius * math.sin(turn)) for turn in turns)


@functools.lru_cache(maxsize=1 << 8)  # the same few are drawn in every cell, and in every picture of a film
def _smooth(cell: int, corners: Corners, ink: Colour, edge: Colour | None) -> Any:
    """A cell with that shape, transparent around it; edged in that colour."""
    pygame, side = import_pygame(), _FINER * cell
    large, points = pygame.Surface((side, side), pygame.SRCALPHA), [(x * side, y * side) for x, y in corners]
    large.fill((*(edge or ink), 0))
    if edge:
        thick = max(_FINER, side // 50)
        for start, end in zip(points, [*points[1:], points[0]], strict=True):
            pygame.draw.line(large, edge, start, end, 2 * thick)
            pygame.draw.circle(large, edge, start, thick)
    pygame.draw.polygon(large, ink, points)
    return pygame.transform.smoothscale(large, (cell, cell))


@dataclass(frozen=True)
class Swatch:
    """An entry of the legend: a little cell, filled or framed, and what it means."""

    label: str
    fill: Colour | None = None
    frame: Colour = INK
    thick: int = 1


NEVER_VISITED = Swatch("never visited", UNKNOWN, UNKNOWN_INK)
UNREACHABLE = Swatch("cannot be reached", UNKNOWN, UNKNOWN_INK)


class Sheet:
    """A picture under construction; `world` is the surface of its middle, of that `size` in pixels.

    The ground is transparent, so that it fits light pages and dark ones, or white where it is `opaque`. The
    middle has a border of `cell` pixels, which is the unit of what is drawn in it; `names` is the height of
    what is written into the upper border itself. The legend has 1 or 2 rows. Words are `zoom` times as large
    as they have to be.
    """

    def __init__(
        self, size: Size, cell: int, legend_rows: int = 1, opaque: bool = False, names: int = 0, zoom: int = 1
    ) -> None:
        self.cell, self._zoom, (width, height) = cell, zoom, size
        self.text_size = min(max(cell // 4, 15 * zoom), 20 * zoom)  # of caption and legend, in pixels
        self._legend_rows, self._names = legend_rows, names
        # The border of a cell is extended where words would not fit into it.
        top = names + max(0, round(2.6 * self.text_size) - cell)
        bottom = max(0, round((1.1 + 1.5 * legend_rows) * self.text_size) - cell)
        side = max(0, 21 * self.text_size - width + 1) // 2
        whole = width + 2 * side, top + height + bottom
        self._surface = import_pygame().Surface(whole, 0 if opaque else import_pygame().SRCALPHA, 32)
        self._surface.fill((*PAPER, 0))
        self.world: Any = self._surface.subsurface((side, top, *size))

    def number_size(self, numbers: FloatArray, high: float, room: float) -> int:
        """The font size at which numbers fit into `room` cells; 0 where they could not be read."""
        most = min(round(0.3 * self.cell), 20 * self._zoom)
        texts = {short(each, high) for each in set(numbers.tolist())}
        if most < SMALLEST_TEXT or not texts:
            return 0
        return text_size(max(texts, key=lambda text: text_width(text, most)), most, room * self.cell) or 0

    def write_numbers(
        self,
        numbers: FloatArray,
        chosen: BoolArray,
        colours: ColourArray,
        high: float,
        size: int,
        middle: Callable[[int, int], Point],
        on_plates: bool = False,
    ) -> None:
        """Write the chosen ones of numbers (S, P) on colours (S, P, 3), which may hide what is below."""
        dark = is_dark(colours)
        for state, part in np.argwhere(chosen).tolist() if size else []:
            ink = PAPER if dark[state, part] else INK
            plate = colours[state, part] if on_plates else None
            self.write(short(float(numbers[state, part]), high), middle(state, part), size, ink, plate)

    def draw_shape(self, middle: Point, corners: Corners, ink: Colour, edge: Colour | None = None) -> None:
        """Draw a shape in a cell around a point of `world`, with an edge of another colour."""
        left, top = (round(place - self.cell / 2) for place in middle)
        self.world.blit(_smooth(self.cell, corners, ink, edge), (left, top))

    def write(
        self, text: str, middle: Point, size: int, ink: Colour, plate: ColourArray | None = None
    ) -> None:
        """Write a text around a point of `world`, on a plate of that colour."""
        image = font(size).render(text, True, ink)
        box = image.get_rect(center=middle)
        if plate is not None:
            self.world.fill(plate.tolist(), box)
        self.world.blit(image, box)

    def caption(self, text: str) -> None:
        """Write one or two lines above the grid, smaller where they are long."""
        self._write_lines(text, (self.world.get_offset()[1] + self.cell - self._names) // 2)

    def footer(self, text: str) -> None:
        """Write one line below the grid."""
        self._write_lines(text, (self._bottom() + self._surface.get_height()) // 2)

    def _bottom(self) -> int:
        """The lower end of the grid, without its border."""
        return int(self.world.get_offset()[1] + self.world.get_height() - self.cell)

    def _write_lines(self, text: str, middle: int) -> None:
        width, size, lines = self._surface.get_width(), self.text_size, text.splitlines()
        widest = max(lines, key=lambda line: text_width(line, size), default="")
        centred = max(6, (width - text_width(widest, size)) // 2)
        left = min(self.world.get_offset()[0] + self.cell, centred)
        for number, line in enumerate(lines):
            down = round((number - (len(lines) - 1) / 2) * 1.25 * size)
            fitting = text_size(line, size, width - left - 6) or SMALLEST_TEXT
            write(self._surface, line, left, middle + down, fitting)

    def legend(self, scale: Scale, name: str, swatches: Sequence[Swatch] = ()) -> None:
        """Draw the colour bar between its ends, and the swatches, in the second row if any."""
        low = f"{name} {short(scale.low, scale.high)}"
        high = short(scale.high) + (", log scale" if scale.logarithmic else "")
        total, bottom = self._surface.get_width(), self._bottom()
        edge = self.world.get_offset()[0] + self.cell
        rows = (0.5,) if self._legend_rows == 1 else (0.32, 0.74)  # heights within what is below the grid
        middles = [bottom + round((self._surface.get_height() - bottom) * row) for row in rows]
        size, gap = self.text_size, self.text_size // 2
        beside = self._swatches_width(swatches, size) if len(rows) == 1 else 0
        ends = text_width(low, size) + text_width(high, size) + 2 * gap
        bar = max(3 * size, min(12 * size, total - edge - 3 * gap - beside - ends))
        left, middle = max(4, min(edge, total - 3 * gap - bar - beside - ends)), middles[0]
        left = write(self._surface, low, left, middle, size) + gap
        box = (left, middle - size // 2, bar, size)
        steps = np.linspace(0, len(scale.ramp) - 1, bar).round().astype(np.intp)
        pixels = np.tile(scale.ramp[steps], (size, 1, 1))
        self._surface.blit(import_pygame().image.frombuffer(pixels, (bar, size), "RGB"), box)
        import_pygame().draw.rect(self._surface, WORDS, box, 1)
        left = write(self._surface, high, left + bar + gap, middle, size) + 2 * gap
        if len(rows) > 1:
            wide = self._swatches_width(swatches, size)
            size = max(SMALLEST_TEXT, int(size * min(1.0, (total - 8) / max(1, wide))))
            left = max(4, min(edge, total - 4 - self._swatches_width(swatches, size)))
        for swatch in swatches:
            box = (left, middles[-1] - size // 2, size, size)
            self._surface.fill(swatch.fill or (*PAPER, 0), box)
            import_pygame().draw.rect(self._surface, swatch.frame, box, swatch.thick * self._zoom)
            left = write(self._surface, swatch.label, left + size + size // 4, middles[-1], size) + size

    def _swatches_width(self, swatches: Sequence[Swatch], size: int) -> int:
        gaps = size * max(0, len(swatches) - 1)
        return gaps + sum(size + size // 4 + text_width(swatch.label, size) for swatch in swatches)

    def frame(self) -> Frame:
        """The picture's pixels (height, width, 4), RGBA, or 3, RGB, where it is opaque."""
        return surface_to_frame(self._surface, "RGBA" if self._surface.get_masks()[3] else "RGB")

    def packed(self) -> Packed:
        """The same with one number per pixel, a fresh array."""
        return np.asarray(self._surface.get_view("2")).T & np.uint32(0xFFFFFF)


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
