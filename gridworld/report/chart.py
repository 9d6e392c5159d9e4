"""A figure of the report: its style, heading and legend, and what it is saved as (SVG, PDF, PNG).

The agents' colours are those of M. Okabe and K. Ito, Color Universal Design, 2008, which people with any kind
of colour vision can distinguish; from the eighth agent on, lines are dashed.
"""

from __future__ import annotations

import functools
import io
import itertools
import textwrap
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from cycler import cycler
from matplotlib import rc_params_from_file, style
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patheffects import Normal
from matplotlib.text import Text
from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator

from gridworld.base.console import plain

INK, PAPER = "#6b7686", "#ffffff"  # ink that can be read on a light page and on a dark one
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#b8578f", "#c98500", "#3a9bd9", "#86624f")  # of agents
_DASHES = ("solid", (0, (6.0, 3.0)), (0, (2.0, 2.5)))

WIDTH = 440.0  # points, of a figure; pixels in the page
WIDE, HEIGHT = 960.0, 190.0  # of a wide figure; of curves
SMALL, LABEL, HEADING = 11.0, 12.0, 14.0  # points, of fonts
LINE = 14.5  # points, from one line of a text to the next
_POINTS = 72  # an inch
_MOST_LINES = 6  # of a name
_LEGEND = 63  # characters that fit next to each other in a legend
_HANDLE = 6  # characters that a name's line and the gaps take there

_STYLE_FILE = Path(__file__).with_name("figures.mplstyle")
_STYLE = {str(name): value for name, value in rc_params_from_file(_STYLE_FILE, False, False).items()}
_CHANGING = {"svg": "Date", "pdf": "CreationDate", "png": "Software"}  # entries that are left out


@contextmanager
def house_style(salt: str = "") -> Iterator[None]:
    """The report's style, whatever the user's matplotlib is set to; `salt` makes ids in SVG reproducible."""
    with warnings.catch_warnings(), style.context(["default", _STYLE, {"svg.hashsalt": salt}]):
        warnings.filterwarnings("ignore", "Glyph .* missing", UserWarning)
        warnings.filterwarnings("ignore", "constrained_layout not applied", UserWarning)
        yield


Styles = Mapping[str, dict[str, Any]]  # by agent: arguments of matplotlib's lines, colour and dashes


def styles(agents: Sequence[str]) -> Styles:
    """How each agent is drawn in all figures."""
    return dict(zip(agents, itertools.cycle(cycler(linestyle=_DASHES) * cycler(color=COLOURS)), strict=False))


class NotebookFigure(Figure):
    """Is shown in a notebook, whether pyplot was imported there or not."""

    def _repr_png_(self) -> bytes:
        buffer = io.BytesIO()
        self.savefig(buffer, format="png", dpi=1.5 * _POINTS)
        return buffer.getvalue()


@dataclass(frozen=True)
class Chart:
    """A figure, laid out."""

    name: str  # of its files
    title: str  # what it is called where it cannot be seen
    description: str  # what is drawn, with which statistic of how many seeds; the caption in the page
    figure: NotebookFigure

    def __post_init__(self) -> None:
        if (engine := self.figure.get_layout_engine()) is not None:
            engine.execute(self.figure)
        self.figure.set_layout_engine("none")  # what it found stays, whatever it is saved as

    @property
    def is_wide(self) -> bool:
        """Whether it takes the page's whole width."""
        return bool(self.figure.get_figwidth() * _POINTS > WIDTH)

    @property
    def caption(self) -> str:
        """The description as a sentence."""
        return plain(f"{self.description[0].upper()}{self.description[1:]}.")

    def saved_as(self, kind: str) -> bytes:
        """A file, "png", "pdf" or "svg". A PDF's text is outlines: proper fonts take 0.4 s."""
        texts = self.figure.findobj(Text) if kind == "pdf" else []
        for text in texts:
            text.set_path_effects([Normal()])
        metadata = {"Title": plain(f"{self.title}: {self.description}"), _CHANGING[kind]: None}
        buffer = io.BytesIO()
        with house_style(plain(self.name)):
            scale = 2 if kind == "png" else 1
            self.figure.savefig(buffer, format=kind, dpi=scale * _POINTS, metadata=metadata)
        for text in texts:
            text.set_path_effects([])
        return buffer.getvalue()


