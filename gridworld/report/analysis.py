"""Metrics, curves and comparisons of every agent on every task: all that a report shows of its runs."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from gridworld.base.errors import InputError
from gridworld.config.train import check_bounds
from gridworld.config.worlds import schema_of
from gridworld.report import statistics
from gridworld.report.evidence import REPORTED, SAMPLED_RETURN, Evidence, Unusable, find_runs, read
from gridworld.report.grouping import Group, Study, arrange
from gridworld.report.playground.page import fits, link
from gridworld.report.statistics import Interval, Share
from gridworld.report.tuning_study import TuningStudy, find_tunings
from gridworld.run.provenance import versions
from gridworld.run.reader import ONLINE, read_run, stored_world
from gridworld.world.evaluation import Evaluator
from gridworld.world.mdp import FloatArray
from gridworld.world.metrics import wilson_interval

_MOST_SHOWN = 20  # sentences on standard error; the page has them all
_GRID_POINTS = 101  # from step 0 to the end of the task's longest run
_MOST_CELLS = 100_000  # beyond, solving the world again would take longer than the report
_TOLERANCE = 1e-6  # relative
_SLOWER = 10  # times, from which on the steps of a task's agents need a logarithmic axis
_LEVELS = 101
_STATISTICS = {"mean": statistics.mean, "median": statistics.median, "iqm": statistics.iqm}


@dataclass(frozen=True)
class Reference:
    """Exact numbers of a task; NaN where its world cannot be built again."""

    optimal_value: float
    optimal_return: float = math.nan  # of the optimal policy, undiscounted, within the step limit
    random_value: float = math.nan
    random_return: float = math.nan
    problem: str | None = None  # why they are missing, or in doubt
    link: str | None = None  # to its map in the playground, what follows the page's address


def _reference(run: Evidence) -> Reference:
    """Solve the run's world again, from its manifest."""
    try:
        schema = schema_of(run.world)
        if unknown := sorted(run.world.keys() - {each.name for each in dataclasses.fields(schema)}):
            raise ValueError(f"env.{unknown[0]} is unknown to this version")
        lines = run.layout.split("\n")
        if len(lines) * max(map(len, lines)) > _MOST_CELLS:
            raise ValueError(f"it has more than {_MOST_CELLS:,} cells")
        env = schema(**run.world)
        check_bounds(env, "env.")
        mdp = stored_world(read_run(run.folder), env)
        evaluator = Evaluator(mdp, run.gamma, env.step_limit(mdp))
        random = evaluator.score(np.full((mdp.num_states, mdp.num_actions), 1 / mdp.num_actions))
    except (ValueError, TypeError, ArithmeticError, np.linalg.LinAlgError) as error:
        # Whatever is wrong with another version's world, the runs' own scores are as good as before.
        return Reference(run.optimal_value, problem=f"its world cannot be rebuilt here ({error})")
    optimum, problem = evaluator.optimal_value, None
    if not math.isclose(optimum, run.optimal_value, rel_tol=_TOLERANCE, abs_tol=_TOLERANCE):
        problem = (
            f"its optimal value is {optimum:.6g} here, but {run.optimal_value:.6g} according to "
            f"{run.folder}; was it written by another version?"
        )
    returns = evaluator.optimum.expected_return, random.outcome.expected_return
    limit = env.step_limit(mdp)
    address = link(mdp, run.gamma, limit) if fits(mdp) else None
    return Reference(run.optimal_value, returns[0], random.value, returns[1], problem, address)


@dataclass(frozen=True)
class RunMetric:
    """One number of a run."""

    key: str
    title: str
    of: Callable[[Evidence, Reference], float]  # NaN where the run has none
    statistics: tuple[str, ...] = ("mean",)  # over seeds; the first one is drawn
    better: int = 1  # -1 where less is better
    is_compared: bool = False  # between agents, as a probability of improvement


def _optimality(run: Evidence, world: Reference) -> float:
    """The final regret rescaled: 1 for the optimum, 0 for the uniformly random policy, below 0 for worse."""
    span = world.optimal_value - world.random_value
    return 1.0 - run.regret / span if math.isfinite(span) and span > 0 else math.nan


