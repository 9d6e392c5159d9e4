"""The figures of agents: their curves and every seed's result on a task, and how they do over all tasks."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from gridworld.base.errors import InputError
from gridworld.report import chart
from gridworld.report.analysis import METRICS, Band, Overall, Result, TaskAnalysis
from gridworld.report.chart import INK, PAPER, Chart, Styles, house_style
from gridworld.report.setting_charts import sweep_charts, sweeps
from gridworld.report.statistics import INFINITE, Interval
from gridworld.world import metrics
from gridworld.world.evaluation import Evaluator
from gridworld.world.mdp import FloatArray

_NAME = 25  # characters, the width of a name at a row
_BOOTSTRAP = "interquartile mean (IQM) with 95 % bootstrap bands"
_MOST_DRAWN = len(chart.COLOURS)  # agents in one figure
_MOST_PAIRS = 21  # those of seven agents
_REFERENCES = {"optimum": (0, (5.0, 4.0)), "uniformly random": (0, (1.5, 3.0))}  # lines across

Bounds = tuple[float, float]  # of an axis, the lower one first


def task_charts(analysis: TaskAnalysis, styles: Styles) -> Iterator[Chart]:
    """The figures of a task that its runs have the numbers for, of the best agents where there are many."""
    for sweep in sweeps(analysis.results):
        yield from sweep_charts(sweep, analysis.task)
    shown = [result for result in analysis.results if result in analysis.ranked[:_MOST_DRAWN]]
    drawn, count = replace(analysis, results=tuple(shown)), len(analysis.results)
    more = f"; the best {_MOST_DRAWN} of {count}" if count > len(shown) else ""
    yield from _curves(drawn, styles, more)
    if count == 1 and len(shown[0].group.runs) == 1:
        return  # a strip would have one dot
    for key in ("regret", "steps", "online_return", "online_return_end"):
        if any(result.samples[key].any() for result in shown):
            yield _strip(drawn, key, styles, more)


def _curves(analysis: TaskAnalysis, styles: Styles, more: str) -> Iterator[Chart]:
    results, world, task = analysis.results, analysis.world, analysis.task
    describe = partial(_description, results=results, more=more)
    draw = partial(_draw_curves, styles=styles, log_steps=analysis.log_steps)
    bands = {result.group.agent: result.regret for result in results}
    if any(band.point.any() for band in bands.values()):
        highest = [band.point if np.isnan(band.high).any() else band.high for band in bands.values()]
        yield draw(
            f"{task} regret",
            f"Regret on {task}",
            describe("regret of the greedy policy, exact", _BOOTSTRAP) + "; 0 is optimal",
            bands,
            label="regret",
            bounds=_bounds(np.concatenate(highest), from_zero=True),
            references={"optimum": 0.0, "uniformly random": world.optimal_value - world.random_value},
        )
    bands = {result.group.agent: result.certificates for result in results}
    if any(band.point.any() for band in bands.values()):
        yield draw(
            f"{task} certified",
            f"Seeds certified optimal on {task}",
            describe(
                "share of seeds whose greedy policy is optimal from the start state",
                "bands are Wilson's 95 % intervals",
            ),
            bands,
            label="seeds certified",
            bounds=(0.0, 1.0),
            form=chart.percent,
        )
    bands = {result.group.agent: result.online for result in results if result.online is not None}
    if any(band.point.any() for band in bands.values()):
        # The first tenth, where most is learned, would flatten all the rest.
        late = np.concatenate([band.point[len(band.point) // 10 :] for band in bands.values()])
        yield draw(
            f"{task} online_return",
            f"Online return on {task}",
            describe("mean return of the training episodes, exploration included", _BOOTSTRAP),
            bands,
            label="return",
            bounds=_bounds(late),
            references={"optimum": world.optimal_return},
        )


def run_chart(
    key: str, curve: Mapping[str, FloatArray], evaluator: Evaluator, summary: Mapping[str, Any]
) -> Chart:
    """The exact curves of one run's two policies in a metric. Raises `InputError` where there is none."""
    metric = next((each for each in metrics.METRICS if each.name == key), None)
    if metric is None:
        known = ", ".join(each.name for each in metrics.METRICS)
        raise InputError(f"metric={key!r:.80}: no such curve; choose from {known}")
    steps, bands = curve["step"], dict[str, Band]()
    for name, column in (("greedy", key), ("with exploration", f"sampled_{key}")):
        unknown = np.full(len(steps), math.nan)
        bands[name] = Band(steps, curve[column], unknown, unknown, int(steps[-1]))
    mdp = evaluator.mdp
    random = evaluator.score(np.full((mdp.num_states, mdp.num_actions), 1 / mdp.num_actions))
    optimum = metric.of(metrics.optimal_score(evaluator))
    title = f"{metric.label[0].upper()}{metric.label[1:]} of {summary['agent']} on {summary['env']}"
    return _draw_curves(
        title,
        title,
        f"{metric.label}, exact, of the greedy policy and of the one that it explores with",
        bands,
        chart.styles(list(bands)),
        metric.label,
        _bounds(np.concatenate([*(band.point for band in bands.values()), [optimum]])),
        references={"optimum": optimum, "uniformly random": metric.of(random)},
    )


