"""The tables of a report."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence

from gridworld.report.analysis import BY_KEY, METRICS, Comparison, Overall, Result, TaskAnalysis
from gridworld.report.build import Reasons, Report
from gridworld.report.evidence import Unusable
from gridworld.report.grouping import Group, Study, differing, learning_key
from gridworld.report.table import NOTHING, Cell, Estimate, Table, number, steps_up_to
from gridworld.report.tuning_study import TuningStudy

_SCORES = tuple(metric.key for metric in METRICS if metric.key not in ("regret", "steps"))
_HEADINGS = {
    ("regret", "iqm"): "regret, IQM",
    ("regret", "median"): "regret, median",
    ("steps", "iqm"): "steps to certificate, IQM",
    ("steps", "median"): "steps to certificate, median",
}


def all_tables(report: Report) -> Iterator[Table]:
    """Those that are written as files."""
    study = report.study
    yield results_table(report.tasks, report.reasons)
    yield answer_table(study, report.tasks)
    yield runs_table(study)
    yield unusable_table(report.unusable)
    if report.reasons:
        yield reasons_table(study, report.reasons)
    yield settings_table(study)
    for task in report.tasks:
        yield task_table(task)
        yield scores_table(task)
        yield from improvement_tables(task.comparisons, task.task)
    if report.overall is not None:
        yield overall_table(report.overall)
    for tuning in report.tunings:
        yield winner_table(tuning)
        yield finalists_table(tuning)
        yield trials_table(tuning)


def results_table(tasks: Sequence[TaskAnalysis], reasons: Reasons) -> Table:
    """The main results on all tasks; also the table for a README. `reasons` are of runs not certified."""
    shown = [("regret", "iqm"), ("steps", "median")]
    rows: list[list[Cell]] = [
        [
            task.task,
            result.group.agent,
            result.certified,
            result.ever,
            *(estimate(result, *which) for which in shown),
            *([_most_common(result.group, reasons)] if reasons else []),
        ]
        for task in tasks
        for result in task.results
    ]
    columns = ["task", "agent", "seeds certified", "ever certified", *(_HEADINGS[which] for which in shown)]
    columns += ["why not"] if reasons else []
    caption = "Certified seeds, exact regret and steps, with 95 % intervals"
    results = [result for task in tasks for result in task.results]
    return _with_privileges(results, Table("results", caption, columns, rows))


def _most_common(group: Group, reasons: Reasons) -> str:
    """The most common cause of a group's runs that are not certified, with its count; "" without any."""
    causes = Counter(reasons[run.folder].cause for run in group.runs if run.folder in reasons)
    return "".join(f"{cause} ({count} of {causes.total()})" for cause, count in causes.most_common(1))


def _with_privileges(results: Iterable[Result], table: Table) -> Table:
    """The table, with a row for each result, and a column of their privileges where any has some."""
    privileges = [result.group.privileges for result in results]
    if not any(privileges):
        return table
    rows = [[*row, each] for row, each in zip(table.rows, privileges, strict=True)]
    return Table(table.name, table.caption, [*table.columns, "privileges"], rows)


def task_table(task: TaskAnalysis) -> Table:
    """Certified seeds, regret and steps to the certificate on a task."""
    rows: list[list[Cell]] = [
        [result.group.agent, result.certified, result.ever, *(estimate(result, *each) for each in _HEADINGS)]
        for result in task.results
    ]
    columns = ["agent", "certified at the end", "ever certified", *_HEADINGS.values()]
    return _with_privileges(task.results, Table(task.task, f"Results on {task.task}", columns, rows))


def scores_table(task: TaskAnalysis) -> Table:
    """Means over seeds of the other metrics that the runs have."""
    keys = [key for key in _SCORES if any(len(result.samples[key]) for result in task.results)]
    rows: list[list[Cell]] = [
        [result.group.agent, *(estimate(result, key, "mean") for key in keys)] for result in task.results
    ]
    caption = f"Means over seeds on {task.task}, of the greedy policy where nothing else is said"
    columns = ["agent", *(BY_KEY[key].title for key in keys)]
    return _with_privileges(task.results, Table(f"{task.task} scores", caption, columns, rows))


def estimate(result: Result, key: str, statistic: str) -> Estimate | None:
    """A statistic of a metric as a cell; None where no run has the metric."""
    found = result.estimates.get((key, statistic))
    if found is None:
        return None
    return Estimate(found, steps_up_to(result.shortest_uncertified) if key == "steps" else number)