def online_return(run: Evidence, last: float = 1.0) -> float:
    """Mean return of the training episodes in the `last` part of training, weighted by steps; NaN: none."""
    if ONLINE not in run.curve:
        return math.nan
    begin = (1 - last) * run.steps
    weights = np.diff(np.maximum(run.curve["step"], begin), prepend=begin)
    counted = np.isfinite(run.curve[ONLINE]) & (weights > 0)
    if not counted.any():
        return math.nan
    return float(run.curve[ONLINE][counted] @ (weights[counted] / weights[counted].sum()))


def _last(column: str) -> Callable[[Evidence, Reference], float]:
    return lambda run, _: float(run.curve[column][-1]) if column in run.curve else math.nan


# fmt: off
_METRICS = (
    RunMetric("regret", "final regret", lambda run, _: run.regret, ("iqm", "median", "mean"), -1, True),
    RunMetric("steps", "steps until certified for good", lambda run, _: run.certified_since_step,
              ("iqm", "median"), -1, True),
    RunMetric("first", "steps until the first certificate", lambda run, _: run.first_certified_step,
              ("median",), -1),
    RunMetric("optimality", "optimality", _optimality, ("iqm", "mean")),
    *(RunMetric(metric.name, metric.label, _last(metric.name)) for metric in REPORTED),
    RunMetric("sampled_return", "sampled policy's return", _last(SAMPLED_RETURN)),
    RunMetric("online_return", "online return, all of training", lambda run, _: online_return(run)),
    RunMetric("online_return_end", "online return, last tenth", lambda run, _: online_return(run, 0.1),
              is_compared=True),
)
# fmt: on
METRICS = {metric.key: metric for metric in _METRICS}


@dataclass(frozen=True, eq=False)
class Band:
    """A curve over seeds, (points,) each."""

    steps: FloatArray
    point: FloatArray
    low: FloatArray
    high: FloatArray
    whole_until: int  # environment steps that all runs reach; later, ended runs keep their last value


def _grid(runs: Sequence[Evidence], logarithmic: bool) -> FloatArray:
    """The steps (points,) of all of a task's curves, spread evenly, and on a logarithmic axis where asked."""
    end = max(run.steps for run in runs)
    points = np.linspace(0, end, _GRID_POINTS)
    first = min((run.curve["step"][1] for run in runs if run.steps > 0), default=0.0)
    if logarithmic and first > 0:
        points = np.concatenate([[0.0], points[points >= first], np.geomspace(first, end, _GRID_POINTS)])
    return np.unique(np.round(points))


def on_grid(run: Evidence, column: str, grid: FloatArray) -> FloatArray:
    """A column's newest value at each of the grid's steps, (points,): NaN before the first one."""
    steps, values = run.curve["step"], run.curve[column]
    steps, values = steps[~np.isnan(values)], values[~np.isnan(values)]
    index = np.searchsorted(steps, grid, side="right") - 1
    return np.where(index >= 0, values[np.maximum(index, 0)], math.nan) if len(values) else grid * math.nan


def _band(runs: Sequence[Evidence], column: str, grid: FloatArray, seed: int) -> Band:
    """The IQM of a column over runs, from the first step at which all have a value."""
    values = np.stack([on_grid(run, column, grid) for run in runs], axis=-1)
    is_whole = ~np.isnan(values).any(axis=-1)
    grid, values = grid[is_whole], values[is_whole]
    point, low, high = statistics.bands(statistics.iqm, [values], seed)
    return Band(grid, point, low, high, min(run.steps for run in runs))


def _certificates(runs: Sequence[Evidence], grid: FloatArray) -> Band:
    """The share of runs that are certified at each step of the grid, with Wilson's 95 % interval."""
    counts = np.sum([on_grid(run, "certified", grid) for run in runs], axis=0)
    low, high = np.array([wilson_interval(int(count), len(runs)) for count in counts]).T
    if len(runs) == 1:  # it would cover nearly everything
        low = high = np.full(len(grid), math.nan)
    return Band(grid, counts / len(runs), low, high, min(run.steps for run in runs))


@dataclass(frozen=True, eq=False)
class Result:
    """One agent on one task."""

    group: Group
    certified: Share  # at the end
    ever: Share
    samples: Mapping[str, FloatArray]  # by metric, (runs that have it,)
    estimates: Mapping[tuple[str, str], Interval]  # by (metric, statistic)
    regret: Band
    certificates: Band
    online: Band | None  # None unless all runs have it


# By metric and two agents: the probability that a run of the first is better than one of the second.
Comparisons = Mapping[tuple[str, str, str], Interval]


