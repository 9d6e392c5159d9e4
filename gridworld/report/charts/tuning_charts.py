"""Figures of a tuning study, the three that Optuna draws: history, importances, parallel coordinates.

Optuna's own need a script of four megabytes in the page; these look like the report's others, and need none.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullLocator

from gridworld.report.charts import chart
from gridworld.report.charts.chart import INK, LIGHT, MUTED, SMALL, WIDE, Chart, clipped, house_style
from gridworld.report.evidence.tuning_study import TrialRow, TuningStudy
from gridworld.world.mdp import FloatArray

_Marks = list[tuple[str, float]]  # at an axis: what stands there, and where, from 0 to 1

_HIGHEST = 1e200  # score that is drawn as it is; its inverse is the lowest
_BEST = 0.1  # of the trials stand out in parallel coordinates
_DONE, _PRUNED, _WINNER = LIGHT["c0"], MUTED, LIGHT["c1"]


def tuning_charts(tuning: TuningStudy) -> Iterator[Chart]:
    """Those that there is something to draw for."""
    if tuning.scored:
        yield _history(tuning)
    if tuning.importances:
        yield _importances(tuning)
    done = [trial for trial in tuning.scored if trial.status == "done"]
    if len(done) > 1:
        yield _parallel(tuning, done)


def _scale(trials: Sequence[TrialRow]) -> tuple[FloatArray, float, float, list[float]]:
    """Scores for a logarithmic axis, its ends, and its marks: what is not positive lies at the lower end."""
    scores = np.array([min(trial.score, _HIGHEST) for trial in trials])
    positive = scores[scores > 0] if (scores > 0).any() else np.ones(1)
    low = max(float(positive.min()), 1 / _HIGHEST) / 1.1
    high = max(float(positive.max()) * 1.1, 2 * low)
    factors = (1, 2, 5) if high < 1000 * low else (1,)
    marks = [mark for mark in LogLocator(10, factors).tick_values(low, high) if low <= mark <= high]
    return np.maximum(scores, low), low, high, marks


@house_style()
def _history(tuning: TuningStudy) -> Chart:
    trials = sorted(tuning.scored, key=lambda trial: trial.number)
    numbers = np.array([trial.number for trial in trials], float)
    scores, low, high, marks = _scale(trials)
    done = np.array([trial.status == "done" for trial in trials])
    dots: dict[str, Any] = {"linestyle": "", "marker": "o", "markersize": 6, "clip_on": False}
    line: dict[str, Any] = {"color": _WINNER, "linewidth": 2.2, "clip_on": False}
    legend = [
        (Line2D([], [], color=_DONE, alpha=0.75, **dots), "done"),
        (Line2D([], [], color=_PRUNED, alpha=0.45, **dots), "pruned, as it stood then"),
        (Line2D([], [], **line), "best so far"),
    ]
    figure, axes = chart.new_figure("Score by trial", 190, "y", legend if done.any() else legend[:2])
    end = max(1.0, numbers.max())
    axes.set(yscale="log", ylim=(low, high), ylabel="score, logarithmic", xlim=(0, end), xlabel="trial")
    axes.set_yticks(marks, list(map(_power, marks)))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.plot(numbers[done], scores[done], color=_DONE, alpha=0.75, **dots)
    axes.plot(numbers[~done], scores[~done], color=_PRUNED, alpha=0.45, **dots)
    if done.any():
        lowest = np.minimum.accumulate(scores[done])
        axes.step([*numbers[done], end], [*lowest, lowest[-1]], where="post", **line)
    return Chart(
        f"{tuning.name} history",
        f"Score by trial, {tuning.title.lower()}",
        "a dot for each trial, on a logarithmic scale, lower is better, and a line for the best so far",
        figure,
    )


@house_style()
def _importances(tuning: TuningStudy) -> Chart:
    ranked = sorted(tuning.importances.items(), key=lambda item: -item[1])
    shares = np.nan_to_num([share for _, share in ranked]).clip(0, 1)
    figure, axes = chart.new_figure("Importance of each key", 26.0 * len(ranked))
    chart.rows_on(axes, [clipped(_short(key), 25) for key, _ in ranked])
    axes.set(xlim=(0, max(0.01, shares.max())), xticks=[], xlabel="share of the score's variance")
    bars = axes.barh(range(len(ranked)), shares, height=0.46, color=_DONE, clip_on=False)
    axes.bar_label(bars, [f"{share:.2f}" for _, share in ranked], padding=6, size=SMALL, color=MUTED)
    return Chart(
        f"{tuning.name} importances",
        f"Importance of each key, {tuning.title.lower()}",
        "by Optuna's PED-ANOVA over the finished trials; the shares sum to one",
        figure,
    )


@house_style()
def _parallel(tuning: TuningStudy, done: Sequence[TrialRow]) -> Chart:
    ranked = sorted(done, key=lambda trial: trial.score)
    bold = max(1, round(_BEST * len(ranked)))
    keys = list(tuning.space)
    scores, low, high, marks = _scale(ranked)
    of_scores = _on_axis(np.array(marks), low, high, is_log=True)
    axes_of = [
        (_on_axis(scores, low, high, is_log=True), list(zip(map(_power, marks), of_scores, strict=True)))
    ]
    axes_of += [_axis(tuning.space[key], [trial.values[key] for trial in ranked]) for key in keys]
    title = "What the best tenth of the finished trials chose, and the winner"
    figure, axes = chart.new_figure(title, 250, width=WIDE)
    axes.set(xlim=(0, max(1, len(keys))), ylim=(0, 1), xticks=[], yticks=[])
    lines = [list(enumerate(heights)) for heights in zip(*(heights for heights, _ in axes_of), strict=True)]
    winner = [line for trial, line in zip(ranked, lines, strict=True) if trial.number == tuning.winner]
    looks = ((lines[bold:], MUTED, 0.5), (lines[:bold], _DONE, 1.6), (winner, _WINNER, 2.6))
    for chosen, colour, width in looks:
        axes.add_collection(LineCollection(chosen, colors=colour, linewidths=width, clip_on=False))
    for index, (name, (_, texts)) in enumerate(zip(["score", *map(_short, keys)], axes_of, strict=True)):
        axes.axvline(index, color=INK, linewidth=1, clip_on=False)
        side = "left" if index == 0 else "right" if index == len(keys) else "center"
        below = -18 if index % 2 == 0 else -34  # in two rows, for long names
        axes.annotate(clipped(name, 34), (index, 0), (0, below), textcoords="offset points", weight="bold",
                      ha=side)  # fmt: skip
        for text, height in texts:
            axes.annotate(text, (index, height), (5, -4), textcoords="offset points", size=10, color=MUTED)
    return Chart(
        f"{tuning.name} parallel coordinates",
        f"Parallel coordinates, {tuning.title.lower()}",
        f"a line for each finished trial through its score and values; the best {bold} stand out, "
        "the winner most",
        figure,
    )


def _on_axis(numbers: FloatArray, low: float, high: float, is_log: bool) -> FloatArray:
    """Where numbers lie between the ends of an axis, from 0 to 1."""
    bend = np.log if is_log else np.asarray
    return np.interp(bend(numbers), bend(np.array([low, high])), (0.0, 1.0))


def _axis(dimension: Mapping[str, Any], texts: Sequence[str]) -> tuple[FloatArray, _Marks]:
    """Where values lie on their axis, from 0 to 1, and what stands at it: its choices or its ends."""
    if dimension["type"] == "categorical":
        choices = dimension["choices"]
        places = {choice: index / max(1, len(choices) - 1) for index, choice in enumerate(choices)}
        marks = [(clipped(choice, 12), height) for choice, height in places.items()]
        return np.array([places.get(text, 0.0) for text in texts]), marks
    low, high = dimension["low"], dimension["high"]
    numbers = np.array([float(text or low) for text in texts])
    return _on_axis(numbers, low, high, dimension["log"]), [(f"{low:g}", 0.0), (f"{high:g}", 1.0)]


def _power(number: float) -> str:
    return f"{number:.3g}"


def _short(key: str) -> str:
    """`agent.learning_rate` as learning_rate."""
    return key.rpartition(".")[2]