def _description(what: str, statistic: str, results: Sequence[Result], more: str) -> str:
    """What a figure shows, with the statistic and the number of seeds."""
    counts = [len(result.group.runs) for result in results]
    if set(counts) == {1}:
        return f"{what}; one seed, so no interval{more}"
    return f"{what}: {statistic}, {chart.seed_counts(counts)}{more}"


def _bounds(numbers: FloatArray, from_zero: bool = False) -> Bounds:
    """Of an axis that has room for all finite numbers."""
    numbers = numbers[np.abs(numbers) < INFINITE]
    if not len(numbers):
        return 0.0, 1.0
    low, high = 0.0 if from_zero else float(numbers.min()), float(numbers.max())
    margin = 0.06 * (high - low) or 0.1 * abs(high) or 0.1
    return (low if from_zero else low - margin), high + margin


@house_style()
def _draw_curves(
    name: str,
    title: str,
    description: str,
    bands: Mapping[str, Band],
    styles: Styles,
    label: str,
    bounds: Bounds,
    form: Callable[..., str] = chart.compact,
    log_steps: bool = False,
    levels: Bounds | None = None,
    references: Mapping[str, float] | None = None,
) -> Chart:
    """Each agent's curve with its band: bold as far as all runs go, and dotted from where the first ended."""
    seen = {mark: at for mark, at in (references or {}).items() if bounds[0] <= at <= bounds[1]}
    looks = [styles[agent] for agent in bands]
    looks += [{"color": INK, "linestyle": _REFERENCES[mark]} for mark in seen]
    handles = [Line2D([], [], linewidth=2.2, **look) for look in looks]
    legend = list(zip(handles, [*chart.short_names(list(bands), 56), *seen], strict=True))
    figure, axes = chart.new_figure(title, chart.HEIGHT, "y", legend)
    axes.set(ylim=bounds, ylabel=label)
    axes.yaxis.set_major_formatter(form)
    first = -math.inf
    if levels is not None:
        axes.set(xlim=levels, xlabel="optimality: 0 is random, 1 is optimal")
    else:
        end = max(1.0, *(float(band.steps[-1]) for band in bands.values()))
        first = min((float(step) for band in bands.values() for step in band.steps[1:2]), default=end)
        if log_steps and 0 < first < end:  # it begins at the first after 0
            chart.log_axis(axes, "x", first, end)
            axes.set(xlabel="environment steps, logarithmic")
        else:
            axes.set(xlim=(0, end), xlabel="environment steps")
            first = 0.0
    for later, band, look in zip(range(len(bands))[::-1], bands.values(), looks, strict=False):
        steps = np.maximum(band.steps, first)
        values, low, high = (np.clip(numbers, *bounds) for numbers in (band.point, band.low, band.high))
        if not np.isnan(low).any():  # one seed has no interval
            axes.fill_between(steps, low, high, step="post", color=look["color"], alpha=0.18, linewidth=0)
        line: dict[str, Any] = {"where": "post", "clip_on": False, "zorder": 3, **look}
        whole = int((band.steps <= band.whole_until).sum())
        # What is drawn first is wider, so that equal curves are all seen.
        bold = {"linewidth": 2.2 + 0.6 * later, "markersize": 7, "marker": "o" if whole == 1 else ""}
        axes.step(steps[:whole], values[:whole], **line | bold)
        if whole < len(values):
            rest, dotted = slice(max(0, whole - 1), None), {"linewidth": 1, "linestyle": (0, (2.0, 3.0))}
            axes.step(steps[rest], values[rest], **line | dotted)
    for level, look in zip(seen.values(), looks[len(bands) :], strict=True):
        axes.axhline(level, linewidth=1, zorder=4, clip_on=False, **look)
    return Chart(name, title, description, figure)


