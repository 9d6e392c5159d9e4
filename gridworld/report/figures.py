"""The figures of a task: curves over training, and every seed's end beside the agents' intervals."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np

from gridworld.mdp import FloatArray
from gridworld.report.analysis import Result, TaskAnalysis
from gridworld.report.chart import (
    SMALL,
    Axis,
    clipped,
    clipped_apart,
    compact,
    horizontal_grid,
    legend,
    percent,
    steps_like,
    ticks,
    vertical_grid,
)
from gridworld.report.curves import Band
from gridworld.report.metrics import BY_KEY
from gridworld.report.scene import Area, Dot, Line, Scene, Shape, Style, Text, text_width

WIDTH = 440.0
_PLOT_HEIGHT = 190.0
_ROW = 34.0  # pixels an agent has in a figure of intervals
_RIGHT = 18.0
_LEVELS = {"optimum": Style("ink", (5.0, 4.0)), "uniformly random": Style("ink", (1.5, 3.0))}

Styles = Mapping[str, Style]


def task_figures(analysis: TaskAnalysis, styles: Styles) -> Iterator[Scene]:
    """All figures of a task that its runs have the numbers for."""
    results, world, task = analysis.results, analysis.world, analysis.task
    yield _curves(
        f"{task} regret",
        f"Regret on {task}",
        "interquartile mean over seeds of the greedy policy's exact regret against environment steps, "
        "with 95 % bootstrap bands; the optimum is zero",
        [(result.group.agent, result.regret) for result in results],
        styles,
        _regret_axis(results),
        compact,
        {"optimum": 0.0, "uniformly random": world.optimal_value - world.random_value},
    )
    yield _curves(
        f"{task} certified",
        f"Seeds certified optimal on {task}",
        "share of seeds whose greedy policy is optimal against environment steps, with Wilson's 95 % "
        "intervals",
        [(result.group.agent, result.certificates) for result in results],
        styles,
        (0.0, 1.0),
        percent,
        {},
    )
    online = [(result.group.agent, result.online) for result in results if result.online is not None]
    if online:
        yield _curves(
            f"{task} on-line return",
            f"On-line return on {task}",
            "interquartile mean over seeds of the training episodes' mean return, exploration included, "
            "with 95 % bootstrap bands",
            online,
            styles,
            _online_axis([band for _, band in online]),
            compact,
            {"optimum": world.optimal_return},
        )
    for key in ("regret", "steps", "online_return", "online_return_end"):
        if any(len(result.samples[key]) for result in results):
            yield _strip(f"{task} {BY_KEY[key].title}", task, key, results, styles)


def _curves(
    name: str,
    title: str,
    description: str,
    curves: Sequence[tuple[str, Band]],
    styles: Styles,
    bounds: tuple[float, float],
    form: Callable[[float], str],
    levels: Mapping[str, float],
) -> Scene:
    labels = [form(tick) for tick in ticks(*bounds)]
    left = 12 + max(text_width(label, SMALL) for label in labels)
    seen = {mark: level for mark, level in levels.items() if bounds[0] <= level <= bounds[1]}
    entries = [*((agent, styles[agent]) for agent, _ in curves), *((mark, _LEVELS[mark]) for mark in seen)]
    names, height = legend(entries, left, WIDTH - _RIGHT, 42)
    top = 42 + height
    bottom = top + _PLOT_HEIGHT
    x = Axis(0, max(1.0, *(float(band.steps[-1]) for _, band in curves)), left, WIDTH - _RIGHT)
    y = Axis(*bounds, bottom, top)
    shapes: list[Shape] = [_title(title), *names]
    shapes += horizontal_grid(y, left, WIDTH - _RIGHT, form)
    shapes += [
        Text((x(tick), bottom + 16), compact(tick), "muted", SMALL, "middle") for tick in ticks(0, x.high, 5)
    ]
    for agent, band in curves:
        shapes += _area(band, styles[agent], x, y)
    for agent, band in curves:
        shapes += _line(band, styles[agent], x, y)
    for mark, level in seen.items():
        shapes.append(Line([(x.start, y(level)), (x.end, y(level))], "ink", 1.0, _LEVELS[mark].dash))
    shapes.append(Text((WIDTH - _RIGHT, bottom + 32), "environment steps", "muted", SMALL, "end"))
    return Scene(name, title, description, WIDTH, bottom + 40, shapes)


def _area(band: Band, style: Style, x: Axis, y: Axis) -> Iterator[Shape]:
    if np.isnan(band.low).any():
        return  # one seed has no interval
    high = steps_like(band.steps.tolist(), band.high.tolist(), x, y)
    low = steps_like(band.steps.tolist(), band.low.tolist(), x, y)
    yield Area([*high, *reversed(low)], style.paint)


def _line(band: Band, style: Style, x: Axis, y: Axis) -> Iterator[Shape]:
    """Bold as far as all runs go; from where the first has ended, thin."""
    whole = band.steps <= band.whole_until
    points = steps_like(band.steps[whole].tolist(), band.point[whole].tolist(), x, y)
    if len(points) > 1:
        yield Line(points, style.paint, 2.2, style.dash)
    else:
        yield Dot(points[0], 3.5, style.paint)
    if not whole.all():
        rest = ~whole
        rest[max(0, int(whole.sum()) - 1)] = True
        yield Line(
            steps_like(band.steps[rest].tolist(), band.point[rest].tolist(), x, y),
            style.paint,
            1.0,
            (2.0, 3.0),
        )


def _strip(name: str, task: str, key: str, results: Sequence[Result], styles: Styles) -> Scene:
    """A row for each agent: a dot for every seed, and above them the estimate with its interval."""
    metric = BY_KEY[key]
    statistic = metric.statistics[0]
    results = [result for result in results if len(result.samples[key])]
    finite = np.concatenate([s[np.isfinite(s)] for s in (result.samples[key] for result in results)])
    never = any(not np.isfinite(result.samples[key]).all() for result in results)
    labels = clipped_apart([result.group.agent for result in results], 130, WIDTH / 2, 12)
    left = 16 + max(text_width(label, 12) for label in labels)
    right = WIDTH - (62 if never else 20)
    x = Axis(*_bounds(finite, key), left, right)
    top = 36.0
    bottom = top + _ROW * len(results)
    shapes: list[Shape] = [_title(f"{metric.title[0].upper()}{metric.title[1:]} on {task}")]
    shapes += vertical_grid(x, top, bottom)
    far = WIDTH - 26
    if never:
        shapes.append(Line([(far, top), (far, bottom)], "grid", 1, (3.0, 3.0)))
        shapes.append(Text((far, bottom + 15), "never", "muted", SMALL, "middle"))

    def place(number: float) -> float:
        return x(number) if math.isfinite(number) else far

    for index, (result, label) in enumerate(zip(results, labels, strict=True)):
        middle = top + _ROW * (index + 0.5)
        style = styles[result.group.agent]
        shapes.append(Text((left - 10, middle + 4), label, "ink", 12, "end"))
        shapes += _seeds(result.samples[key], middle + 7, style, place)
        told = result.estimates[key, statistic]
        if not math.isnan(told.low):
            shapes.append(
                Line([(place(told.low), middle - 4), (place(told.high), middle - 4)], style.paint, 4)
            )
        shapes.append(Dot((place(told.point), middle - 4), 5, style.paint))
        shapes.append(Dot((place(told.point), middle - 4), 2, "paper"))
    kind = "interquartile mean" if statistic == "iqm" else "mean"
    return Scene(
        name,
        f"{metric.title} on {task}",
        f"a row for each agent: {kind} with 95 % bootstrap interval, and below it a dot for every seed",
        WIDTH,
        bottom + 24,
        shapes,
    )


def _seeds(sample: FloatArray, y: float, style: Style, place: Callable[[float], float]) -> Iterator[Shape]:
    """Dots, spread a little so that equal ones are seen to be several."""
    for index, number in enumerate(sample.tolist()):
        offset = (index % 5 - 2) * 1.1
        yield Dot((place(number), y + offset), 2.6, style.paint, 0.55, ring=math.isinf(number))


def _bounds(numbers: FloatArray, key: str) -> tuple[float, float]:
    if not len(numbers):
        return 0.0, 1.0
    low, high = float(numbers.min()), float(numbers.max())
    if key in ("regret", "steps"):
        low = 0.0
    margin = 0.04 * (high - low) or 0.05 * abs(high) or 0.1
    return (low if low == 0 else low - margin), high + margin


def _regret_axis(results: Sequence[Result]) -> tuple[float, float]:
    highest = [
        band.high if not np.isnan(band.high).any() else band.point for band in (r.regret for r in results)
    ]
    finite = np.concatenate(highest)
    finite = finite[np.isfinite(finite)]
    return 0.0, float(finite.max(initial=0.0)) * 1.06 or 1.0


def _online_axis(bands: Sequence[Band]) -> tuple[float, float]:
    """From the worst after the first tenth: what is learnt at the very start would flatten all the rest."""
    late = np.concatenate([band.point[len(band.point) // 10 :] for band in bands])
    late = late[np.isfinite(late)]
    if not len(late):
        return 0.0, 1.0
    low, high = float(late.min()), float(late.max())
    margin = 0.1 * (high - low) or 0.1 * abs(high) or 1.0
    return low - margin, high + margin


def _title(text: str) -> Text:
    return Text((12, 20), clipped(text, WIDTH - 24, 14), "ink", 14, bold=True)
