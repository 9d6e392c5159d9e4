"""The figures of swept settings: a line for one, a heatmap for two; of more, the tables tell."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.colors import LinearSegmentedColormap

from gridworld.report.analysis.analyse import Result
from gridworld.report.analysis.statistics import Interval
from gridworld.report.charts import chart
from gridworld.report.charts.chart import INK, LIGHT, MUTED, PAPER, SMALL, Chart, clipped, house_style
from gridworld.report.evidence.grouping import differing, learning_key
from gridworld.report.table import number, steps_up_to

_LEAST = 3  # configurations that make a sweep, and more of them than settings that differ
_LINE = 64  # characters of tick labels beside each other
_NEVER = "#c6c6c6"  # of cells without a finite value: no colour of the ramp
_RAMP = LinearSegmentedColormap.from_list("share", ["#eaf2f8", "#7fb8dc", "#0a5a8c"])
_ON_LIGHT, _ON_DARK = "#10161e", "#fcfdfe"  # of numbers in cells, the same in a dark page


@dataclass(frozen=True, eq=False)
class Sweep:
    """The results of one agent on one task by the values of what was swept, the smallest first.

    Not every combination of values need have a result.
    """

    agent: str
    keys: tuple[str, ...]
    values: tuple[tuple[str, ...], ...]  # of each key
    results: Mapping[tuple[str, ...], Result]  # by a value for each key


def sweeps(results: Sequence[Result]) -> list[Sweep]:
    """Find the agents among a task's results of which settings were swept."""
    by_agent: dict[str, list[Result]] = defaultdict(list)
    for result in results:
        by_agent[result.group.runs[0].agent].append(result)
    found = []
    for agent, members in by_agent.items():
        settings = [dict(learning_key(result.group.runs[0])) for result in members]
        keys = tuple(differing(settings))
        if len(members) >= max(_LEAST, len(keys) + 1):
            places = [tuple(each.get(key, "") for key in keys) for each in settings]
            values = tuple(tuple(sorted(set(column), key=_order)) for column in zip(*places, strict=True))
            found.append(Sweep(agent, keys, values, dict(zip(places, members, strict=True))))
    return found


def _order(value: str) -> tuple[bool, float, str]:
    """Numbers by their size, then words."""
    try:
        return False, float(value), ""
    except ValueError:
        return True, 0.0, value


@dataclass(frozen=True)
class _Shown:
    """What a figure shows of a result."""

    name: str
    title: str
    of: Callable[[Result], Interval]
    text: Callable[[Result], str]  # in a heatmap's cell
    told: str  # which statistic it is
    better: int  # 1 where more is better
    form: Callable[..., str] = chart.compact


def _share(result: Result) -> Interval:
    share = result.certified
    return Interval(share.count / share.total, share.low, share.high)


_SHOWN = (
    _Shown(
        "certified",
        "seeds certified",
        _share,
        lambda result: f"{result.certified.count}/{result.certified.total}",
        "share of seeds certified at the end",
        1,
        chart.percent,
    ),
    _Shown(
        "steps",
        "steps to certificate",
        lambda result: result.estimates["steps", "median"],
        lambda result: steps_up_to(result.shortest_uncertified)(result.estimates["steps", "median"].point),
        "steps to the first certificate, median over seeds; none where half of them have no certificate",
        -1,
    ),
    _Shown(
        "regret",
        "final regret",
        lambda result: result.estimates["regret", "iqm"],
        lambda result: number(result.estimates["regret", "iqm"].point),
        "interquartile mean (IQM) over seeds",
        -1,
    ),
)


def sweep_charts(sweep: Sweep, task: str) -> Iterator[Chart]:
    """A figure for each metric that is finite somewhere and not 0 everywhere; none of three keys or more."""
    if len(sweep.keys) > 2:
        return
    keys = " and ".join(map(_short, sweep.keys))
    counts = sorted({len(result.group.runs) for result in sweep.results.values()})
    seeds = " to ".join(map(str, dict.fromkeys((counts[0], counts[-1]))))
    draw = _line if len(sweep.keys) == 1 else _heatmap
    for shown in _SHOWN:
        points = np.array([shown.of(result).point for result in sweep.results.values()])
        if np.isfinite(points).any() and points.any():
            title = f"{shown.title[0].upper()}{shown.title[1:]} by {keys}"
            told = f"{shown.told}; {sweep.agent} on {task}, {seeds} seeds each"
            yield draw(sweep, shown, f"{task} {sweep.agent} {shown.name} by {keys}", title, told)


