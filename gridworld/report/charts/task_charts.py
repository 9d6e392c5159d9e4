"""The figures of a task: curves over training, and every seed's result beside the agents' intervals."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.lines import Line2D
from matplotlib.ticker import NullLocator

from gridworld.report.analysis.analyse import Result, TaskAnalysis
from gridworld.report.analysis.curves import Band
from gridworld.report.analysis.metrics import BY_KEY
from gridworld.report.analysis.statistics import INFINITE
from gridworld.report.analysis.sweeps import sweeps
from gridworld.report.charts import chart, style
from gridworld.report.charts.bands import draw_bands
from gridworld.report.charts.chart import WIDTH, Bounds, Chart
from gridworld.report.charts.style import LABEL, SMALL, Styles, house_style, text_width
from gridworld.report.charts.sweep_charts import sweep_charts
from gridworld.report.evidence.grouping import Group
from gridworld.world.mdp import FloatArray

_RIGHT = 18.0  # points, right of curves
_ROW = 34.0  # points, of an agent in a strip chart whose name has one line
_NAME = 170.0  # points, the width of an agent's name there
_BOOTSTRAP = "interquartile mean (IQM) with 95 % bootstrap bands"
_MOST_DRAWN = style.AGENT_PAINTS  # agents in one figure
_REFERENCES = {"optimum": (0, (5.0, 4.0)), "uniformly random": (0, (1.5, 3.0))}  # lines across


def task_charts(analysis: TaskAnalysis, styles: Styles) -> Iterator[Chart]:
    """The figures of a task that its runs have the numbers for; none where every number is 0.

    Curves and strips show as many agents as there are colours, the best ones where there are more.
    """
    for sweep in sweeps(analysis.results):
        yield from sweep_charts(sweep, analysis.task)
    shown = [result for result in analysis.results if result in analysis.ranked[:_MOST_DRAWN]]
    drawn = replace(analysis, results=tuple(shown))
    more = (
        f"; the {_MOST_DRAWN} best of {len(analysis.results)}" if len(analysis.results) > len(shown) else ""
    )
    yield from _curves(drawn, styles, more)
    if all(len(result.group.runs) == 1 for result in analysis.results) and len(analysis.results) == 1:
        return  # a strip would have one dot
    for key in ("regret", "steps", "online_return", "online_return_end"):
        if any(result.samples[key].any() for result in shown):
            yield _draw_strip(drawn, key, styles, more)


def _curves(analysis: TaskAnalysis, styles: Styles, more: str) -> Iterator[Chart]:
    results, world, task = analysis.results, analysis.world, analysis.task
    told = partial(_told, results=results, more=more)
    draw = partial(_draw_curves, styles=styles, log_steps=analysis.log_steps)
    if any(result.regret.point.any() for result in results):
        yield draw(
            f"{task} regret",
            f"Regret on {task}",
            told("regret of the greedy policy, exact", _BOOTSTRAP) + "; 0 is optimal",
            [(result.group, result.regret) for result in results],
            _Vertical("regret", _regret_bounds(results)),
            references={"optimum": 0.0, "uniformly random": world.optimal_value - world.random_value},
        )
    if any(result.certificates.point.any() for result in results):
        yield draw(
            f"{task} certified",
            f"Seeds certified optimal on {task}",
            told(
                "share of seeds whose greedy policy is optimal from the start",
                "bands are Wilson's 95 % intervals",
            ),
            [(result.group, _certificates(result)) for result in results],
            _Vertical("seeds certified", (0.0, 1.0), style.percent),
        )
    online = [(result.group, result.online) for result in results if result.online is not None]
    if any(band.point.any() for _, band in online):
        yield draw(
            f"{task} on-line return",
            f"On-line return on {task}",
            told("mean return of the training episodes, exploration included", _BOOTSTRAP),
            online,
            _Vertical("return", _online_bounds([band for _, band in online])),
            references={"optimum": world.optimal_return},
        )


def _certificates(result: Result) -> Band:
    """The share certified; without Wilson's interval for one seed, which would cover nearly everything."""
    band = result.certificates
    unknown = np.full(len(band.steps), math.nan)
    return band if len(result.group.runs) > 1 else replace(band, low=unknown, high=unknown)


