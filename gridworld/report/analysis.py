"""What is computed of every agent on every task: metrics, estimates, curves and comparisons."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from gridworld.mdp import FloatArray
from gridworld.report import statistics
from gridworld.report.grouping import Group, Study
from gridworld.report.reading import ONLINE, SAMPLED_RETURN, Evidence
from gridworld.report.statistics import Interval, Share
from gridworld.report.world import Reference, reference

GRID_POINTS = 101  # of a curve, from step 0 to the end of the task's longest run


@dataclass(frozen=True)
class Metric:
    """One number of a run; NaN where the run does not have it."""

    key: str
    title: str
    of: Callable[[Evidence, Reference], float]
    statistics: tuple[str, ...] = ("mean",)
    better: int = 1  # 1: more is better, -1: less is
    compared: bool = False  # between agents, as a probability of improvement


def optimality(run: Evidence, world: Reference) -> float:
    """1 for the optimum, 0 for the uniformly random policy; below 0 is worse than that."""
    span = world.optimal_value - world.random_value
    if not (math.isfinite(span) and span > 0):
        return math.nan
    return 1.0 - run.regret / span


def online_return(run: Evidence, last: float = 1.0) -> float:
    """Mean return of the last part's training episodes, each row weighted by the steps it stands for."""
    if ONLINE not in run.curve:
        return math.nan
    weights = np.diff(run.curve["step"], prepend=0.0)
    told = np.isfinite(run.curve[ONLINE]) & (weights > 0) & (run.curve["step"] > (1 - last) * run.steps)
    return float(np.average(run.curve[ONLINE][told], weights=weights[told])) if told.any() else math.nan


def _last(column: str) -> Callable[[Evidence, Reference], float]:
    return lambda run, _: float(run.curve[column][-1]) if column in run.curve else math.nan


METRICS = (
    Metric("regret", "final regret", lambda run, _: run.regret, ("iqm", "median", "mean"), -1, compared=True),
    Metric(
        "steps",
        "steps to the first certificate",
        lambda run, _: run.first_certified_step,
        ("iqm", "median"),
        -1,
        compared=True,
    ),
    Metric("optimality", "optimality", optimality, ("iqm", "mean")),
    Metric("value", "value", _last("value")),
    Metric("return", "return", _last("return")),
    Metric("goal_probability", "goal probability", _last("goal_probability")),
    Metric("sampled_return", "sampled policy's return", _last(SAMPLED_RETURN)),
    Metric("online_return", "on-line return, all of training", lambda run, _: online_return(run)),
    Metric(
        "online_return_end",
        "on-line return, last tenth",
        lambda run, _: online_return(run, 0.1),
        compared=True,
    ),
)
BY_KEY = {metric.key: metric for metric in METRICS}
_STATISTICS = {"mean": statistics.mean, "median": statistics.median, "iqm": statistics.iqm}


@dataclass(frozen=True, eq=False)
class Band:
    """A curve over seeds, (points,) each."""

    steps: FloatArray
    point: FloatArray
    mean: FloatArray
    low: FloatArray
    high: FloatArray
    whole_until: int  # environment steps that all runs reach; later, ended runs keep their last value


@dataclass(frozen=True, eq=False)
class Result:
    """One agent on one task."""

    group: Group
    certified: Share  # at the end
    ever: Share
    samples: Mapping[str, FloatArray]  # by metric, (runs that have it,)
    estimates: Mapping[tuple[str, str], Interval]  # by (metric, statistic)
    regret: Band
    certificates: Band  # share of seeds certified; its mean, with Wilson's interval
    online: Band | None

    @property
    def shortest_uncertified(self) -> float:
        """Steps that every run without a certificate was at least given."""
        ends = [run.steps for run in self.group.runs if math.isinf(run.first_certified_step)]
        return float(min(ends, default=0))


@dataclass(frozen=True)
class Comparison:
    """The probability that a run of `agent` is better than one of `other`."""

    agent: str
    other: str
    metric: str
    tasks: int  # over how many
    probability: Interval

    def mirrored(self) -> Comparison:
        """Seen from the other's side."""
        seen = self.probability
        return Comparison(
            self.other,
            self.agent,
            self.metric,
            self.tasks,
            Interval(1 - seen.point, 1 - seen.high, 1 - seen.low),
        )


@dataclass(frozen=True, eq=False)
class TaskAnalysis:
    """All agents on one task."""

    task: str
    world: Reference
    results: tuple[Result, ...]
    comparisons: tuple[Comparison, ...]


@dataclass(frozen=True, eq=False)
class Overall:
    """Agents over all the tasks that they were run on, two or more."""

    tasks: int
    optimality: Mapping[str, tuple[int, Interval]]  # by agent: how many tasks, and the IQM over them
    comparisons: tuple[Comparison, ...]


def analyse(study: Study, seed: int = 0) -> tuple[tuple[TaskAnalysis, ...], Overall | None]:
    """Everything that the report tells; `seed` is the bootstrap's."""
    tasks = tuple(_task(task, study.on(task), seed) for task in study.tasks)
    return tasks, _overall(tasks, seed)


