"""The metrics of a learning curve: a row is a column of `curve.csv`, a field of `summary.json`, a tag of
TensorBoard, a line of its charts and of the tables on a terminal. To add a metric, add its row.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from gridworld.world.evaluation import Evaluator, Score

Z_95 = 1.959963984540054  # standard deviations of the normal distribution on either side of 95 % of it
_ROUNDING = 1e-12  # of a regret, which may be below 0 for it


def regret_text(number: float) -> str:
    """A regret as messages have it; what is 0 but for rounding is 0."""
    return "0" if number < _ROUNDING else f"{number:.3g}"


@dataclass(frozen=True)
class Metric:
    """A number that is computed of the greedy and of the sampled policy."""

    name: str  # in files and tags; the sampled policy's column is sampled_<name>
    label: str  # in tables
    of: Callable[[Score], float]
    in_front: bool = False  # in TensorBoard's first group, `eval`
    sb3_name: str | None = (
        None  # what SB3's evaluation calls it, and TensorBoard's curve of the greedy policy
    )
    chart: str | None = None  # of TensorBoard's Custom Scalars tab
    is_headline: bool = False  # in the table at a run's end, if in any
    has_optimum: bool = False  # the optimum's is written too, as optimal_<name>
    known_optimum: float | None = None  # where it is the same in every world, so that it is not written
    within_limit: bool = True  # it is of an episode within the step limit
    in_tables: bool = True
    in_report: bool = False  # a report has the mean over seeds of its last value
    text: Callable[[float], str] = "{:.4g}".format  # in tables

    def row(self, *found: float | None) -> tuple[str, ...]:
        """The label and the numbers as a table has them; a cell is empty where there is no number."""
        return (self.label, *("" if each is None else self.text(each) for each in found))


class EpisodeReturns(Protocol):
    """What was counted while training since the evaluation before."""

    @property
    def mean(self) -> float | None:
        """The mean undiscounted return of the episodes that ended; None where none did."""


@dataclass(frozen=True)
class TrainingMetric:
    """A number of training itself, exploration and half-learned policies included."""

    name: str  # the column
    tag: str
    chart: str
    of: Callable[[EpisodeReturns], float | None]  # None: an empty field, and no point in TensorBoard


METRICS = (
    Metric(
        "value",
        "value",
        lambda score: score.value,
        chart="value",
        has_optimum=True,
        in_report=True,
        in_front=True,
        is_headline=True,
        within_limit=False,
    ),
    Metric(
        "regret",
        "regret",
        lambda score: score.regret,
        chart="regret",
        known_optimum=0.0,
        text=regret_text,
        in_front=True,
        is_headline=True,
        within_limit=False,
    ),
    Metric(
        "certified",
        "certified",
        lambda score: int(score.certified),
        is_headline=True,
        within_limit=False,
        in_tables=False,
    ),
    Metric(
        "goal_probability",
        "goal probability",
        lambda score: score.outcome.goal,
        sb3_name="success_rate",
        chart="goal probability",
        is_headline=True,
        has_optimum=True,
        in_report=True,
    ),
    Metric("trap_probability", "trap probability", lambda score: score.outcome.trap),
    Metric("timeout_probability", "time-out probability", lambda score: score.outcome.timeout),
    Metric(
        "return",
        "return",
        lambda score: score.outcome.expected_return,
        sb3_name="mean_reward",
        chart="return",
        in_report=True,
    ),
    Metric(
        "length",
        "episode length",
        lambda score: score.outcome.expected_length,
        sb3_name="mean_ep_length",
        chart="length",
        is_headline=True,
        has_optimum=True,
    ),
)
TRAINING_METRICS = (TrainingMetric("online_return", "online/return", "return", lambda returns: returns.mean),)


def numbers(score: Score) -> dict[str, float]:
    """Every metric of a score, by its name; `certified` is 0 or 1."""
    return {metric.name: metric.of(score) for metric in METRICS}


def optimal_score(evaluator: Evaluator) -> Score:
    """The score of an optimal policy."""
    return Score(evaluator.optimal_value, 0.0, True, evaluator.optimum, evaluator.mdp.scope)


def optimal_numbers(evaluator: Evaluator) -> dict[str, float]:
    """What is written of the optimum: {"optimal_value": ..., ...}."""
    best = optimal_score(evaluator)
    return {f"optimal_{metric.name}": metric.of(best) for metric in METRICS if metric.has_optimum}


def wilson_interval(count: int, total: int) -> tuple[float, float]:
    """Wilson's score interval, from 0 to 1, for the share of `count` hits in `total` samples, one or more.

    It is `scipy.stats.binomtest(count, total).proportion_ci(0.95, method="wilson")`, without the second that
    `scipy.stats` takes to import. Reference: method 3 of R. G. Newcombe, Statistics in Medicine 17, 1998.
    """
    share = count / total
    scale = 2 * (total + Z_95**2)
    centre = (2 * total * share + Z_95**2) / scale
    half_width = Z_95 / scale * math.sqrt(4 * total * share * (1 - share) + Z_95**2)
    return (0.0 if count == 0 else centre - half_width), (1.0 if count == total else centre + half_width)