def improvement_tables(comparisons: Sequence[Comparison], name: str) -> list[Table]:
    """The probabilities that the row's agent is better than the column's on the task, by metric."""
    tables = []
    for metric in METRICS:
        cells = {
            (each.agent, each.other): Estimate(each.probability, lambda value: f"{value:.2f}")
            for each in comparisons
            if each.metric == metric.key
        }
        agents = sorted({agent for agent, _ in cells})
        caption = f"Probability that a run of the row's agent beats one of the column's in {metric.title}"
        rows = [[agent, *(cells.get((agent, other)) for other in agents)] for agent in agents]
        if cells:
            tables.append(Table(f"{name} improvement in {metric.title}", caption, ["agent", *agents], rows))
    return tables


def overall_table(overall: Overall) -> Table:
    """One number an agent, over all its tasks."""
    rows: list[list[Cell]] = [
        [agent, f"{count} of {overall.tasks}", Estimate(interval, number)]
        for agent, (count, interval) in overall.optimality.items()
    ]
    return Table("all tasks", "Optimality over tasks", ["agent", "tasks", "optimality, IQM"], rows)


def answer_table(study: Study, tasks: Sequence[TaskAnalysis]) -> Table:
    """Seeds certified at the end, agents down and tasks across."""
    found = {(result.group.agent, task.task): result.certified for task in tasks for result in task.results}
    rows = [[agent, *(found.get((agent, task)) for task in study.tasks)] for agent in study.agents]
    return Table("certified", "Seeds certified optimal at the end", ["agent", *study.tasks], rows)


def runs_table(study: Study) -> Table:
    """A row for each run that is counted."""
    rows: list[list[Cell]] = [
        [
            group.task,
            group.agent,
            run.seed,
            "yes" if run.certified else "no",
            run.regret,
            int(run.first_certified_step) if math.isfinite(run.first_certified_step) else None,
            run.steps,
            run.seconds,
            str(run.folder),
        ]
        for group in study.groups
        for run in group.runs
    ]
    columns = ["task", "agent", "seed", "certified", "regret", "first certificate", "steps", "seconds"]
    return Table("runs", "Every run that is counted", [*columns, "folder"], rows)


def reasons_table(study: Study, reasons: Reasons) -> Table:
    """A row for each run whose reason is known."""
    rows: list[list[Cell]] = [
        [group.agent, group.task, run.seed, run.regret, reason.cause, reason.change]
        for group in study.groups
        for run in group.runs
        if (reason := reasons.get(run.folder)) is not None
    ]
    missing = sum(not run.certified for group in study.groups for run in group.runs) - len(rows)
    rest = f"; {missing} more were not looked into, see --diagnose" if missing else ""
    columns = ["agent", "task", "seed", "regret", "largest cause", "to try"]
    return Table("not certified", f"Why runs are not certified{rest}", columns, rows)


def unusable_table(unusable: Sequence[Unusable]) -> Table:
    """A row for each run that is not counted."""
    rows = [[run.agent or NOTHING, run.env or NOTHING, "; ".join(run.reasons)] for run in unusable]
    return Table("not counted", "Runs that are not counted", ["agent", "task", "reason"], rows)


def settings_table(study: Study) -> Table:
    """Settings in which the groups differ."""
    settings = [dict(learning_key(group.runs[0])) for group in study.groups]
    rows = [[name, *(each.get(name, "") for each in settings)] for name in differing(settings)]
    columns = ["setting", *(f"{group.agent} on {group.task}" for group in study.groups)]
    return Table("settings", "Settings in which agents differ", columns, rows)


def winner_table(tuning: TuningStudy) -> Table:
    """What a search changed, and how much each key mattered."""
    rows: list[list[Cell]] = [
        [key, str(value), str(tuning.began_from.get(key, "")), tuning.importances.get(key)]
        for key, value in tuning.values.items()
    ]
    caption = f"The winner, trial {tuning.winner}, beside what the search began from"
    return Table(f"{tuning.name} winner", caption, ["key", "winner", "began from", "importance"], rows)


def finalists_table(tuning: TuningStudy) -> Table:
    """The trials that went on to more seeds."""
    caption = "The finalists, by all of their seeds"
    return Table(f"{tuning.name} finalists", caption, ["trial", "score", "certified"], tuning.finalists)


def trials_table(tuning: TuningStudy) -> Table:
    """Every trial."""
    columns = ("certified", "steps", "regret", "seconds", "error")
    rows: list[list[Cell]] = [
        [
            str(trial.number),
            trial.status,
            trial.score if math.isfinite(trial.score) else None,
            *(trial.told.get(column, "") for column in columns),
            *(trial.values.get(key, "") for key in tuning.space),
        ]
        for trial in tuning.trials
    ]
    heads = ["trial", "status", "score", *columns, *tuning.space]
    return Table(f"{tuning.name} trials", "All trials", heads, rows)