@house_style()
def _line(sweep: Sweep, shown: _Shown, name: str, title: str, told: str) -> Chart:
    (values,) = sweep.values
    found = [shown.of(sweep.results[(value,)]) for value in values]
    ends = np.array([(each.point, each.low, each.high) for each in found])
    is_share = shown.form is chart.percent
    top = 1.0 if is_share else 1.06 * float(ends[np.isfinite(ends)].max()) or 1.0
    points, low, high = np.where(np.isfinite(ends[:, :1]), np.minimum(ends, top), np.nan).T
    figure, axes = chart.new_figure(title, 190, "y")
    axes.yaxis.set_major_formatter(shown.form)
    axes.set(ylim=(0.0, top), ylabel=shown.title, xlabel=_short(sweep.keys[0]))
    axes.set(xlim=(-0.4, len(values) - 0.6), xticks=range(len(values)))
    axes.set_xticklabels([clipped(value, max(4, _LINE // len(values))) for value in values])
    colour = LIGHT["c0"]
    axes.plot(points, "o-", color=colour, linewidth=2.2, markersize=7, clip_on=False)
    axes.vlines(range(len(values)), low, high, color=colour, linewidth=4, alpha=0.35, clip_on=False)
    for at in np.flatnonzero(~np.isfinite(ends[:, 0])):
        axes.annotate("never", (at, top), (0, -10), textcoords="offset points", color=MUTED, ha="center")
    kind = "Wilson's" if is_share else "bootstrap"
    return Chart(name, title, f"{told}, with {kind} 95 % intervals", figure)


@house_style()
def _heatmap(sweep: Sweep, shown: _Shown, name: str, title: str, told: str) -> Chart:
    rows, columns = sweep.values
    cells = {
        (rows.index(row), columns.index(column)): result for (row, column), result in sweep.results.items()
    }
    levels = np.full((len(rows), len(columns)), np.nan)
    for at, result in cells.items():
        point = shown.of(result).point
        levels[at] = shown.better * point if math.isfinite(point) else -math.inf
    finite = levels[np.isfinite(levels)]
    low, high = (0.0, 1.0) if shown.form is chart.percent else (float(finite.min()), float(finite.max()))
    figure, axes = chart.new_figure(title, 34 * len(rows))
    colours = _RAMP.with_extremes(bad=(0, 0, 0, 0), under=_NEVER)
    shades: dict[str, Any] = {
        "vmin": low,
        "vmax": high if high > low else low + 1,
        "edgecolors": PAPER,
        "linewidth": 2,
    }
    mesh = axes.pcolormesh(np.maximum(levels, low - 1), cmap=colours, **shades)
    for (row, column), result in cells.items():
        red, green, blue, _ = mesh.to_rgba(np.maximum(levels[row, column], low - 1))
        text, is_dark = shown.text(result), 0.299 * red + 0.587 * green + 0.114 * blue < 0.55
        if len(text) * len(columns) < _LINE:
            colour = _ON_DARK if is_dark else _ON_LIGHT
            axes.text(column + 0.5, row + 0.5, text, ha="center", va="center", color=colour)
    axes.set(ylim=(len(rows), 0), xlabel=_short(sweep.keys[1]), ylabel=_short(sweep.keys[0]))
    shown_columns = [clipped(value, max(4, _LINE // len(columns))) for value in columns]
    axes.set_xticks(np.arange(len(columns)) + 0.5, shown_columns, color=INK, size=SMALL)
    axes.set_yticks(np.arange(len(rows)) + 0.5, [clipped(value, 14) for value in rows], color=INK, size=SMALL)
    grey = "; grey cells have no finite value" if np.isneginf(levels).any() else ""
    return Chart(name, title, f"{told}; darker is better{grey}", figure)


def _short(key: str) -> str:
    """`agent.learning_rate` as learning_rate."""
    return key.removeprefix("agent.")
