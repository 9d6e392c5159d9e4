"""The figures of swept settings: a line for one, heatmaps for more, a ranking where these would be empty."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, to_rgb

from gridworld.report.analysis.analyse import Result
from gridworld.report.analysis.statistics import Interval
from gridworld.report.analysis.sweeps import Sweep
from gridworld.report.charts import chart, style
from gridworld.report.charts.chart import WIDTH, Chart
from gridworld.report.charts.style import INK, LIGHT, MUTED, SMALL, clipped, house_style, text_width
from gridworld.report.table import number, steps_up_to

_CELL = 32.0  # points, the height of a heatmap's cell
_MOST_LINES = 40  # of cells in a figure
_WIDE = 960.0
_RAMP = LinearSegmentedColormap.from_list("share", ["#eaf2f8", "#7fb8dc", "#0a5a8c"])
_NEVER = "#c6c6c6"  # of cells without a finite value: no colour of the ramp
_ON_LIGHT, _ON_DARK = "#10161e", "#fcfdfe"  # of numbers in cells, the same in a dark page


@dataclass(frozen=True)
class _Shown:
    """What a figure shows of a result."""

    name: str
    title: str
    of: Callable[[Result], Interval]
    text: Callable[[Result], str]  # in a heatmap's cell
    told: str  # which statistic it is
    better: int  # 1 where more is better
    form: Callable[[float], str] = style.compact


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
        style.percent,
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
    """A figure for each metric that is finite somewhere and not 0 everywhere."""
    draw = _line if len(sweep.keys) == 1 else _heatmap if _is_grid(sweep) else _ranking
    for shown in _SHOWN:
        points = np.array([shown.of(result).point for result in sweep.results.values()])
        if np.isfinite(points).any() and points.any():
            yield draw(sweep, shown, task)


def _described(sweep: Sweep, shown: _Shown, task: str) -> tuple[str, str, str]:
    """The figure's name, heading and description."""
    keys = _listed(sweep.keys)
    counts = sorted({len(result.group.runs) for result in sweep.results.values()})
    seeds = " to ".join(map(str, dict.fromkeys((counts[0], counts[-1]))))
    title = f"{shown.title[0].upper()}{shown.title[1:]} by {keys}"
    told = f"{shown.told}; {sweep.agent} on {task}, {seeds} seeds each"
    return f"{task} {sweep.agent} {shown.name} by {keys}", title, told


@house_style()
def _line(sweep: Sweep, shown: _Shown, task: str) -> Chart:
    (values,) = sweep.values
    found = [shown.of(sweep.results[(value,)]) for value in values]
    place = np.arange(len(values))
    points, low, high = (np.array([getattr(each, end) for each in found]) for end in ("point", "low", "high"))
    finite = np.isfinite(points)
    seen = np.concatenate([ends[np.isfinite(ends)] for ends in (points, low, high)])
    bounds = (0.0, 1.0) if shown.form is style.percent else (0.0, 1.06 * float(seen.max()) or 1.0)
    name, title, told = _described(sweep, shown, task)
    left = 28 + max(text_width(shown.form(tick), SMALL) for tick in chart.ticks(*bounds))
    figure, axes = chart.panel(title, 190, left, right=24, bottom=40)
    chart.ticks_on(axes, "y", bounds, form=shown.form)
    axes.set_ylabel(shown.title, loc="top")
    room = (WIDTH - left - 24) / len(values)
    axes.set(xlim=(-0.4, len(values) - 0.6), xticks=place)
    axes.set_xticklabels([clipped(value, max(room, 24), SMALL) for value in values])
    axes.set_xlabel(_short(sweep.keys[0]))
    colour = LIGHT["c0"]
    axes.plot(place, np.where(finite, points, np.nan), "o-", color=colour, linewidth=2.2, markersize=7,
              clip_on=False)  # fmt: skip
    for at in np.flatnonzero(finite & np.isfinite(low)):
        ends = low[at], min(high[at], bounds[1])
        axes.plot((at, at), ends, color=colour, linewidth=4, alpha=0.35, clip_on=False)
    for at in np.flatnonzero(~finite):
        axes.annotate(
            "never", (at, bounds[1]), (0, -10), textcoords="offset points", color=MUTED, ha="center"
        )
    kind = "Wilson's" if shown.form is style.percent else "bootstrap"
    return Chart(name, title, f"{told}, with {kind} 95 % intervals", figure)


