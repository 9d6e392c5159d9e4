"""The tables of a report."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from gridworld.report.analysis import BY_KEY, Comparison, Overall, Result, TaskAnalysis
from gridworld.report.grouping import Study, differing, learning_key
from gridworld.report.reading import Unusable
from gridworld.report.statistics import Share
from gridworld.report.table import Cell, Estimate, Table, number, steps_up_to

_EXTRA = (
    "optimality",
    "value",
    "return",
    "goal_probability",
    "sampled_return",
    "online_return",
    "online_return_end",
)


def results_table(tasks: Sequence[TaskAnalysis]) -> Table:
    """What matters most, for all tasks: also the table for a README."""
    shown = [(key, statistic) for key in ("regret", "steps") for statistic in ("iqm", "median")]
    rows: list[list[Cell]] = [
        [task.task, result.group.agent, result.certified, *(estimate(result, *which) for which in shown)]
        for task in tasks
        for result in task.results
    ]
    columns = ["task", "agent", "seeds certified"]
    columns += ["regret, IQM", "regret, median", "steps to certificate, IQM", "steps to certificate, median"]
    return Table("results", "Certified seeds, exact regret and steps, with 95 % intervals", columns, rows)


def task_table(task: TaskAnalysis) -> Table:
    """Everything about a task; columns that no run has numbers for are left out."""
    columns: list[tuple[str, Callable[[Result], Cell]]] = [
        ("agent", lambda result: result.group.agent),
        ("certified at the end", lambda result: result.certified),
        ("ever certified", lambda result: result.ever),
        *(
            (f"{BY_KEY[key].title}, {_SHORT[s]}", _of(key, s))
            for key in ("regret", "steps")
            for s in ("iqm", "median")
        ),
        *((f"{BY_KEY[key].title}, mean", _of(key, "mean")) for key in _EXTRA if _present(task, key)),
    ]
    rows = [[of(result) for _, of in columns] for result in task.results]
    return Table(task.task, f"Results on {task.task}", [heading for heading, _ in columns], rows)


_SHORT = {"iqm": "IQM", "median": "median"}


def estimate(result: Result, key: str, statistic: str) -> Estimate | None:
    """A statistic of a metric, ready to be told."""
    found = result.estimates.get((key, statistic))
    if found is None:
        return None
    return Estimate(found, steps_up_to(result.shortest_uncertified) if key == "steps" else number)


def _of(key: str, statistic: str) -> Callable[[Result], Cell]:
    return lambda result: estimate(result, key, statistic)


def _present(task: TaskAnalysis, key: str) -> bool:
    return any(len(result.samples[key]) for result in task.results)


def improvement_table(comparisons: Sequence[Comparison], metric: str, name: str) -> Table | None:
    """A row against a column: how probably the row's agent is better. None where nobody is compared."""
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
        f"Probability that a run of the row's agent beats one of the column's in {title}",
        ["agent", *agents],
        rows,
    )


def _two_digits(value: float) -> str:
    return f"{value:.2f}"


def overall_table(overall: Overall) -> Table:
    """One number an agent, over all its tasks."""
    rows: list[list[Cell]] = [
        [agent, f"{count} of {overall.tasks}", Estimate(interval, number)]
        for agent, (count, interval) in overall.optimality.items()
    ]
    return Table("all tasks", "Optimality over tasks", ["agent", "tasks", "optimality, IQM"], rows)


def answer_table(study: Study, tasks: Sequence[TaskAnalysis]) -> Table:
    """Seeds certified at the end, agents down and tasks across."""
    found: dict[tuple[str, str], Share] = {
        (result.group.agent, task.task): result.certified for task in tasks for result in task.results
    }
    rows = [[agent, *(found.get((agent, task)) for task in study.tasks)] for agent in study.agents]
    return Table("certified", "Seeds certified optimal at the end", ["agent", *study.tasks], rows)


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
                    float(run.curve["regret"][-1]),
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


def unusable_table(unusable: Sequence[Unusable]) -> Table:
    """A row for each run that is not."""
    rows: list[list[Cell]] = [[run.agent, run.env, str(run.folder), run.reason] for run in unusable]
    return Table("not counted", "Runs that are not counted", ["agent", "task", "folder", "reason"], rows)


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