@dataclass(frozen=True, eq=False)
class TaskAnalysis:
    """All agents on one task."""

    task: str
    world: Reference
    results: tuple[Result, ...]
    comparisons: Comparisons
    log_steps: bool = False  # whether curves are drawn against the logarithm of the steps

    @property
    def ranked(self) -> list[Result]:
        """The results, best first: by the share certified, then by steps to it, then by regret."""

        def rank(result: Result) -> tuple[float, ...]:
            steps, regret = result.estimates["steps", "median"], result.estimates["regret", "iqm"]
            return -result.certified.count / result.certified.total, steps.point, regret.point

        return sorted(self.results, key=rank)

    @property
    def best(self) -> list[Result]:
        """The first of the ranked, and those of which no interval says that they are worse."""
        first, *others = self.ranked

        def is_worse(other: Result) -> bool:
            agents = first.group.agent, other.group.agent
            sooner, less = (self.comparisons[key, *agents] for key in ("steps", "regret"))
            more = statistics.difference(first.certified, other.certified)
            return more.low > 0 or sooner.low > 0.5 or less.low > 0.5

        return [first, *(each for each in others if not is_worse(each))]


@dataclass(frozen=True, eq=False)
class Overall:
    """Agents over all the tasks that they were run on, two or more."""

    tasks: int
    optimality: Mapping[str, tuple[int, Interval]]  # by agent: how many tasks, and the IQM over them
    comparisons: Comparisons  # the mean over the tasks of both
    levels: FloatArray  # of optimality, (points,)
    profiles: Mapping[str, tuple[FloatArray, ...]]  # by agent: share of runs above each level, low and high


@dataclass(frozen=True)
class Reason:
    """Why one run is not certified, in about four words, and the word for the command line to try, if any."""

    cause: str
    change: str = ""


Reasons = Mapping[Path, Reason]  # by the run's folder


@dataclass(frozen=True, eq=False)
class Report:
    """Runs, their analysis, and what should be looked into."""

    study: Study
    tasks: tuple[TaskAnalysis, ...]
    overall: Overall | None
    unusable: tuple[Unusable, ...]
    problems: tuple[str, ...]  # with the paths that were given
    notes: tuple[str, ...]
    seed: int  # of the bootstrap
    tunings: tuple[TuningStudy, ...] = ()
    reasons: Reasons = field(default_factory=dict)  # of runs that are not certified

    @property
    def runs(self) -> list[Evidence]:
        """All that are counted."""
        return [run for _, run in self.study.runs]

    @property
    def damage(self) -> list[str]:
        """A sentence for each damaged file of the runs."""
        counted = [sentence for run in self.runs for sentence in run.damage]
        return [*counted, *(each for run in self.unusable if run.is_damaged for each in run.reasons)]

    def sentences(self) -> list[str]:
        """What somebody should look into."""
        unfinished = [each for run in self.unusable if not run.is_damaged for each in run.reasons]
        return [*self.problems, *self.damage, *unfinished, *self.study.warnings]


def first_ones(sentences: Sequence[str], rest: str = "") -> list[str]:
    """As many sentences as are shown, and how many more there are, which ends with `rest`."""
    count = len(sentences) - _MOST_SHOWN
    return [*sentences[:_MOST_SHOWN], *([f"and {count} more{rest}"] if count > 0 else [])]


def gather(paths: Sequence[Path], seed: int = 0, log_steps: bool = False) -> Report:
    """Read and analyse all runs and tuning studies below the paths.

    `seed` is of the bootstrap. With `log_steps`, all curves are against the logarithm of the steps; those
    of a task on which one agent is ten times slower than another always are.
    Raises `InputError` where no run can be used.
    """
    folders, problems = find_runs(paths)
    outcomes = [read(folder) for folder in folders]
    runs = [outcome for outcome in outcomes if isinstance(outcome, Evidence)]
    unusable = tuple(outcome for outcome in outcomes if isinstance(outcome, Unusable))
    if not runs:
        sentences = [*problems, *(reason for run in unusable for reason in run.reasons)]
        raise InputError(f"nothing to report: {'; '.join(first_ones(sentences))}")
    study = arrange(runs)
    tasks = tuple(_task(task, study, seed, log_steps) for task in study.tasks)
    tunings, unread = find_tunings(paths)
    problems += [f"{task.task}: {task.world.problem}" for task in tasks if task.world.problem] + unread
    own, notes = str(versions()["gridworld"]), []
    for version in sorted({run.version for run in runs} - {own}):
        first, *others = (run.folder for run in runs if run.version == version)
        were = f"{len(others) + 1} runs were" if others else "1 run was"
        where = f"{first}{' and others' if others else ''}"
        notes.append(f"{were} written by gridworld {version}, this is {own}: {where}.")
    overall = _overall(tasks, seed)
    return Report(study, tasks, overall, unusable, tuple(problems), tuple(notes), seed, tuple(tunings))


