"""A figure of the report: its style, heading and legend, and what it is saved as (page, SVG, PDF, PNG).

Figures are drawn in the page's light colours, which it replaces in dark mode. The agents' colours are those
of M. Okabe and K. Ito, Color Universal Design, 2008, which people with any kind of colour vision can tell
apart; from the eighth agent on, lines are dashed.
"""

from __future__ import annotations

import io
import re
import textwrap
import warnings
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from html import escape
from typing import Any, Literal

from matplotlib import style
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patheffects import Normal
from matplotlib.text import Text
from matplotlib.ticker import MaxNLocator

from gridworld.process.console.terminal import plain

_COLOURS = {  # on a light page, on a dark one
    "paper": ("#ffffff", "#171b22"),
    "ink": ("#1c2430", "#e8ebf0"),
    "muted": ("#5d6878", "#9aa5b5"),
    "grid": ("#e3e7ed", "#2b323d"),
    "c0": ("#0072b2", "#4aa5dd"),
    "c1": ("#d55e00", "#f0803c"),
    "c2": ("#009e73", "#2ec495"),
    "c3": ("#b8578f", "#e39cc6"),
    "c4": ("#c98500", "#f0b543"),
    "c5": ("#3a9bd9", "#8fccf3"),
    "c6": ("#4a4f57", "#c3c9d3"),
}
LIGHT = {name: light for name, (light, _) in _COLOURS.items()}
DARK = {name: dark for name, (_, dark) in _COLOURS.items()}
INK, MUTED, GRID, PAPER = (LIGHT[name] for name in ("ink", "muted", "grid", "paper"))
AGENT_PAINTS = 7
_DASHES = ((), (6.0, 3.0), (2.0, 2.5))

WIDTH = 440.0  # points, of a figure; pixels in the page
WIDE = 960.0
SMALL, LABEL, HEADING = 11.0, 12.0, 14.0  # points, of fonts
LINE = 14.5  # points, from one line of a text to the next
_POINTS = 72  # an inch
_MOST_LINES = 6  # of a name
_LEGEND = 63  # characters that fit beside each other in a legend
_HANDLE = 6  # characters that a name's line and the gaps take there

_RC = {
    "font.family": ["DejaVu Sans", "sans-serif"],  # the first comes with matplotlib
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": SMALL,
    "text.parse_math": False,  # names may be anybody's: no formulas
    "text.color": INK,
    **{f"axes.spines.{side}": False for side in ("left", "right", "top", "bottom")},
    **{f"{axis}tick.color": MUTED for axis in "xy"},
    **{f"{axis}tick.major.size": 0.0 for axis in "xy"},
    **{f"{axis}tick.major.pad": 6.0 for axis in "xy"},
    **{f"{axis}tick.labelsize": SMALL for axis in "xy"},
    "axes.axisbelow": True,
    "axes.labelcolor": MUTED,
    "axes.labelsize": SMALL,
    "axes.labelpad": 3.0,
    "xaxis.labellocation": "right",
    "yaxis.labellocation": "top",
    "grid.color": GRID,
    "grid.linewidth": 1.0,
    "lines.scale_dashes": False,
    "lines.solid_capstyle": "butt",
    "lines.markeredgewidth": 0.0,
    "legend.frameon": False,
    "legend.borderpad": 0.0,
    "legend.handlelength": 1.6,
    "legend.handletextpad": 0.5,
    "legend.columnspacing": 1.1,
    "legend.fontsize": SMALL,
    "svg.fonttype": "none",  # text stays text
}

_CHANGING = {"svg": "Date", "pdf": "CreationDate", "png": "Software"}  # entries that are left out
_SVG_FONT = "font-family: 'DejaVu Sans', sans-serif; "  # the page has its own
_OF_A_FILE = re.compile(r"<metadata>.*?</metadata>|<style.*?</style>", re.DOTALL)
_TAG = re.compile(r"<[^>]*>")
_COLOUR = re.compile("|".join(LIGHT.values()))
_PAINTS = {colour: f"var(--{paint})" for paint, colour in LIGHT.items()}


@contextmanager
def house_style(salt: str = "") -> Iterator[None]:
    """Draw and save in the report's style, whatever the user's matplotlib is set to.

    `salt` tells the ids in this figure's SVG from those in another's, without chance.
    """
    with warnings.catch_warnings(), style.context(["default", _RC | {"svg.hashsalt": salt}]):
        warnings.filterwarnings("ignore", "Glyph .* missing", UserWarning)
        warnings.filterwarnings("ignore", "constrained_layout not applied", UserWarning)
        yield


@dataclass(frozen=True)
class Style:
    """How an agent is drawn in all figures: its colour's name in `LIGHT` and `DARK`, its line's dashes."""

    paint: str
    dash: tuple[float, ...] = ()

    @property
    def line(self) -> dict[str, Any]:
        """Arguments of matplotlib's lines: colour and dashes."""
        return {"color": LIGHT[self.paint], "linestyle": (0, self.dash) if self.dash else "solid"}


Styles = Mapping[str, Style]  # by agent