@house_style()
def _heatmap(sweep: Sweep, shown: _Shown, task: str) -> Chart:
    """Cells by the first two keys, for each combination of values of the others."""
    rows, columns = sweep.values[:2]
    name, title, told = _described(sweep, shown, task)
    others = _others(sweep)
    left = 30 + max(text_width(clipped(value, 90, SMALL), SMALL) for value in rows)
    lines = _lines(sweep)
    heading = f"{title.split(' by ')[0]} by {_listed(sweep.keys[:2])}"
    figure, axes = chart.panel(heading, _CELL * lines, left, right=16, bottom=40)
    room = (WIDTH - left - 16) / len(columns)
    paint_of = _paints(sweep, shown)
    step = lines // len(others)  # a line between two of them has the values of the others
    top = {other: index * step + step - len(rows) for index, other in enumerate(others)}
    for values, result in sweep.results.items():
        row, column = top[values[2:]] + rows.index(values[0]), columns.index(values[1])
        _cell(axes, (column, row), paint_of(result), shown.text(result), room)
    for other in filter(None, others):
        given = zip(map(_short, sweep.keys[2:]), other, strict=True)
        named = clipped(
            ", ".join(f"{key} = {value}" for key, value in given), WIDTH - left - 16, SMALL, "bold"
        )
        axes.text(-0.48, top[other] - 0.62, named, va="bottom", size=SMALL, weight="bold", color=INK)
    axes.set(xlim=(-0.5, len(columns) - 0.5), ylim=(lines - 0.5, -0.5), xticks=range(len(columns)))
    axes.set_yticks([top[other] + row for other in others for row in range(len(rows))])
    axes.set_xticklabels([clipped(value, max(room, 24), SMALL) for value in columns], color=INK)
    axes.set_yticklabels([clipped(value, 90, SMALL) for value in rows] * len(others), color=INK)
    axes.set_xlabel(_short(sweep.keys[1]))
    axes.set_ylabel(_short(sweep.keys[0]), loc="top")
    return Chart(name, title, f"{told}; darker is better{_grey(sweep, shown)}", figure)


@house_style()
def _ranking(sweep: Sweep, shown: _Shown, task: str) -> Chart:
    """A row for each of the best combinations of values, the best one first."""
    name, title, told = _described(sweep, shown, task)
    ranked = sorted(sweep.results.items(), key=lambda item: -_level(shown, item[1]))
    best = ranked[:_MOST_LINES]
    figure, axes = chart.panel(title, _CELL * len(best), 16, top=66, right=16, width=_WIDE)
    room = (_WIDE - 32) / (len(sweep.keys) + 1)
    paint_of = _paints(sweep, shown)
    for row, (values, result) in enumerate(best):
        for column, value in enumerate(values):
            axes.text(column, row, clipped(value, room - 8, SMALL), ha="center", va="center", size=SMALL)
        _cell(axes, (len(values), row), paint_of(result), shown.text(result), room)
    axes.set(xlim=(-0.5, len(sweep.keys) + 0.5), ylim=(len(best) - 0.5, -0.5))
    for column, head in enumerate([*map(_short, sweep.keys), shown.title]):
        head = clipped(head, room - 8, SMALL, "bold")
        axes.annotate(head, (column, -0.5), (0, 8), textcoords="offset points", size=SMALL, weight="bold",
                      ha="center")  # fmt: skip
    more = f"; the {len(best)} best of {len(ranked)}" if len(ranked) > len(best) else ""
    return Chart(name, title, f"{told}; the best first{more}{_grey(sweep, shown)}", figure)


def _cell(axes: Axes, at: tuple[int, int], paint: Any, text: str, room: float) -> None:
    """A cell at (column, row) with its number, if that is narrower than `room`."""
    column, row = at
    axes.barh(row, 0.96, left=column - 0.48, height=0.92, color=paint, clip_on=False)
    dark = float(np.dot(to_rgb(paint), (0.299, 0.587, 0.114))) < 0.55
    if text_width(text, SMALL) < room:
        axes.text(column, row, text, ha="center", va="center", color=_ON_DARK if dark else _ON_LIGHT)


def _level(shown: _Shown, result: Result) -> float:
    """How good a result is; -infinity: it has no finite value."""
    point = shown.of(result).point
    return shown.better * point if math.isfinite(point) else -math.inf


def _paints(sweep: Sweep, shown: _Shown) -> Callable[[Result], Any]:
    """The colour of each result."""
    finite = [level for each in sweep.results.values() if math.isfinite(level := _level(shown, each))]
    low, high = (0.0, 1.0) if shown.form is style.percent else (min(finite), max(finite))

    def paint(result: Result) -> Any:
        level = _level(shown, result)
        return _RAMP((level - low) / (high - low or 1.0)) if math.isfinite(level) else _NEVER

    return paint


def _grey(sweep: Sweep, shown: _Shown) -> str:
    without = any(math.isinf(_level(shown, each)) for each in sweep.results.values())
    return "; grey cells have no finite value" if without else ""


def _others(sweep: Sweep) -> list[tuple[str, ...]]:
    """The combinations of values of all keys but the first two, in order."""
    found = {values[2:] for values in sweep.results}
    columns = sweep.values[2:]
    return sorted(found, key=lambda other: list(map(tuple.index, columns, other)))


def _lines(sweep: Sweep) -> int:
    """How many lines heatmaps by the first two keys have together; each of several has one above it."""
    return len(_others(sweep)) * (len(sweep.values[0]) + (len(sweep.keys) > 2))


def _is_grid(sweep: Sweep) -> bool:
    """Whether heatmaps of the sweep are mostly filled, and fit in a figure."""
    cells = len(_others(sweep)) * len(sweep.values[0]) * len(sweep.values[1])
    return len(sweep.keys) == 2 or (2 * len(sweep.results) >= cells and _lines(sweep) <= _MOST_LINES)


def _listed(keys: Sequence[str]) -> str:
    *others, last = map(_short, keys)
    return " and ".join([", ".join(others), last] if others else [last])


def _short(key: str) -> str:
    """`agent.learning_rate` as learning_rate."""
    return key.removeprefix("agent.")
