"""A figure of the report: its frame, its legend, and what it is saved as (page, SVG, PDF, PNG)."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from html import escape
from typing import Any, Literal

from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import Normal
from matplotlib.text import Text
from matplotlib.ticker import MaxNLocator

from gridworld.process.console.terminal import plain
from gridworld.report.charts import style
from gridworld.report.charts.style import LIGHT, SMALL, clipped, house_style, text_width

WIDTH = 440.0  # points, of a figure; pixels in the page
_POINTS = 72  # an inch
_PNG_SCALE = 2  # pixels a point
_ROW = 17.0  # points, of a legend
_LEGEND_TOP = 32.0
_HANDLE, _GAP, _BETWEEN = 18.0, 6.0, 12.0  # points, in a legend: a line, before its name, after it
Bounds = tuple[float, float]  # of an axis, the lower one first

_OF_A_FILE = re.compile(r"<metadata>.*?</metadata>|<style.*?</style>", re.DOTALL)
_TAG = re.compile(r"<[^>]*>")
_COLOUR = re.compile("|".join(LIGHT.values()))
_PAINTS = {colour: f"var(--{paint})" for paint, colour in LIGHT.items()}


@dataclass(frozen=True)
class Chart:
    """A figure.

    Attributes:
        name: of its files.
        title: what it is called where it cannot be seen.
        description: what is drawn, with which statistic of how many seeds; the caption in the page.
        figure: of matplotlib, drawn in the colours of `LIGHT`.
    """

    name: str
    title: str
    description: str
    figure: Figure

    @property
    def is_wide(self) -> bool:
        """Whether it takes the page's whole width."""
        return _size(self.figure)[0] > WIDTH

    @property
    def caption(self) -> str:
        """The description as a sentence."""
        return plain(f"{self.description[0].upper()}{self.description[1:]}.")

    @property
    def told(self) -> str:
        """The figure in words."""
        return plain(f"{self.title}: {self.description}")

    @cached_property
    def svg(self) -> str:
        """A file whose text is text."""
        return self._saved("svg", metadata={"Title": self.told, "Date": None}).decode("utf-8")

    def pdf(self) -> bytes:
        """A file for a paper. Text is outlines: a figure's fonts, as publishers want them, take 0.4 s."""
        with house_style():
            self.figure.draw_without_rendering()  # makes the tick labels
        texts = self.figure.findobj(Text)
        for text in texts:
            text.set_path_effects([Normal()])
        content = self._saved("pdf", metadata={"Title": self.told, "CreationDate": None})
        for text in texts:
            text.set_path_effects([])
        return content

    def png(self) -> bytes:
        """A picture on white."""
        return self._saved("png", dpi=_POINTS * _PNG_SCALE, metadata={"Software": None})

    def saved_as(self, kind: str) -> bytes:
        """The content of a file: "png", "pdf" or "svg"."""
        return {"png": self.png, "pdf": self.pdf, "svg": self.svg.encode}[kind]()

    def svg_element(self) -> str:
        """The SVG to stand in a page.

        Returns:
            An element in the page's font, as wide as the page lets it. Its colours are CSS variables of the
            page, named as in `LIGHT`.
        """
        width, height = _size(self.figure)
        body = self.svg[self.svg.index(">", self.svg.index("<svg ")) + 1 :]
        body = _TAG.sub(lambda tag: _for_page(tag[0]), _OF_A_FILE.sub("", body))
        told = escape(plain(self.title))
        return f'<svg viewBox="0 0 {width:g} {height:g}" role="img" aria-label="{told}">{body}'

    def _saved(self, kind: str, dpi: int = _POINTS, **options: Any) -> bytes:
        buffer = io.BytesIO()
        with house_style(plain(self.name)):
            self.figure.savefig(buffer, format=kind, dpi=dpi, facecolor=style.PAPER, **options)
        return buffer.getvalue()


def _for_page(tag: str) -> str:
    """Colours, numbers and names of one of a figure's tags as they are in a page, where it is not alone."""
    tag = re.sub(r' id="[^"]*"', "", tag) if tag.startswith("<g ") else tag
    tag = _COLOUR.sub(lambda found: _PAINTS[found[0]], tag.replace(style.FONT, ""))
    return re.sub(r"(\.\d\d)\d+", r"\1", tag)