def _task(task: str, study: Study, seed: int, log_steps: bool) -> TaskAnalysis:
    groups = [group for group in study.groups if group.task == task]
    runs = [run for group in groups for run in group.runs]
    world = _reference(next((run for run in runs if not run.damage), runs[0]))
    ends = [max(run.steps for run in group.runs) for group in groups]
    learned = [float(np.median([run.certified_since_step for run in group.runs])) for group in groups]
    for steps in (ends, learned):  # whether one agent ran, or learned, ten times as long as another
        known = [step for step in steps if 0 < step < math.inf]
        log_steps |= bool(known) and max(known) >= _SLOWER * min(known)
    grid = _grid(runs, log_steps)
    results = tuple(_result(group, world, grid, seed) for group in groups)
    return TaskAnalysis(task, world, results, _compare([results], seed), log_steps)


def _result(group: Group, world: Reference, grid: FloatArray, seed: int) -> Result:
    runs, samples, estimates = group.runs, {}, {}
    end = float(max(run.steps for run in runs))
    grid = np.union1d(grid[grid <= end], [end])
    for metric in METRICS.values():
        values = np.array([metric.of(run, world) for run in runs])
        samples[metric.key] = values = values[~np.isnan(values)]
        for name in metric.statistics if len(values) else ():
            estimates[metric.key, name] = statistics.interval(_STATISTICS[name], [values], seed)
    has_online = all(ONLINE in run.curve and np.isfinite(run.curve[ONLINE]).any() for run in runs)
    return Result(
        group,
        certified=statistics.share(sum(run.certified for run in runs), len(runs)),
        ever=statistics.share(sum(math.isfinite(run.first_certified_step) for run in runs), len(runs)),
        samples=samples,
        estimates=estimates,
        regret=_band(runs, "regret", grid, seed),
        certificates=_certificates(runs, grid),
        online=_band(runs, ONLINE, grid, seed) if has_online else None,
    )


def _compare(results_of_tasks: Sequence[Sequence[Result]], seed: int) -> Comparisons:
    """Compare agents both ways, where there are several tasks on two that both have."""
    tasks = [{each.group.agent: each.samples for each in results} for results in results_of_tasks]
    agents = sorted({agent for task in tasks for agent in task})
    found: dict[tuple[str, str, str], Interval] = {}
    compared = [metric for metric in METRICS.values() if metric.is_compared]
    for metric, (one, other) in itertools.product(compared, itertools.combinations(agents, 2)):
        pairs = [
            (metric.better * task[one][metric.key], metric.better * task[other][metric.key])
            for task in tasks
            if one in task and other in task
        ]
        pairs = [(first, second) for first, second in pairs if len(first) and len(second)]
        if len(pairs) >= min(2, len(tasks)):
            found[metric.key, one, other] = seen = statistics.improvement(pairs, seed)
            found[metric.key, other, one] = Interval(1 - seen.point, 1 - seen.high, 1 - seen.low)
    return found


def _overall(tasks: Sequence[TaskAnalysis], seed: int) -> Overall | None:
    """None where no agent was run on two tasks."""
    scores: dict[str, list[FloatArray]] = defaultdict(list)
    for result in itertools.chain.from_iterable(task.results for task in tasks):
        if len(result.samples["optimality"]):
            scores[result.group.agent].append(result.samples["optimality"])
    strata = {agent: each for agent, each in sorted(scores.items()) if len(each) > 1}
    if not strata:
        return None
    optimality = {
        agent: (len(each), statistics.interval(statistics.iqm, each, seed)) for agent, each in strata.items()
    }
    lowest = min(float(sample.min()) for each in strata.values() for sample in each)
    levels = np.linspace(min(0.0, max(-1.0, lowest)), 1.0, _LEVELS)
    profiles = {agent: statistics.profile(each, levels, seed) for agent, each in strata.items()}
    comparisons = _compare([task.results for task in tasks], seed)
    return Overall(len(tasks), optimality, comparisons, levels, profiles)