@house_style()
def _strip(analysis: TaskAnalysis, key: str, styles: Styles, more: str) -> Chart:
    """A row for each agent: the estimate with its interval, and below it a dot for every seed."""
    metric = METRICS[key]
    results = [result for result in analysis.results if len(result.samples[key])]
    samples = np.concatenate([result.samples[key] for result in results])
    names = chart.short_names([result.group.agent for result in results], _NAME)
    title = f"{metric.title} on {analysis.task}"
    figure, axes, each = chart.figure_of_rows(title[0].upper() + title[1:], names, 34.0)
    low, high = end = _bounds(samples, key in ("regret", "steps"))
    far = high + 0.1 * (high - low)
    if not np.isfinite(samples).all():  # it has a place of its own at the end
        end = low, far
        marks = [mark for mark in MaxNLocator(4, steps=[1, 2, 5, 10]).tick_values(low, high) if mark <= high]
        axes.set_xticks([*marks, far], [*map(chart.compact, marks), "never"])
    axes.set(xlim=end, xlabel=key if key == "regret" else "environment steps" if key == "steps" else "return")

    def place(numbers: FloatArray) -> FloatArray:
        return np.where(np.isfinite(numbers), np.clip(numbers, low, high), far)

    for row, result in enumerate(results):
        colour, sample = styles[result.group.agent]["color"], result.samples[key]
        finite, pale = np.isfinite(sample), to_rgba(colour, 0.55)
        heights = row + (7 + 1.1 * (np.arange(len(sample)) % 5 - 2)) / each  # spread: equal ones are seen
        axes.scatter(
            place(sample),
            heights,
            s=np.where(finite, 27, 20),
            facecolors=[pale if is_finite else "none" for is_finite in finite],
            edgecolors=pale,
            linewidths=np.where(finite, 0.0, 1.4).tolist(),
            clip_on=False,
        )
        _draw_interval(axes, row - 4 / each, result.estimates[key, metric.statistics[0]], colour, place)
    kind = "interquartile mean (IQM)" if metric.statistics[0] == "iqm" else "mean"
    statistic = f"above them the {kind} with 95 % bootstrap interval"
    description = _description("a dot for every seed", statistic, results, more)
    return Chart(f"{analysis.task} {metric.title}", title, description, figure)


def _draw_interval(
    axes: Axes,
    row: float,
    interval: Interval,
    colour: str,
    place: Callable[[FloatArray], FloatArray] = np.asarray,
) -> None:
    """A bar from end to end and a ring at the point."""
    low, point, high = place(np.array([interval.low, interval.point, interval.high]))
    if not math.isnan(interval.low):
        axes.plot((low, high), (row, row), color=colour, linewidth=4, clip_on=False)
    ring: dict[str, Any] = {"markeredgecolor": colour, "markeredgewidth": 3.0, "markersize": 7.0}
    axes.plot([point], [row], "o", color=PAPER, clip_on=False, **ring)


def overall_charts(overall: Overall, styles: Styles) -> Iterator[Chart]:
    """As rliable has them: a profile for each agent, and for each metric the pairs, unless all are even."""
    ranked = sorted(overall.profiles, key=lambda agent: -overall.optimality[agent][1].point)
    shown = ranked[:_MOST_DRAWN]
    most = f"; the best {len(shown)} of {len(ranked)}" if len(ranked) > len(shown) else ""
    levels, end = overall.levels, math.ceil(overall.levels[-1])
    profiles = {agent: overall.profiles[agent] for agent in shown}
    yield _draw_curves(
        "all tasks profiles",
        "Performance profiles over all tasks",
        f"share of runs whose optimality is above each level, averaged over tasks{most}; pointwise 95 % "
        "stratified bootstrap intervals",
        {agent: Band(levels, point, low, high, end) for agent, (point, low, high) in profiles.items()},
        styles,
        "runs above it",
        (0.0, 1.0),
        chart.percent,
        levels=(float(levels[0]), 1.0),
    )
    for key in dict.fromkeys(key for key, _, _ in overall.comparisons):
        pairs = {
            (one, other): found
            for (metric, one, other), found in overall.comparisons.items()
            if metric == key and one < other
        }
        if len(pairs) <= _MOST_PAIRS and any(found.point != 0.5 for found in pairs.values()):
            yield _improvements(METRICS[key].title, pairs, styles)


@house_style()
def _improvements(metric: str, pairs: Mapping[tuple[str, str], Interval], styles: Styles) -> Chart:
    agents = sorted({agent for pair in pairs for agent in pair})
    short = dict(zip(agents, chart.short_names(agents, _NAME), strict=True))
    between = " >\n" if 2 * max(map(len, short.values())) + 3 > _NAME else " > "
    rows = [f"{short[one]}{between}{short[other]}" for one, other in pairs]
    title = f"Improvement in {metric}"
    figure, axes, _ = chart.figure_of_rows(title, rows, 26.0)
    axes.set(xlim=(0.0, 1.0), xlabel="probability that the first is better")
    axes.axvline(0.5, color=INK, linewidth=1, linestyle=(0, (3, 3)), clip_on=False)
    for row, ((one, _), found) in enumerate(pairs.items()):
        _draw_interval(axes, row, found, styles[one]["color"])
    description = (
        "probability that a run of the first agent is better than one of the second, ties half: the mean "
        "over the tasks that both ran on, with 95 % stratified bootstrap intervals; at the dashed line "
        "neither is better"
    )
    return Chart(f"all tasks improvement in {metric}", title, description, figure)
