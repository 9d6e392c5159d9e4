"""The figures of settings: those of a sweep, a line for one key and a heatmap for two, and those of a search.

Of a tuning study there are the three figures that Optuna draws: history, importances, parallel coordinates.
"""

from __future__ import annotations

import itertools
import math
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.lines import Line2D

from gridworld.report import chart
from gridworld.report.analysis import Result, TaskAnalysis
from gridworld.report.chart import COLOURS, INK, PAPER, SMALL, WIDE, Chart, clipped, house_style
from gridworld.report.grouping import differing, learning_key
from gridworld.report.statistics import Interval, Share
from gridworld.report.tables import estimate
from gridworld.report.tuning_study import TrialRow, TuningStudy
from gridworld.world.mdp import FloatArray

_LEAST = 3  # configurations that make a sweep, and more of them than settings that differ
_LINE = 64  # characters of tick labels next to each other
_NEVER = "#c6c6c6"  # of cells without a finite value: no colour of the ramp
_RAMP = LinearSegmentedColormap.from_list("share", ["#eaf2f8", "#7fb8dc", "#0a5a8c"])
_MOST_NAMED = 6  # settings in a sentence
_HIGHEST = 1e200  # score that is drawn as it is; its inverse is the lowest
_DONE, _WINNER = COLOURS[0], COLOURS[1]

_Marks = list[tuple[str, float]]  # texts at an axis, and where, from 0 to 1


@dataclass(frozen=True, eq=False)
class Sweep:
    """The results of one agent on one task by the values of what was swept, the smallest first."""

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


_SHOWN = {  # title of a metric, and the statistic that the figures of a sweep show
    "certified": ("seeds certified", "share of seeds certified at the end"),
    "steps": (
        "steps until certified",
        "steps until certified for good, median over seeds; none where fewer than half are",
    ),
    "regret": ("final regret", "interquartile mean (IQM) over seeds"),
}


def _of(result: Result, metric: str) -> tuple[Interval, str]:
    """What is shown of a result, and its text in a heatmap's cell."""
    if metric == "certified":
        share = result.certified
        return Interval(share.count / share.total, share.low, share.high), f"{share.count}/{share.total}"
    found = estimate(result, metric, "median" if metric == "steps" else "iqm")
    assert found is not None  # every run has them
    return found.interval, found.form(found.interval.point)


def sweep_answer(task: TaskAnalysis) -> str:
    """Where all seeds are certified and where none, if the task's results are one sweep; else ""."""
    found = sweeps(task.results)
    if len(found) != 1 or len(found[0].results) < len(task.results):
        return ""
    (sweep,) = found
    keys = [_short(key) for key in sweep.keys]

    def settings(certified: Callable[[Share], bool]) -> str:
        places = [place for place in itertools.product(*sweep.values) if place in sweep.results]
        chosen = [place for place in places if certified(sweep.results[place].certified)]
        names = [" ".join(map("=".join, zip(keys, place, strict=True))) for place in chosen]
        names = [name.removeprefix(f"{keys[0]}=") for name in names] if len(keys) == 1 else names
        more = [f"{len(names) - _MOST_NAMED} more"] if len(names) > _MOST_NAMED else []
        return ", ".join(names[:_MOST_NAMED] + more) or "no setting"

    every, none = settings(lambda share: share.is_whole), settings(lambda share: share.count == 0)
    by = f"{sweep.agent} by {' and '.join(keys)}: all seeds are certified with {every}"
    return by if none == "no setting" else f"{by}; none with {none}"


def sweep_charts(sweep: Sweep, task: str) -> Iterator[Chart]:
    """A figure for each metric that is finite somewhere and not 0 everywhere; none of three keys or more."""
    if len(sweep.keys) > 2:
        return
    keys = " and ".join(map(_short, sweep.keys))
    seeds = chart.seed_counts([len(result.group.runs) for result in sweep.results.values()])
    draw = _line if len(sweep.keys) == 1 else _heatmap
    for metric, (title, statistic) in _SHOWN.items():
        points = np.array([_of(result, metric)[0].point for result in sweep.results.values()])
        if np.isfinite(points).any() and points.any():
            heading = f"{title[0].upper()}{title[1:]} by {keys}"
            description = f"{statistic}; {sweep.agent} on {task}, {seeds} each"
            yield draw(sweep, metric, f"{task} {sweep.agent} {metric} by {keys}", heading, description)


