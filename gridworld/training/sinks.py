"""The sinks of a learning curve's evaluations: its file, TensorBoard, the progress line."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gridworld.process.console.progress import Progress
from gridworld.storage.append_log import AppendLog
from gridworld.storage.csv_text import csv_text
from gridworld.training.learning_curve import Evaluation
from gridworld.training.tensorboard import EventWriter
from gridworld.world.exact.evaluation import Evaluator, Score
from gridworld.world.metrics import METRICS, TRAINING_METRICS, Metric, numbers, optimal_score

# TensorBoard sorts its groups by name and opens with the first: the greedy policy's learning curve. Behind it
# are the greedy policy's other metrics, the sampled policy, and the optimum, which is a flat line.
GREEDY, GREEDY_MORE, SAMPLED, OPTIMUM = "eval", "eval_more", "eval_sampled", "optimal"


def _greedy_tag(metric: Metric) -> str:
    return f"{GREEDY if metric.in_front else GREEDY_MORE}/{metric.name}"


def _greedy_tags(score: Score) -> dict[str, float]:
    """Every metric under its own name, and where SB3 has a name for it under that too."""
    tags = {_greedy_tag(metric): float(metric.of(score)) for metric in METRICS}
    by_sb3 = {metric.sb3_name: float(metric.of(score)) for metric in METRICS if metric.sb3_name is not None}
    return tags | {f"{GREEDY}/{name}": number for name, number in by_sb3.items()}


def _charts() -> dict[str, list[str]]:
    charts: dict[str, list[str]] = {metric.chart: [] for metric in METRICS if metric.chart is not None}
    for training_metric in TRAINING_METRICS:
        charts.setdefault(training_metric.chart, []).append(training_metric.tag)
    for metric in METRICS:
        if metric.chart is not None:
            optimum = [f"{OPTIMUM}/{metric.name}"] if metric.has_optimum else []
            charts[metric.chart] += [_greedy_tag(metric), f"{SAMPLED}/{metric.name}", *optimum]
    return charts


CHARTS = _charts()  # {title: tags}
CURVE_COLUMNS = (
    "step",
    *(metric.name for metric in METRICS),
    *(f"sampled_{metric.name}" for metric in METRICS),
    *(metric.name for metric in TRAINING_METRICS),
)


class CurveFile:
    """`curve.csv`: a row per evaluation."""

    def __init__(self, log: AppendLog) -> None:
        self._log = log

    def write(self, evaluation: Evaluation) -> None:
        """Append a row; before the first one, the names of the columns."""
        row: dict[str, Any] = {"step": evaluation.step, **numbers(evaluation.greedy)}
        row |= {f"sampled_{name}": number for name, number in numbers(evaluation.sampled).items()}
        row |= {metric.name: metric.of(evaluation.returns) for metric in TRAINING_METRICS}
        head = [] if self._log.length else [CURVE_COLUMNS]
        self._log.append(csv_text([*head, [row[name] for name in CURVE_COLUMNS]]).encode())


def read_curve(log: AppendLog, columns: Sequence[str]) -> dict[str, NDArray[np.float64]]:
    """Read columns of the `curve.csv` of this process, (evaluations,) each, that have no empty field."""
    rows = csv.DictReader(io.StringIO(log.content().decode(), newline=""))
    found = np.array([[float(row[name]) for name in columns] for row in rows])
    return dict(zip(columns, found.reshape(-1, len(columns)).T, strict=True))


class CurveScalars:
    """TensorBoard's scalars: a point per evaluation and metric, beside the optimum."""

    def __init__(self, events: EventWriter, evaluator: Evaluator) -> None:
        self._events = events
        best = optimal_score(evaluator)
        self._optimum = {
            f"{OPTIMUM}/{metric.name}": float(metric.of(best)) for metric in METRICS if metric.has_optimum
        }

    def write(self, evaluation: Evaluation) -> None:
        """Write one event with a value for every tag."""
        tags = self._optimum | _greedy_tags(evaluation.greedy)
        tags |= {f"{SAMPLED}/{name}": float(number) for name, number in numbers(evaluation.sampled).items()}
        for metric in TRAINING_METRICS:
            if (number := metric.of(evaluation.returns)) is not None:
                tags[metric.tag] = number
        self._events.scalars(tags, evaluation.step)


class ProgressLine:
    """What stands beside the progress bar."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress

    def write(self, evaluation: Evaluation) -> None:
        """Show how good the greedy policy is."""
        greedy = evaluation.greedy
        note = f"regret {greedy.regret:.3g}, goal {greedy.outcome.goal:.0%}"
        self._progress.update(evaluation.step, note + (", certified optimal" if greedy.certified else ""))