def panel(
    heading: str,
    height: float,
    left: float,
    top: float = 36.0,
    right: float = 20.0,
    bottom: float = 24.0,
    width: float = WIDTH,
) -> tuple[Figure, Axes]:
    """The axes of a new figure with a heading.

    Args:
        heading: clipped to the figure's width.
        height: of the axes, points.
        left: points from the figure's edge to the axes, as are `top`, `right` and `bottom`.
        width: of the figure, points.

    Returns:
        The figure, and its axes without frame and ticks; `ticks_on` adds the latter.
    """
    whole = top + height + bottom
    figure = Figure(figsize=(width / _POINTS, whole / _POINTS), dpi=_POINTS)
    place = (left / width, bottom / whole, (width - left - right) / width, height / whole)
    axes = figure.add_axes(place, facecolor="none")
    axes.spines[:].set_visible(False)
    axes.tick_params(length=0, left=False, bottom=False, pad=6, labelsize=SMALL)
    axes.set(xticks=[], yticks=[])
    axes.set_axisbelow(True)
    heading = clipped(heading, width - 24, style.HEADING, "bold")
    figure.text(12 / width, 1 - 20 / whole, heading, size=style.HEADING, weight="bold")
    return figure, axes


def ticks(low: float, high: float, most: int = 6) -> list[float]:
    """Round numbers within [low, high]: multiples of 1, 2 or 5 times a power of ten."""
    found = MaxNLocator(most, steps=[1, 2, 5, 10]).tick_values(low, high)
    near = 1e-9 * (high - low)
    return [float(tick) + 0.0 for tick in found if low - near <= tick <= high + near]


def ticks_on(
    axes: Axes,
    axis: Literal["x", "y"],
    bounds: Bounds,
    marks: Iterable[float] | None = None,
    form: Callable[[float], str] = style.compact,
    grid: bool = True,
) -> None:
    """Give an axis its ends, its numbers and the lines at them.

    Args:
        axes: to be changed.
        axis: "x" or "y".
        bounds: numbers at the axis's ends, the lower one first.
        marks: where the numbers are; by default, `ticks` between the ends.
        form: how a number is written.
        grid: whether there are lines across.
    """
    found = ticks(*bounds, 5 if axis == "x" else 6) if marks is None else list(marks)
    axes.set(**{f"{axis}lim": bounds, f"{axis}ticks": found, f"{axis}ticklabels": list(map(form, found))})
    if grid:
        axes.grid(axis=axis, clip_on=False)


def log_ticks(low: float, high: float) -> list[float]:
    """1, 2 and 5 times the powers of ten within [low, high]; powers alone where that would be too many."""
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    factors = (1, 2, 5) if high < 60 * low else (1, 3) if high < 600 * low else (1,)
    found = [factor * 10.0**power for power in powers for factor in factors]
    return [tick for tick in found if low <= tick <= high]


def legend_rows(names: Sequence[str], width: float) -> list[list[int]]:
    """Which names, of a line or more, stand in which row of a legend that is at most `width` points wide."""
    rows: list[list[int]] = []
    left = 0.0
    for index, name in enumerate(names):
        wide = _HANDLE + _GAP + text_width(name, SMALL)
        if not rows or wide > left:
            rows, left = [*rows, []], width
        rows[-1].append(index)
        left -= wide + _BETWEEN
    return rows


def legend_height(names: Sequence[str], rows: Sequence[Sequence[int]]) -> float:
    """Points that the rows take."""
    return sum(_ROW + style.LINE * (max(style.line_count(names[index]) for index in row) - 1) for row in rows)


def legend(
    figure: Figure, handles: Sequence[Artist], names: Sequence[str], rows: Sequence[Sequence[int]]
) -> None:
    """Lay the handles with their names out in rows, below the heading and above the axes."""
    left = figure.axes[0].get_position().x0
    for number, row in enumerate(rows):
        above = legend_height(names, rows[:number])
        figure.legend(
            [handles[index] for index in row],
            [names[index] for index in row],
            ncols=len(row),
            loc="upper left",
            bbox_to_anchor=(left, 1 - (_LEGEND_TOP + above) / _size(figure)[1]),
            frameon=False,
            borderpad=0,
            borderaxespad=0,
            fontsize=SMALL,
            handlelength=_HANDLE / SMALL,
            handletextpad=_GAP / SMALL,
            columnspacing=_BETWEEN / SMALL,
        )


def _size(figure: Figure) -> tuple[float, float]:
    """Width and height, points."""
    width, height = figure.get_size_inches() * _POINTS
    return float(width), float(height)