def new_figure(
    heading: str,
    height: float,
    grid: Literal["x", "y", None] = None,
    legend: Sequence[tuple[Artist, str]] = (),
    width: float = WIDTH,
) -> tuple[NotebookFigure, Axes]:
    """A figure with a heading and a legend above its axes, which are about `height` points high."""
    names = [name for _, name in legend]
    columns, lines = 1, sum(name.count("\n") + 1 for name in names)
    if names and lines == len(names):
        fits = sum(len(name) + _HANDLE for name in names) <= _LEGEND
        columns = len(names) if fits else max(1, _LEGEND // (max(map(len, names)) + _HANDLE))
        lines = -(-len(names) // columns)
    size = width / _POINTS, (height + 64 + LINE * lines) / _POINTS
    layout = ConstrainedLayoutEngine(w_pad=8 / _POINTS, h_pad=4 / _POINTS)
    figure = NotebookFigure(figsize=size, dpi=_POINTS, layout=layout)
    axes = figure.add_subplot()
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
        axis.set_major_formatter(compact)
    if grid is not None:
        axes.grid(axis=grid, clip_on=False)
    figure.legend(
        [handle for handle, _ in legend],
        names,
        ncols=columns,
        loc="outside upper left",
        title=clipped(heading, int(width / 8.7)),
        title_fontproperties={"size": HEADING, "weight": "bold"},
        alignment="left",
    )
    return figure, axes


def figure_of_rows(
    heading: str, names: Sequence[str], least: float, grid: Literal["x", None] = "x"
) -> tuple[NotebookFigure, Axes, float]:
    """A figure with a row for each name, from the top; also returns how high one is, in points."""
    each = least + LINE * max(name.count("\n") for name in names)
    figure, axes = new_figure(heading, each * len(names), grid)
    axes.set(ylim=(len(names) - 0.5, -0.5), yticks=range(len(names)))
    axes.set_yticklabels(names, size=LABEL)
    axes.tick_params(axis="y", pad=10)
    return figure, axes, each


def log_axis(axes: Axes, name: Literal["x", "y"], low: float, high: float) -> None:
    """Make an axis logarithmic between two ends, with as many marks as there is room for."""
    axes.set(**{f"{name}scale": "log", f"{name}lim": (low, high)})
    axis = axes.xaxis if name == "x" else axes.yaxis
    axis.set_major_locator(
        LogLocator(10, (1, 2, 5) if high < 60 * low else (1, 3) if high < 600 * low else (1,))
    )
    axis.set_major_formatter(compact)
    axis.set_minor_locator(NullLocator())


def compact(number: float, _position: float = 0) -> str:
    """Write 12000 as 12k. Matplotlib gives a tick's position, too."""
    for size, sign in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if abs(number) >= size:
            return f"{number / size:.4g}{sign}"
    return f"{number:.4g}"


def percent(number: float, _position: float = 0) -> str:
    """Write 0.5 as 50 %."""
    return f"{100 * number:.0f} %"


def clipped(text: str, most: int) -> str:
    """Escape control characters, and shorten in the middle what is longer than `most` characters."""
    text = plain(text)
    half = max(1, (most - 1) // 2)
    return text if len(text) <= most else f"{text[:half]}…{text[-half:]}"


def short_names(names: Sequence[str], most: int) -> list[str]:
    """Labels in at most six lines of `most` characters; of one agent's configurations without its name."""
    parts = [name.removesuffix(")").partition(" (") for name in names]
    is_one_agent = len(names) > 1 and len({head for head, _, _ in parts}) == 1
    shown = [tail for _, _, tail in parts] if is_one_agent and all(map(all, parts)) else names
    wrap = functools.partial(
        textwrap.wrap, width=most, break_on_hyphens=False, max_lines=_MOST_LINES, placeholder=" …"
    )
    return ["\n".join(wrap(plain(name)[:1000])) for name in shown]


def seed_counts(counts: Sequence[int]) -> str:
    """Write numbers of seeds: "5 seeds", "3 to 5 seeds"."""
    return f"{' to '.join(map(str, dict.fromkeys((min(counts), max(counts)))))} seeds"
