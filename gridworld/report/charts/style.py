"""How the report's figures look: colours, the agents' lines, fonts, and how numbers and names are written.

Figures are drawn in the page's light colours; `chart.py` lets the page replace them in dark mode. The agents'
colours are those of M. Okabe and K. Ito, Color Universal Design, 2008, which people with any kind of colour
vision can tell apart; from the eighth agent on, lines are dashed.
"""

from __future__ import annotations

import warnings
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from matplotlib import style
from matplotlib.font_manager import FontProperties
from matplotlib.textpath import text_to_path

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
SMALL = 11.0  # points, of tick labels and legends; a point of a figure is a pixel of the page
LABEL = 12.0
HEADING = 14.0
FONT = "font-family: 'DejaVu Sans', sans-serif; "  # as the SVG has it; the page has its own

LINE = 14.0  # points, from one line of a name to the next
_MOST_LINES = 6  # of a name

AGENT_PAINTS = 7
_DASHES = ((), (6.0, 3.0), (2.0, 2.5))
_RC = {
    "font.family": ["DejaVu Sans", "sans-serif"],  # the first comes with matplotlib
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": SMALL,
    "text.parse_math": False,  # names may be anybody's: no formulas
    "text.color": INK,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "axes.labelcolor": MUTED,
    "axes.labelsize": SMALL,
    "axes.labelpad": 3.0,
    "xaxis.labellocation": "right",
    "grid.color": GRID,
    "grid.linewidth": 1.0,
    "lines.scale_dashes": False,
    "lines.solid_capstyle": "butt",
    "lines.markeredgewidth": 0.0,
    "svg.fonttype": "none",  # text stays text
}


@dataclass(frozen=True)
class Style:
    """How an agent is drawn, the same in all figures.

    Attributes:
        paint: name of its colour in `LIGHT` and `DARK`.
        dash: lengths of dashes and gaps in points; empty for a solid line.
    """

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


@contextmanager
def house_style(salt: str = "") -> Iterator[None]:
    """Draw and save in the report's style, whatever the user's matplotlib is set to.

    Args:
        salt: tells the ids in this figure's SVG from those in another's, without chance.
    """
    with warnings.catch_warnings(), style.context(["default", _RC | {"svg.hashsalt": salt}]):
        warnings.filterwarnings("ignore", "Glyph .* missing", UserWarning)
        yield


def compact(number: float) -> str:
    """Write 12000 as 12k."""
    for size, sign in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if abs(number) >= size:
            return f"{number / size:.4g}{sign}"
    return f"{number:.4g}"


def percent(number: float) -> str:
    """Write 0.5 as 50 %."""
    return f"{100 * number:.0f} %"


def text_width(text: str, size: float, weight: str = "normal") -> float:
    """Width of a text's longest line in points. To be called in `house_style`."""
    font = FontProperties(size=size, weight=weight)
    lines = text.split("\n")
    return max(
        float(text_to_path.get_text_width_height_descent(line, font, ismath=False)[0]) for line in lines
    )


def clipped(text: str, width: float, size: float, weight: str = "normal") -> str:
    """Escape control characters, and shorten in the middle what is wider than `width` points."""
    text = short = plain(text)[:1000]
    while (wide := text_width(short, size, weight)) > width and len(short) > 4:
        most = max(4, min(len(short) - 1, int(len(short) * width / wide)))
        short = f"{text[: most // 2]}…{text[len(text) - (most - most // 2 - 1) :]}"
    return short


def without_shared(names: Sequence[str]) -> list[str]:
    """The labels of one agent's configurations without its name: "ppo (n_steps=8)" as n_steps=8."""
    heads = {name.partition(" (")[0] for name in names if name.endswith(")")}
    if len(names) < 2 or len(heads) > 1 or not all(" (" in name and name.endswith(")") for name in names):
        return list(names)
    return [name.partition(" (")[2][:-1] for name in names]


def wrapped(text: str, width: float, size: float) -> str:
    """Escape control characters, and break lines at blanks, or within words that are wider than `width`.

    A text of more than `_MOST_LINES` lines loses its middle.
    """
    lines: list[str] = []
    for word in plain(text)[:1000].split(" "):
        longer = f"{lines[-1]} {word}" if lines else word
        if lines and text_width(longer, size) <= width:
            lines[-1] = longer
        else:
            lines += _broken(word, width, size)
    if len(lines) > _MOST_LINES:
        lines = [*lines[: _MOST_LINES - 2], "…", lines[-1]]
    return "\n".join(lines)


def _broken(word: str, width: float, size: float) -> Iterator[str]:
    """The word in pieces of at most `width` points."""
    while word:
        most = len(word)
        while most > 1 and (wide := text_width(word[:most], size)) > width:
            most = max(1, min(most - 1, int(most * width / wide)))
        yield word[:most]
        word = word[most:]


def wrapped_apart(texts: Sequence[str], width: float, size: float) -> list[str]:
    """Wrap the texts. Different ones that have lost what they differ in get a number."""
    told = [wrapped(text, width, size) for text in texts]
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