def styles(agents: Sequence[str]) -> dict[str, Style]:
    """A style for each agent."""
    return {
        agent: Style(f"c{index % AGENT_PAINTS}", _DASHES[index // AGENT_PAINTS % len(_DASHES)])
        for index, agent in enumerate(agents)
    }


@dataclass(frozen=True)
class Chart:
    """A figure, laid out."""

    name: str  # of its files
    title: str  # what it is called where it cannot be seen
    description: str  # what is drawn, with which statistic of how many seeds; the caption in the page
    figure: Figure  # in the colours of `LIGHT`

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

    @cached_property
    def svg(self) -> str:
        """A file whose text is text."""
        return self.saved_as("svg").decode("utf-8")

    def saved_as(self, kind: str) -> bytes:
        """A file, "png", "pdf" or "svg". A PDF's text is outlines: proper fonts take 0.4 s."""
        texts = self.figure.findobj(Text) if kind == "pdf" else []
        for text in texts:
            text.set_path_effects([Normal()])
        metadata = {"Title": plain(f"{self.title}: {self.description}"), _CHANGING[kind]: None}
        buffer = io.BytesIO()
        with house_style(plain(self.name)):
            scale = 2 if kind == "png" else 1
            self.figure.savefig(buffer, format=kind, dpi=scale * _POINTS, facecolor=PAPER, metadata=metadata)
        for text in texts:
            text.set_path_effects([])
        return buffer.getvalue()

    def svg_element(self) -> str:
        """An SVG element in the page's font, as wide as the page lets it, its colours CSS variables."""
        width, height = self.figure.get_size_inches() * _POINTS
        body = self.svg[self.svg.index(">", self.svg.index("<svg ")) + 1 :]
        body = _TAG.sub(lambda tag: _for_page(tag[0]), _OF_A_FILE.sub("", body))
        told = escape(plain(self.title))
        return f'<svg viewBox="0 0 {width:g} {height:g}" role="img" aria-label="{told}">{body}'


def _for_page(tag: str) -> str:
    """Colours, numbers and names of one of a figure's tags as they are in a page, where it is not alone."""
    tag = re.sub(r' id="[^"]*"', "", tag) if tag.startswith("<g ") else tag
    tag = _COLOUR.sub(lambda found: _PAINTS[found[0]], tag.replace(_SVG_FONT, ""))
    return re.sub(r"(\.\d\d)\d+", r"\1", tag)


def new_figure(
    heading: str,
    height: float,
    grid: Literal["x", "y", None] = None,
    legend: Sequence[tuple[Artist, str]] = (),
    width: float = WIDTH,
) -> tuple[Figure, Axes]:
    """A figure with a heading and a legend above its axes, which are about `height` points high.

    `grid` is the axis with lines across at its numbers, `legend` has handles with names of a line or more.
    """
    names = [name for _, name in legend]
    columns, lines = 1, sum(map(line_count, names))
    longest = max((len(line) for name in names for line in name.split("\n")), default=0)
    if all("\n" not in name for name in names):
        fits = sum(len(name) + _HANDLE for name in names) <= _LEGEND
        columns = max(1, len(names) if fits else _LEGEND // (longest + _HANDLE))
        lines = -(-len(names) // columns)
    points = height + 64 + LINE * lines
    layout = ConstrainedLayoutEngine(w_pad=8 / _POINTS, h_pad=4 / _POINTS)
    figure = Figure(figsize=(width / _POINTS, points / _POINTS), dpi=_POINTS, layout=layout)
    axes = figure.add_subplot(facecolor="none")
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


def rows_on(axes: Axes, names: Sequence[str]) -> None:
    """Give the vertical axis a row for each name, from the top."""
    axes.set(ylim=(len(names) - 0.5, -0.5), yticks=range(len(names)))
    axes.set_yticklabels(names, size=LABEL, color=INK)
    axes.tick_params(axis="y", pad=10)


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


def without_shared(names: Sequence[str]) -> list[str]:
    """The labels of one agent's configurations without its name: "ppo (n_steps=8)" as n_steps=8."""
    heads = {name.partition(" (")[0] for name in names if name.endswith(")")}
    if len(names) < 2 or len(heads) > 1 or not all(" (" in name and name.endswith(")") for name in names):
        return list(names)
    return [name.partition(" (")[2][:-1] for name in names]


def wrapped_apart(texts: Sequence[str], most: int) -> list[str]:
    """Break texts into lines of at most `most` characters; long ones lose their middle lines.

    Different texts that have lost what they differ in get a number.
    """
    told = []
    for text in texts:
        lines = textwrap.wrap(plain(text)[:1000], most, break_on_hyphens=False) or [""]
        if len(lines) > _MOST_LINES:
            lines = [*lines[: _MOST_LINES - 2], "…", lines[-1]]
        told.append("\n".join(lines))
    seen: dict[str, list[str]] = defaultdict(list)
    for text, short in dict(zip(texts, told, strict=True)).items():
        seen[short].append(text)
    return [
        f"{short} #{seen[short].index(text) + 1}" if len(seen[short]) > 1 else short
        for text, short in zip(texts, told, strict=True)
    ]


def line_count(text: str) -> int:
    """How many lines a text has."""
    return text.count("\n") + 1