def _told(what: str, statistic: str, results: Sequence[Result], more: str) -> str:
    """What a figure shows, with the statistic and the number of seeds: "5 seeds", "3 to 5 seeds"."""
    counts = sorted({len(result.group.runs) for result in results})
    if counts == [1]:
        return f"{what}; one seed, so no interval{more}"
    return f"{what}: {statistic}, {' to '.join(map(str, dict.fromkeys((counts[0], counts[-1]))))} seeds{more}"


def _names(groups: Sequence[Group]) -> list[str]:
    """What a figure calls agents, with the number of their seeds where that is not all of them."""
    agents = style.without_shared([group.agent for group in groups])
    return [
        f"{agent}, {group.seeds}" if group.seeds else agent
        for agent, group in zip(agents, groups, strict=True)
    ]


def _regret_bounds(results: Sequence[Result]) -> Bounds:
    bands = (result.regret for result in results)
    highest = np.concatenate([band.point if np.isnan(band.high).any() else band.high for band in bands])
    highest = highest[highest < INFINITE]
    return 0.0, float(highest.max(initial=0.0)) * 1.06 or 1.0


def _online_bounds(bands: Sequence[Band]) -> Bounds:
    """From the worst after the first tenth: what is learnt at the very start would flatten all the rest."""
    late = np.concatenate([band.point[len(band.point) // 10 :] for band in bands])
    late = late[np.abs(late) < INFINITE]
    if not len(late):
        return 0.0, 1.0
    low, high = float(late.min()), float(late.max())
    margin = 0.1 * (high - low) or 0.1 * abs(high) or 1.0
    return low - margin, high + margin


@dataclass(frozen=True)
class _Vertical:
    """The vertical axis of curves."""

    label: str
    bounds: Bounds
    form: Callable[[float], str] = style.compact


@house_style()
def _draw_curves(
    name: str,
    title: str,
    description: str,
    bands: Sequence[tuple[Group, Band]],
    vertical: _Vertical,
    styles: Styles,
    log_steps: bool,
    references: Mapping[str, float] = MappingProxyType({}),
) -> Chart:
    """Each agent's curve and band against environment steps, and the references as lines across."""
    bounds, form = vertical.bounds, vertical.form
    low, high = bounds
    left = 28 + max(text_width(form(tick), SMALL) for tick in chart.ticks(low, high))
    seen = {mark: level for mark, level in references.items() if low <= level <= high}
    room = WIDTH - left - _RIGHT
    groups = [group for group, _ in bands]
    names = [*style.wrapped_apart(_names(groups), room - 24, SMALL), *seen]
    lines = [styles[group.agent].line for group in groups]
    looks = [*lines, *({"color": style.INK, "linestyle": _REFERENCES[mark]} for mark in seen)]
    rows = chart.legend_rows(names, room)
    top = 42 + chart.legend_height(names, rows)
    figure, axes = chart.panel(title, 190, left, top=top, right=_RIGHT, bottom=40)
    chart.legend(figure, [Line2D([], [], linewidth=2.2, **look) for look in looks], names, rows)
    chart.ticks_on(axes, "y", bounds, form=form)
    axes.set_ylabel(vertical.label, loc="top")
    first, end = _steps_on(axes, [band for _, band in bands], log_steps)
    draw_bands(axes, [band for _, band in bands], lines, bounds, first)
    line: dict[str, Any] = {"color": style.INK, "linewidth": 1, "zorder": 4, "clip_on": False}
    for mark, level in seen.items():
        axes.plot((first, end), (level, level), linestyle=_REFERENCES[mark], **line)
    return Chart(name, title, description, figure)


def _steps_on(axes: Axes, bands: Sequence[Band], log_steps: bool) -> Bounds:
    """Lay out the axis of the steps; returns its ends. A logarithmic one begins at the first step after 0."""
    end = max(1.0, *(float(band.steps[-1]) for band in bands))
    first = min((float(step) for band in bands for step in band.steps[1:2]), default=end)
    if not log_steps or first <= 0 or first >= end:
        chart.ticks_on(axes, "x", (0, end), grid=False)
        axes.set_xlabel("environment steps")
        return 0.0, end
    axes.set_xscale("log")
    axes.xaxis.set_minor_locator(NullLocator())
    chart.ticks_on(axes, "x", (first, end), chart.log_ticks(first, end), grid=False)
    axes.set_xlabel("environment steps, logarithmic")
    return first, end


@house_style()
def _draw_strip(analysis: TaskAnalysis, key: str, styles: Styles, more: str) -> Chart:
    """A row for each agent: the estimate with its interval, and below it a dot for every seed."""
    metric = BY_KEY[key]
    results = [result for result in analysis.results if len(result.samples[key])]
    samples = np.concatenate([result.samples[key] for result in results])
    never = not np.isfinite(samples).all()
    names = style.wrapped_apart(_names([result.group for result in results]), _NAME, LABEL)
    left = 22 + max(text_width(name, LABEL) for name in names)
    each = max(_ROW, 12 + style.LINE * max(map(style.line_count, names)))
    right = 62 if never else 20
    title = f"{metric.title} on {analysis.task}"
    heading = title[0].upper() + title[1:]
    figure, axes = chart.panel(heading, each * len(results), left, right=right, bottom=40)
    low, high = bounds = _strip_bounds(samples[np.abs(samples) < INFINITE], key)
    chart.ticks_on(axes, "x", bounds)
    axes.set_xlabel("environment steps" if key == "steps" else "regret" if key == "regret" else "return")
    # A unit of the vertical axis is a point, from the top.
    axes.set(ylim=(each * len(results), 0), yticks=[each * (row + 0.5) for row in range(len(results))])
    axes.set_yticklabels(names, size=LABEL, color=style.INK)
    axes.tick_params(axis="y", pad=10)
    far = high + (high - low) * (right - 26) / (WIDTH - left - right)
    if never:
        axes.plot(
            (far, far), axes.get_ylim(), color=style.GRID, linewidth=1, linestyle=(0, (3, 3)), clip_on=False
        )
        axes.annotate("never", (far, each * len(results)), (0, -15), textcoords="offset points",
                      color=style.MUTED, ha="center", annotation_clip=False)  # fmt: skip

    def place(numbers: FloatArray) -> FloatArray:
        return np.where(np.isfinite(numbers), np.clip(numbers, low, high), far)

    for row, result in enumerate(results):
        _draw_row(axes, each * (row + 0.5), result, key, styles, place)
    kind = "interquartile mean (IQM)" if metric.statistics[0] == "iqm" else "mean"
    return Chart(
        f"{analysis.task} {metric.title}",
        title,
        _told("a dot for every seed", f"above them the {kind} with 95 % bootstrap interval", results, more),
        figure,
    )


def _draw_row(
    axes: Axes, middle: float, result: Result, key: str, styles: Styles,
    place: Callable[[FloatArray], FloatArray],
) -> None:  # fmt: skip
    colour, sample = styles[result.group.agent].line["color"], result.samples[key]
    heights = middle + 7 + 1.1 * (np.arange(len(sample)) % 5 - 2)  # spread, so that equal ones are seen
    finite, pale = np.isfinite(sample), to_rgba(colour, 0.55)
    axes.scatter(
        place(sample),
        heights,
        s=np.where(finite, 27, 20),
        facecolors=[pale if each else "none" for each in finite],
        edgecolors=pale,
        linewidths=np.where(finite, 0.0, 1.4).tolist(),
        clip_on=False,
    )
    told = result.estimates[key, BY_KEY[key].statistics[0]]
    ends, point = place(np.array([told.low, told.high])), place(np.array([told.point]))
    if not math.isnan(told.low):
        axes.plot(ends, (middle - 4, middle - 4), color=colour, linewidth=4, clip_on=False)
    axes.plot(point, [middle - 4], "o", color=colour, markersize=10, clip_on=False)
    axes.plot(point, [middle - 4], "o", color=style.PAPER, markersize=4, clip_on=False)


def _strip_bounds(numbers: FloatArray, key: str) -> Bounds:
    if not len(numbers):
        return 0.0, 1.0
    low, high = float(numbers.min()), float(numbers.max())
    if key in ("regret", "steps"):
        low = 0.0
    margin = 0.04 * (high - low) or 0.05 * abs(high) or 0.1
    return (low if low == 0 else low - margin), high + margin