@house_style()
def _line(sweep: Sweep, metric: str, name: str, title: str, description: str) -> Chart:
    (values,) = sweep.values
    found = [_of(sweep.results[(value,)], metric)[0] for value in values]
    ends = np.array([(each.point, each.low, each.high) for each in found])
    is_share = metric == "certified"
    top = 1.0 if is_share else 1.06 * float(ends[np.isfinite(ends)].max()) or 1.0
    points, low, high = np.where(np.isfinite(ends[:, :1]), np.minimum(ends, top), np.nan).T
    figure, axes = chart.new_figure(title, chart.HEIGHT, "y")
    axes.yaxis.set_major_formatter(chart.percent if is_share else chart.compact)
    axes.set(ylim=(0.0, top), ylabel=_SHOWN[metric][0], xlabel=_short(sweep.keys[0]))
    axes.set(xlim=(-0.4, len(values) - 0.6), xticks=range(len(values)))
    axes.set_xticklabels([clipped(value, max(4, _LINE // len(values))) for value in values])
    axes.plot(points, "o-", color=_DONE, linewidth=2.2, markersize=7, clip_on=False)
    axes.vlines(range(len(values)), low, high, color=_DONE, linewidth=4, alpha=0.35, clip_on=False)
    for at in np.flatnonzero(~np.isfinite(ends[:, 0])):
        axes.annotate("never", (at, top), (0, -10), textcoords="offset points", ha="center")
    kind = "Wilson's" if is_share else "bootstrap"
    return Chart(name, title, f"{description}, with {kind} 95 % intervals", figure)


@house_style()
def _heatmap(sweep: Sweep, metric: str, name: str, title: str, description: str) -> Chart:
    rows, columns = sweep.values
    is_share = metric == "certified"  # of which more is better
    levels = np.full((len(rows), len(columns)), np.nan)
    texts = {}
    for (row, column), result in sweep.results.items():
        at, (interval, text) = (rows.index(row), columns.index(column)), _of(result, metric)
        level = interval.point if is_share else -interval.point
        levels[at], texts[at] = (level if math.isfinite(level) else -math.inf), text
    finite = levels[np.isfinite(levels)]
    low, high = (0.0, 1.0) if is_share else (float(finite.min()), float(finite.max()))
    high = high if high > low else low + 1
    figure, axes = chart.new_figure(title, 34 * len(rows))
    colours, levels = _RAMP.with_extremes(bad=(0, 0, 0, 0), under=_NEVER), np.maximum(levels, low - 1)
    mesh = axes.pcolormesh(levels, cmap=colours, vmin=low, vmax=high, edgecolors=PAPER, linewidth=2)
    for at, text in texts.items():
        red, green, blue, _ = mesh.to_rgba(levels[at])
        if len(text) * len(columns) < _LINE:
            colour = PAPER if 0.299 * red + 0.587 * green + 0.114 * blue < 0.55 else "black"
            axes.text(at[1] + 0.5, at[0] + 0.5, text, ha="center", va="center", color=colour)
    axes.set(ylim=(len(rows), 0), xlabel=_short(sweep.keys[1]), ylabel=_short(sweep.keys[0]))
    shown_columns = [clipped(value, max(4, _LINE // len(columns))) for value in columns]
    axes.set_xticks(np.arange(len(columns)) + 0.5, shown_columns, size=SMALL)
    axes.set_yticks(np.arange(len(rows)) + 0.5, [clipped(value, 14) for value in rows], size=SMALL)
    grey = "; grey: no finite value" if (levels < low).any() else ""
    return Chart(name, title, f"{description}; darker is better{grey}", figure)


def tuning_charts(tuning: TuningStudy) -> Iterator[Chart]:
    """Those that there is something to draw for."""
    if tuning.scored:
        yield _history(tuning)
    if tuning.importances:
        yield _importances(tuning)
    done = [trial for trial in tuning.scored if trial.status == "done"]
    if len(done) > 1:
        yield _parallel(tuning, done)


def _scores(trials: Sequence[TrialRow]) -> tuple[FloatArray, float, float]:
    """Scores for a logarithmic axis, and its ends: what is not positive lies at the lower end."""
    scores = np.array([min(trial.score, _HIGHEST) for trial in trials])
    positive = scores[scores > 0] if (scores > 0).any() else np.ones(1)
    low = max(float(positive.min()), 1 / _HIGHEST) / 1.1
    return np.maximum(scores, low), low, max(float(positive.max()) * 1.1, 2 * low)


@house_style()
def _history(tuning: TuningStudy) -> Chart:
    trials = sorted(tuning.scored, key=lambda trial: trial.number)
    numbers = np.array([trial.number for trial in trials], float)
    scores, low, high = _scores(trials)
    done = np.array([trial.status == "done" for trial in trials])
    dots: dict[str, Any] = {"linestyle": "", "marker": "o", "markersize": 6, "clip_on": False}
    looks = {
        "done": {"color": _DONE, "alpha": 0.75, **dots},
        "pruned, score at that time": {"color": INK, "alpha": 0.45, **dots},
        "best so far": {"color": _WINNER, "linewidth": 2.2, "clip_on": False},
    }
    legend = [(Line2D([], [], **look), name) for name, look in looks.items()]
    figure, axes = chart.new_figure("Score by trial", chart.HEIGHT, "y", legend)
    chart.log_axis(axes, "y", low, high)
    axes.set(ylabel="score, logarithmic", xlim=(0, max(1.0, numbers.max())), xlabel="trial")
    for chosen, look in zip((done, ~done), looks.values(), strict=False):
        axes.plot(numbers[chosen], scores[chosen], **look)
    lowest = np.minimum.accumulate(np.where(done, scores, np.inf))
    axes.step(numbers, np.where(np.isfinite(lowest), lowest, np.nan), where="post", **looks["best so far"])
    return Chart(
        f"{tuning.name} history",
        f"Score by trial, {tuning.title.lower()}",
        "one dot per trial, and a line for the best so far; logarithmic scale, lower is better",
        figure,
    )


@house_style()
def _importances(tuning: TuningStudy) -> Chart:
    ranked = sorted(tuning.importances.items(), key=lambda item: -item[1])
    shares = np.nan_to_num([share for _, share in ranked]).clip(0, 1)
    names = [clipped(_short(key), 25) for key, _ in ranked]
    figure, axes, _ = chart.figure_of_rows("Importance of each key", names, 26.0, None)
    axes.set(xlim=(0, max(0.01, shares.max())), xticks=[], xlabel="share of the score's variance")
    bars = axes.barh(range(len(ranked)), shares, height=0.46, color=_DONE, clip_on=False)
    axes.bar_label(bars, [f"{share:.2f}" for _, share in ranked], padding=6, size=SMALL)
    return Chart(
        f"{tuning.name} importances",
        f"Importance of each key, {tuning.title.lower()}",
        "by Optuna's PED-ANOVA over the finished trials; the shares sum to one",
        figure,
    )


@house_style()
def _parallel(tuning: TuningStudy, done: Sequence[TrialRow]) -> Chart:
    ranked = sorted(done, key=lambda trial: trial.score)
    bold, keys = max(1, round(0.1 * len(ranked))), list(tuning.space)
    scores, low, high = _scores(ranked)
    columns = [_axis({"type": "float", "low": low, "high": high, "log": True}, scores.tolist())]
    columns += [_axis(tuning.space[key], [trial.row[key] for trial in ranked]) for key in keys]
    title = "Settings of the best tenth of the finished trials, and of the winner"
    figure, axes = chart.new_figure(title, 250, width=WIDE)
    axes.set(xlim=(0, max(1, len(keys))), ylim=(0, 1), xticks=[], yticks=[])
    lines = [list(enumerate(heights)) for heights in zip(*(each for each, _ in columns), strict=True)]
    winner = [line for trial, line in zip(ranked, lines, strict=True) if trial.number == tuning.winner]
    looks = ((lines[bold:], INK, 0.5), (lines[:bold], _DONE, 1.6), (winner, _WINNER, 2.6))
    for chosen, colour, width in looks:
        axes.add_collection(LineCollection(chosen, colors=colour, linewidths=width, clip_on=False))
    for index, (name, (_, texts)) in enumerate(zip(["score", *map(_short, keys)], columns, strict=True)):
        axes.axvline(index, color=INK, linewidth=1, clip_on=False)
        side = "left" if index == 0 else "right" if index == len(keys) else "center"
        place: dict[str, Any] = {"textcoords": "offset points"}
        below = 0, -18 if index % 2 == 0 else -34  # in two rows, for long names
        axes.annotate(clipped(name, 34), (index, 0), below, weight="bold", ha=side, **place)
        for text, height in texts:
            axes.annotate(text, (index, height), (5, -4), size=10, **place)
    return Chart(
        f"{tuning.name} parallel coordinates",
        f"Parallel coordinates, {tuning.title.lower()}",
        f"one line per finished trial through its score and settings; the best {bold} are highlighted, the "
        "winner most",
        figure,
    )


def _axis(dimension: Mapping[str, Any], values: Sequence[str | float]) -> tuple[FloatArray, _Marks]:
    """Where values lie on their axis, from 0 to 1, and its choices or ends."""
    if dimension["type"] == "categorical":
        choices = dimension["choices"]
        places = {choice: index / max(1, len(choices) - 1) for index, choice in enumerate(choices)}
        marks = [(clipped(choice, 12), height) for choice, height in places.items()]
        return np.array([places.get(str(value), 0.0) for value in values]), marks
    low, high = dimension["low"], dimension["high"]
    numbers, ends = np.array([float(value or low) for value in values]), np.array([low, high])
    bend = np.log if dimension["log"] else np.asarray
    heights = np.interp(bend(numbers), bend(ends), (0.0, 1.0))
    return heights, [(f"{low:.3g}", 0.0), (f"{high:.3g}", 1.0)]


def _short(key: str) -> str:
    """`agent.learning_rate` as learning_rate."""
    return key.removeprefix("agent.")
