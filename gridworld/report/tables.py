"""The tables of a report."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from gridworld.report.analysis.analyse import Comparison, Overall, Result, TaskAnalysis
from gridworld.report.analysis.metrics import BY_KEY, METRICS
from gridworld.report.analysis.statistics import Share
from gridworld.report.evidence.grouping import Group, Study, differing, learning_key, shortfall
from gridworld.report.evidence.reasons import Reasons, most_common
from gridworld.report.evidence.run_reader import Unusable
from gridworld.report.table import NOTHING, Cell, Estimate, Table, number, steps_up_to

_SCORES = tuple(metric.key for metric in METRICS if metric.key not in ("regret", "steps"))


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
            *([most_common(result.group, reasons)] if reasons else []),
        ]
        for task in tasks
        for result in task.results
    ]
    columns = ["task", "agent", "seeds certified", "ever certified", *(_heading(*which) for which in shown)]
    columns += ["why not"] if reasons else []
    caption = "Certified seeds, exact regret and steps, with 95 % intervals"
    return _counting([group for task in tasks for group in task.groups], "results", caption, columns, rows)


def _counting(
    groups: Sequence[Group], name: str, caption: str, columns: list[str], rows: list[list[Cell]]
) -> Table:
    """A table with a row for each group, and what any of them asks for: its privileges, the runs counted."""
    if any(group.privileges for group in groups):
        columns = [*columns, "privileges"]
        rows = [[*row, group.privileges] for row, group in zip(rows, groups, strict=True)]
    if short := shortfall(groups):
        columns = [*columns, "counted"]
        rows = [[*row, group.shortfall or "all"] for row, group in zip(rows, groups, strict=True)]
    return Table(name, caption + short, columns, rows)


def task_table(task: TaskAnalysis) -> Table:
    """Certified seeds, regret and steps to the certificate on a task."""
    shown = [(key, statistic) for key in ("regret", "steps") for statistic in ("iqm", "median")]
    columns = ["agent", "certified at the end", "ever certified", *(_heading(*which) for which in shown)]
    rows: list[list[Cell]] = [
        [result.group.agent, result.certified, result.ever, *(estimate(result, *which) for which in shown)]
        for result in task.results
    ]
    return _counting(task.groups, task.task, f"Results on {task.task}", columns, rows)


def scores_table(task: TaskAnalysis) -> Table:
    """Means over seeds of the other metrics that the runs have."""
    keys = [key for key in _SCORES if any(len(result.samples[key]) for result in task.results)]
    rows: list[list[Cell]] = [
        [result.group.agent, *(estimate(result, key, "mean") for key in keys)] for result in task.results
    ]
    return _counting(
        task.groups,
        f"{task.task} scores",
        f"Means over seeds on {task.task}, of the greedy policy where nothing else is said",
        ["agent", *(BY_KEY[key].title for key in keys)],
        rows,
    )


def _heading(key: str, statistic: str) -> str:
    return f"{_HEADINGS[key]}, {_SHORT[statistic]}"


_HEADINGS = {"regret": "regret", "steps": "steps to certificate"}
_SHORT = {"iqm": "IQM", "median": "median"}


def estimate(result: Result, key: str, statistic: str) -> Estimate | None:
    """A statistic of a metric as a cell; None where no run has the metric."""
    found = result.estimates.get((key, statistic))
    if found is None:
        return None
    return Estimate(found, steps_up_to(result.shortest_uncertified) if key == "steps" else number)


def improvement_table(
    comparisons: Sequence[Comparison], metric: str, name: str, groups: Iterable[Group]
) -> Table | None:
    """Probabilities that the row's agent is better than the column's; None where none are compared."""
    cells = {
        (c.agent, c.other): Estimate(c.probability, _two_digits) for c in comparisons if c.metric == metric
    }
    if not cells:
        return None
    agents = sorted({agent for agent, _ in cells})
    rows = [[agent, *(cells.get((agent, other)) for other in agents)] for agent in agents]
    title = BY_KEY[metric].title
    return Table(
        f"{name} improvement in {title}",
        f"Probability that a run of the row's agent beats one of the column's in {title}{shortfall(groups)}",
        ["agent", *agents],
        rows,
    )


def improvement_tables(comparisons: Sequence[Comparison], name: str, groups: Sequence[Group]) -> list[Table]:
    """The probabilities of improvement on the task `name`, a table for each metric that is compared."""
    found = (improvement_table(comparisons, metric.key, name, groups) for metric in METRICS)
    return [table for table in found if table is not None]


def _two_digits(value: float) -> str:
    return f"{value:.2f}"


def overall_table(overall: Overall, groups: Iterable[Group]) -> Table:
    """One number an agent, over all its tasks."""
    rows: list[list[Cell]] = [
        [agent, f"{count} of {overall.tasks}", Estimate(interval, number)]
        for agent, (count, interval) in overall.optimality.items()
    ]
    caption = f"Optimality over tasks{shortfall(groups)}"
    return Table("all tasks", caption, ["agent", "tasks", "optimality, IQM"], rows)


def answer_table(study: Study, tasks: Sequence[TaskAnalysis]) -> Table:
    """Seeds certified at the end, agents down and tasks across."""
    found: dict[tuple[str, str], Share] = {
        (result.group.agent, task.task): result.certified for task in tasks for result in task.results
    }
    rows = [[agent, *(found.get((agent, task)) for task in study.tasks)] for agent in study.agents]
    caption = f"Seeds certified optimal at the end{shortfall(study.groups)}"
    return Table("certified", caption, ["agent", *study.tasks], rows)


def runs_table(study: Study) -> Table:
    """A row for each run that is counted."""
    rows: list[list[Cell]] = []
    for group in study.groups:
        for run in group.runs:
            first = run.first_certified_step
            rows.append(
                [
                    group.task,
                    group.agent,
                    run.seed,
                    "yes" if run.certified else "no",
                    run.regret,
                    int(first) if math.isfinite(first) else None,
                    run.steps,
                    run.seconds,
                    str(run.folder),
                ]
            )
    columns = [
        "task",
        "agent",
        "seed",
        "certified",
        "regret",
        "first certificate",
        "steps",
        "seconds",
        "folder",
    ]
    return Table("runs", "Every run that is counted", columns, rows)


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
    """A row for each run that is not."""
    rows: list[list[Cell]] = [
        [run.agent or NOTHING, run.env or NOTHING, "; ".join(run.reasons)] for run in unusable
    ]
    return Table("not counted", "Runs that are not counted", ["agent", "task", "reason"], rows)


def settings_table(study: Study) -> Table:
    """Settings in which the groups differ."""
    settings = [dict(learning_key(group.runs[0])) for group in study.groups]
    names = differing(settings)
    rows: list[list[Cell]] = [[name, *(each.get(name, "") for each in settings)] for name in names]
    return Table(
        "settings",
        "Settings in which agents differ",
        ["setting", *(f"{group.agent} on {group.task}" for group in study.groups)],
        rows,
    )
