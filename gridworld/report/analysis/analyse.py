"""Estimates, curves and comparisons of every agent on every task."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from gridworld.report.analysis import curves, statistics
from gridworld.report.analysis.curves import Band
from gridworld.report.analysis.metrics import METRICS, Reference, reference
from gridworld.report.analysis.statistics import Interval, Share
from gridworld.report.evidence.grouping import Group, Study, shortfall
from gridworld.world.mdp import FloatArray

_SLOWER = 10  # times, from which on the steps of a task's agents need a logarithmic axis
_LEVELS = 101
_STATISTICS = {"mean": statistics.mean, "median": statistics.median, "iqm": statistics.iqm}


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


@dataclass(frozen=True, eq=False)
class TaskAnalysis:
    """All agents on one task."""

    task: str
    world: Reference
    results: tuple[Result, ...]
    comparisons: tuple[Comparison, ...]
    log_steps: bool = False  # whether curves are drawn against the logarithm of the steps

    @property
    def ranked(self) -> list[Result]:
        """The results, best first: by the share certified, then by steps to it, then by regret."""

        def rank(result: Result) -> tuple[float, ...]:
            steps, regret = result.estimates["steps", "median"], result.estimates["regret", "iqm"]
            return -result.certified.count / result.certified.total, steps.point, regret.point

        return sorted(self.results, key=rank)

    @property
    def groups(self) -> list[Group]:
        """The results' runs."""
        return [result.group for result in self.results]

    @property
    def shortfall(self) -> str:
        """See `grouping.shortfall`."""
        return shortfall(self.groups)


@dataclass(frozen=True, eq=False)
class Overall:
    """Agents over all the tasks that they were run on, two or more."""

    tasks: int
    optimality: Mapping[str, tuple[int, Interval]]  # by agent: how many tasks, and the IQM over them
    comparisons: tuple[Comparison, ...]
    levels: FloatArray  # of optimality, (points,)
    profiles: Mapping[str, tuple[FloatArray, ...]]  # by agent: share of runs above each level, low and high


def analyse(
    study: Study, seed: int = 0, log_steps: bool = False
) -> tuple[tuple[TaskAnalysis, ...], Overall | None]:
    """Compute all that the report shows: of each task, and over tasks where an agent was run on two.

    `seed` is of the bootstrap. With `log_steps`, all curves are against the logarithm of the steps; those
    of a task on which one agent is ten times slower than another always are.
    """
    tasks = tuple(_task(task, study.on(task), seed, log_steps) for task in study.tasks)
    return tasks, _overall(tasks, seed)


def _task(task: str, groups: list[Group], seed: int, log_steps: bool) -> TaskAnalysis:
    runs = [run for group in groups for run in group.runs]
    world = reference(next((run for run in runs if not run.damage), runs[0]))
    ends = [max(run.steps for run in group.runs) for group in groups]
    learnt = [float(np.median([run.first_certified_step for run in group.runs])) for group in groups]
    for steps in (ends, learnt):  # whether one agent ran, or learnt, ten times as long as another
        known = [step for step in steps if 0 < step < math.inf]
        log_steps |= bool(known) and max(known) >= _SLOWER * min(known)
    grid = curves.grid_for(runs, log_steps)
    results = tuple(_result(group, world, grid, seed) for group in groups)
    comparisons = compare([{r.group.agent: r.samples for r in results}], seed)
    return TaskAnalysis(task, world, results, comparisons, log_steps)


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
        regret=curves.band(group.runs, "regret", grid, seed),
        certificates=curves.certificates(group.runs, grid),
        online=curves.online(group.runs, grid, seed),
    )


def compare(
    tasks: Sequence[Mapping[str, Mapping[str, FloatArray]]], seed: int, least: int = 1
) -> tuple[Comparison, ...]:
    """Compare every agent with every other on the tasks that both were run on, `least` or more.

    `tasks` has samples (runs,) by agent and metric for each task. Each pair is there twice, seen from either
    side, for each metric that is compared.
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
                seen = statistics.improvement(pairs, seed)
                mirrored = Interval(1 - seen.point, 1 - seen.high, 1 - seen.low)
                out.append(Comparison(one, other, metric.key, len(pairs), seen))
                out.append(Comparison(other, one, metric.key, len(pairs), mirrored))
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
    if not optimality:
        return None
    strata = {agent: scores[agent] for agent in optimality}
    lowest = min(float(sample.min()) for each in strata.values() for sample in each)
    levels = np.linspace(min(0.0, max(-1.0, lowest)), 1.0, _LEVELS)
    profiles = {agent: statistics.profile(each, levels, seed) for agent, each in strata.items()}
    return Overall(len(tasks), optimality, compare(samples, seed, least=2), levels, profiles)
