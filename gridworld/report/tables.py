"""The tables of a report, written as Markdown to be read and as CSV to be computed with.

The page writes them as HTML.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

from gridworld.base.console import plain
from gridworld.base.safe_read import csv_text
from gridworld.report.analysis import METRICS, Comparisons, Overall, Report, Result, TaskAnalysis
from gridworld.report.grouping import differing, learning_key
from gridworld.report.statistics import Interval, Share
from gridworld.report.tuning_study import TuningStudy

NOTHING = "\N{EN DASH}"
_MINUS = "\N{MINUS SIGN}"
_SQUARES = "\N{LARGE RED SQUARE}\N{LARGE YELLOW SQUARE}\N{LARGE GREEN SQUARE}"  # for none, some, all
# Signs with which a name out of a run's folder could be HTML, a link, a row, or the end of a marked place.
_MARKS = re.compile(r"""[\\|<>&`\[\]*!\n\r]|:(?=//)|(?<=www)\.""")

_SCORES = tuple(key for key in METRICS if key not in ("regret", "steps", "first"))
_HEADINGS = {
    ("regret", "iqm"): "regret, IQM",
    ("regret", "median"): "regret, median",
    ("steps", "iqm"): "steps until certified for good, IQM",
    ("steps", "median"): "steps until certified for good, median",
    ("first", "median"): "steps until the first certificate, median",
}


@dataclass(frozen=True)
class IntervalCell:
    """An interval with the way its numbers are written."""

    interval: Interval
    form: Callable[[float], str]


Cell = str | float | int | None | Share | IntervalCell


@dataclass(frozen=True)
class Table:
    """A table whose texts are plain: control characters in names of strangers' runs are escaped."""

    name: str  # of its files
    caption: str
    columns: Sequence[str]  # the headings
    rows: Sequence[Sequence[Cell]]  # a cell for each column

    def __post_init__(self) -> None:
        rows = [[plain(cell) if isinstance(cell, str) else cell for cell in row] for row in self.rows]
        object.__setattr__(self, "caption", plain(self.caption))
        object.__setattr__(self, "columns", list(map(plain, self.columns)))
        object.__setattr__(self, "rows", rows)

    def is_text(self, column: int) -> bool:
        """Whether a column holds words, which are aligned to the left; numbers are aligned to the right."""
        return bool(self.rows) and all(isinstance(row[column], str) for row in self.rows)


def number(value: float) -> str:
    """Write a number with four digits, an infinite one as ∞, NaN as a dash."""
    if math.isnan(value):
        return NOTHING
    if math.isinf(value):
        return "∞" if value > 0 else f"{_MINUS}∞"
    if value == 0:
        return "0"
    text = f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}" if abs(value) >= 1e-4 else f"{value:.1e}"
    return text.replace("-", _MINUS)


def steps_up_to(bound: float) -> Callable[[float], str]:
    """How to write a number of steps: an infinite one as more than `bound`, the steps that were given."""
    return lambda value: f"> {bound:,.0f}" if math.isinf(value) else number(round(value))


def texts(cell: Cell) -> tuple[str, str]:
    """A cell's text, and that of its interval, "" where it has none."""
    return _written(cell)[:2]


def _written(cell: Cell) -> tuple[str, str, dict[str, object]]:
    """A cell's two texts, and its numbers in a CSV by the ends of their headings."""
    match cell:
        case Share(count, total, low, high):
            ends = {"": count, " of": total, " low": _digits(low), " high": _digits(high)}
            return f"{count} / {total}", f"[{100 * low:.0f} %, {100 * high:.0f} %]", ends
        case IntervalCell(Interval(point, low, high), form):
            ends = {"": _digits(point), " low": _digits(low), " high": _digits(high)}
            return form(point), "" if math.isnan(low) else f"[{form(low)}, {form(high)}]", ends
        case None:
            return NOTHING, "", {}
        case float():
            return number(cell), "", {"": _digits(cell)}
        case _:
            return f"{cell:,}" if isinstance(cell, int) else cell, "", {"": cell}


def to_captioned_markdown(table: Table) -> str:
    """A Markdown pipe table below its caption."""
    return f"{_markdown(table.caption)}\n\n{to_markdown(table)}"


def to_markdown(table: Table) -> str:
    """A Markdown pipe table; names in it are shown as they are."""
    sides = ("---" if table.is_text(column) else "---:" for column in range(len(table.columns)))
    rows: list[Iterable[str]] = [map(_markdown, table.columns), sides]
    rows += [map(_markdown, row) for row in table.rows]
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)


def to_coloured_markdown(table: Table) -> str:
    """A table of shares of which each begins with a square: green for all, yellow for some, red for none."""

    def coloured(cell: Cell) -> Cell:
        if not isinstance(cell, Share):
            return "" if cell is None else cell
        return f"{_SQUARES[(cell.count > 0) + cell.is_whole]} {texts(cell)[0]}"

    return to_markdown(dataclasses.replace(table, rows=[list(map(coloured, row)) for row in table.rows]))


def _markdown(cell: Cell) -> str:
    if isinstance(cell, str):  # it may be anybody's
        return _MARKS.sub(lambda found: f"&#{ord(found[0])};", cell)
    return " ".join(texts(cell)).strip()


def to_csv(table: Table) -> str:
    """A CSV of plain numbers; an interval takes three columns, a share four."""
    columns: list[list[object]] = []
    for at, heading in enumerate(table.columns):
        parts = [_written(row[at])[2] for row in table.rows]
        ends = dict.fromkeys(end for each in parts for end in each) or [""]
        columns += [[heading + end, *(each.get(end, "") for each in parts)] for end in ends]
    return csv_text(zip(*columns, strict=True))


def _digits(value: float) -> str:
    return "" if math.isnan(value) else f"{value:.10g}"


def all_tables(report: Report) -> Iterator[Table]:
    """Those that are written as files."""
    for table in (results_table, answer_table, steps_table, runs_table, unusable_table):
        yield table(report)
    if report.reasons:
        yield reasons_table(report)
    yield settings_table(report)
    for task in report.tasks:
        yield task_table(task)
        yield scores_table(task)
        yield from improvement_tables(task.comparisons, task.task)
    if report.overall is not None:
        yield overall_table(report.overall)
    for tuning in report.tunings:
        yield from tuning_tables(tuning)


def results_table(report: Report) -> Table:
    """The main results on all tasks; also the table for a README."""
    shown = [("regret", "iqm"), ("steps", "median"), ("first", "median")]
    columns = ["task", "agent", "seeds certified", "ever certified", *(_HEADINGS[which] for which in shown)]
    results, rows = [result for task in report.tasks for result in task.results], list[list[Cell]]()
    for result in results:
        reasons = (report.reasons.get(run.folder) for run in result.group.runs)
        causes = Counter(reason.cause for reason in reasons if reason is not None)
        most = [f"{cause} ({count} of {causes.total()})" for cause, count in causes.most_common(1)]
        rows.append([result.group.task, result.group.agent, result.certified, result.ever])
        rows[-1] += [*(estimate(result, *which) for which in shown), "".join(most)]
    caption = "Certified seeds, exact regret and steps, with 95 % intervals"
    return _table_of(results, "results", caption, [*columns, "why not"], rows)


def task_table(task: TaskAnalysis) -> Table:
    """Certified seeds, regret and steps until certified for good on a task."""
    rows: list[list[Cell]] = [
        [result.group.agent, result.certified, result.ever, *(estimate(result, *each) for each in _HEADINGS)]
        for result in task.results
    ]
    columns = ["agent", "certified at the end", "ever certified", *_HEADINGS.values()]
    return _table_of(task.results, task.task, f"Results on {task.task}", columns, rows)


def scores_table(task: TaskAnalysis) -> Table:
    """Means over seeds of the other metrics that the runs have."""
    rows: list[list[Cell]] = [
        [result.group.agent, *(estimate(result, key, "mean") for key in _SCORES)] for result in task.results
    ]
    caption = f"Means over seeds on {task.task}, of the greedy policy unless stated otherwise"
    columns = ["agent", *(METRICS[key].title for key in _SCORES)]
    return _table_of(task.results, f"{task.task} scores", caption, columns, rows)


def _table_of(
    results: Sequence[Result], name: str, caption: str, columns: list[str], rows: list[list[Cell]]
) -> Table:
    """A table with a row for each result, with privileges and scope; an empty column is left out."""
    columns = [*columns, "privileges", "the world is known"]
    for row, result in zip(rows, results, strict=True):
        row += [result.group.privileges, result.group.scope]
    shown = [at for at in range(len(columns)) if any(row[at] not in (None, "") for row in rows)]
    return Table(name, caption, [columns[at] for at in shown], [[row[at] for at in shown] for row in rows])


def estimate(result: Result, key: str, statistic: str) -> IntervalCell | None:
    """A statistic of a metric as a cell; None where no run has the metric."""
    found = result.estimates.get((key, statistic))
    given = min((run.steps for run in result.group.runs if not run.certified), default=0)
    form = steps_up_to(given) if key in ("steps", "first") else number
    return None if found is None else IntervalCell(found, form)


def improvement_tables(comparisons: Comparisons, name: str) -> Iterator[Table]:
    """The probabilities that the row's agent is better than the column's on the task, by metric."""
    for key in dict.fromkeys(key for key, _, _ in comparisons):
        title, agents = METRICS[key].title, sorted({one for other, one, _ in comparisons if other == key})
        found = {pair: IntervalCell(each, "{:.2f}".format) for pair, each in comparisons.items()}
        rows: list[list[Cell]] = [[one, *(found.get((key, one, each)) for each in agents)] for one in agents]
        caption = f"Probability that a run of the row's agent beats one of the column's in {title}"
        yield Table(f"{name} improvement in {title}", caption, ["agent", *agents], rows)


def overall_table(overall: Overall) -> Table:
    """One number an agent, over all its tasks."""
    rows: list[list[Cell]] = [
        [agent, f"{count} of {overall.tasks}", IntervalCell(interval, number)]
        for agent, (count, interval) in overall.optimality.items()
    ]
    return Table("all tasks", "Optimality over tasks", ["agent", "tasks", "optimality, IQM"], rows)


def answer_table(report: Report) -> Table:
    """Seeds certified at the end, agents down and tasks across."""
    return _grid("certified", "Seeds certified optimal at the end", report, lambda result: result.certified)


def steps_table(report: Report) -> Table:
    """The median steps until certified for good, agents down and tasks across."""
    caption = "Steps until certified for good, median"
    return _grid("steps", caption, report, lambda result: result.estimates["steps", "median"].point)


def _grid(name: str, caption: str, report: Report, of: Callable[[Result], Cell]) -> Table:
    cells = {(each.group.agent, task.task): of(each) for task in report.tasks for each in task.results}
    agents, tasks = report.study.agents, report.study.tasks
    rows = [[agent, *(cells.get((agent, task)) for task in tasks)] for agent in agents]
    return Table(name, caption, ["agent", *tasks], rows)


def runs_table(report: Report) -> Table:
    """A row for each run that is counted."""
    rows: list[list[Cell]] = []
    for group, run in report.study.runs:
        certified = "yes" if run.certified else "no"
        steps = run.certified_since_step, run.first_certified_step
        rows.append([group.task, group.agent, run.recipe or NOTHING, run.seed, certified, run.regret])
        rows[-1] += [run.proven_regret, *(int(step) if math.isfinite(step) else None for step in steps)]
        rows[-1] += [run.steps, run.seconds, str(run.folder)]
    columns = ["task", "agent", "recipe", "seed", "certified", "regret", "proven regret", "certified since"]
    columns += ["first certificate", "steps", "seconds"]
    return Table("runs", "All runs that are counted", [*columns, "folder"], rows)


def reasons_table(report: Report) -> Table:
    """A row for each run whose reason is known."""
    rows: list[list[Cell]] = [
        [group.agent, group.task, run.seed, run.regret, reason.cause, reason.change]
        for group, run in report.study.runs
        if (reason := report.reasons.get(run.folder)) is not None
    ]
    missing = sum(not run.certified for run in report.runs) - len(rows)
    rest = f"; {missing} more were not diagnosed, see --diagnose" if missing else ""
    columns = ["agent", "task", "seed", "regret", "largest cause", "to try"]
    return Table("not certified", f"Why runs are not certified{rest}", columns, rows)


def unusable_table(report: Report) -> Table:
    """A row for each run that is not counted."""
    rows = [[run.agent or NOTHING, run.env or NOTHING, "; ".join(run.reasons)] for run in report.unusable]
    return Table("not counted", "Runs that are not counted", ["agent", "task", "reason"], rows)


def settings_table(report: Report) -> Table:
    """Settings in which the groups differ."""
    groups = report.study.groups
    settings = [dict(learning_key(group.runs[0])) for group in groups]
    rows = [[name, *(each.get(name, "") for each in settings)] for name in differing(settings)]
    columns = ["setting", *(f"{group.agent} on {group.task}" for group in groups)]
    return Table("settings", "Settings in which agents differ", columns, rows)


def tuning_tables(tuning: TuningStudy) -> tuple[Table, Table, Table]:
    """What a search changed and how much each key mattered, the finalists, and every trial."""
    changed: list[list[Cell]] = [
        [key, str(value), str(tuning.began_from.get(key, "")), tuning.importances.get(key)]
        for key, value in tuning.values.items()
    ]
    columns = ["certified", "steps", "regret", "seconds", "error", *tuning.space]
    trials: list[list[Cell]] = [
        [
            str(trial.number),
            trial.status,
            trial.score if math.isfinite(trial.score) else None,
            *(trial.row.get(column, "") for column in columns),
        ]
        for trial in tuning.trials
    ]
    caption = f"The winner, trial {tuning.winner}, and the baseline"
    finalists = "The finalists, over all of their seeds"
    return (
        Table(f"{tuning.name} winner", caption, ["key", "winner", "baseline", "importance"], changed),
        Table(f"{tuning.name} finalists", finalists, ["trial", "score", "certified"], tuning.finalists),
        Table(f"{tuning.name} trials", "All trials", ["trial", "status", "score", *columns], trials),
    )