def _task(task: str, groups: list[Group], seed: int) -> TaskAnalysis:
    world = reference(groups[0].runs[0])
    end = max(run.steps for group in groups for run in group.runs)
    grid = np.unique(np.round(np.linspace(0, end, GRID_POINTS)))
    results = tuple(_result(group, world, grid, seed) for group in groups)
    return TaskAnalysis(task, world, results, compare([{r.group.agent: r.samples for r in results}], seed))


def _result(group: Group, world: Reference, grid: FloatArray, seed: int) -> Result:
    samples, estimates = {}, {}
    for metric in METRICS:
        values = np.array([metric.of(run, world) for run in group.runs])
        samples[metric.key] = values = values[~np.isnan(values)]
        for name in metric.statistics if len(values) else ():
            estimates[metric.key, name] = statistics.interval(_STATISTICS[name], [values], seed)
    runs = len(group.runs)
    return Result(
        group,
        certified=statistics.share(sum(run.certified for run in group.runs), runs),
        ever=statistics.share(sum(math.isfinite(run.first_certified_step) for run in group.runs), runs),
        samples=samples,
        estimates=estimates,
        regret=band(group.runs, "regret", grid, seed),
        certificates=_certificates(group.runs, grid),
        online=_online(group.runs, grid, seed),
    )


def on_grid(run: Evidence, column: str, grid: FloatArray) -> FloatArray:
    """(points,): the newest value at each step; NaN before the first. An ended run keeps its last."""
    steps, values = run.curve["step"], run.curve[column]
    told = ~np.isnan(values)
    steps, values = steps[told], values[told]
    index = np.searchsorted(steps, grid, side="right") - 1
    return np.where(index >= 0, values[np.maximum(index, 0)], math.nan) if len(values) else grid * math.nan


def band(runs: Sequence[Evidence], column: str, grid: FloatArray, seed: int) -> Band:
    """IQM and mean over runs at each step, until the last of them ends, with the IQM's bootstrap band."""
    grid, whole_until = _until_the_end(runs, grid)
    values = np.stack([on_grid(run, column, grid) for run in runs], axis=-1)
    told = ~np.isnan(values).any(axis=-1)  # from the step on at which every run has a value
    grid, values = grid[told], values[told]
    point, low, high = statistics.bands(statistics.iqm, [values], seed)
    return Band(grid, point, values.mean(axis=-1), low, high, whole_until)


def _certificates(runs: Sequence[Evidence], grid: FloatArray) -> Band:
    grid, whole_until = _until_the_end(runs, grid)
    counts = np.sum([on_grid(run, "certified", grid) for run in runs], axis=0)
    shares = [statistics.share(int(count), len(runs)) for count in counts]
    mean = counts / len(runs)
    low, high = np.array([s.low for s in shares]), np.array([s.high for s in shares])
    return Band(grid, mean, mean, low, high, whole_until)


def _online(runs: Sequence[Evidence], grid: FloatArray, seed: int) -> Band | None:
    if not all(ONLINE in run.curve and np.isfinite(run.curve[ONLINE]).any() for run in runs):
        return None
    return band(runs, ONLINE, grid, seed)


def _until_the_end(runs: Sequence[Evidence], grid: FloatArray) -> tuple[FloatArray, int]:
    ends = [run.steps for run in runs]
    grid = grid[grid <= max(ends)]
    if grid[-1] < max(ends):
        grid = np.append(grid, max(ends))
    return grid, min(ends)


def compare(
    tasks: Sequence[Mapping[str, Mapping[str, FloatArray]]], seed: int, least: int = 1
) -> tuple[Comparison, ...]:
    """Every agent against every other over the tasks that both were run on, `least` or more.

    `tasks` are samples by agent and metric.
    """
    agents = sorted({agent for task in tasks for agent in task})
    out = []
    for metric in METRICS:
        for one, other in combinations(agents, 2) if metric.compared else ():
            pairs = [
                (metric.better * task[one][metric.key], metric.better * task[other][metric.key])
                for task in tasks
                if one in task and other in task
            ]
            pairs = [pair for pair in pairs if len(pair[0]) and len(pair[1])]
            if len(pairs) >= least:
                comparison = Comparison(
                    one, other, metric.key, len(pairs), statistics.improvement(pairs, seed)
                )
                out += [comparison, comparison.mirrored()]
    return tuple(out)


def _overall(tasks: Sequence[TaskAnalysis], seed: int) -> Overall | None:
    """None where no agent was run on two tasks."""
    samples = [{result.group.agent: result.samples for result in task.results} for task in tasks]
    scores: dict[str, list[FloatArray]] = {}
    for task in samples:
        for agent, metrics in task.items():
            if len(metrics["optimality"]):
                scores.setdefault(agent, []).append(metrics["optimality"])
    optimality = {
        agent: (len(strata), statistics.interval(statistics.iqm, strata, seed))
        for agent, strata in sorted(scores.items())
        if len(strata) > 1
    }
    return Overall(len(tasks), optimality, compare(samples, seed, least=2)) if optimality else None
