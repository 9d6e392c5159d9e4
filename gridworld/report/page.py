"""The report as one HTML page without scripts, network, or files beside it."""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import jinja2
from markupsafe import Markup, escape

from gridworld.process.console.terminal import plain
from gridworld.report import tables
from gridworld.report.analysis.analyse import Result, TaskAnalysis
from gridworld.report.analysis.statistics import RESAMPLES, Share
from gridworld.report.build import Report
from gridworld.report.charts.agent_charts import overall_charts, task_charts
from gridworld.report.charts.chart import AGENT_PAINTS, DARK, LIGHT, Chart, Styles, styles
from gridworld.report.charts.tuning_charts import tuning_charts
from gridworld.report.embedded_images import pictures
from gridworld.report.evidence.grouping import shortfall
from gridworld.report.evidence.tuning_study import TuningStudy
from gridworld.report.table import Cell, interval_text, is_text, main_text, number
from gridworld.report.tuning_tables import finalists_table, trials_table, winner_table

_ALL_TASKS = ""  # no task's name
_FEW = 6  # agents; of more, what is long is folded away
_MOST_TOLD = 4  # agents, each by name in the opening


def charts(report: Report) -> dict[str, list[Chart]]:
    """The figures by task, in the agents' colours, those of tuning studies by title, and over tasks."""
    look = _look(report)
    drawn = {task.task: _noted(task_charts(task, look), task.shortfall) for task in report.tasks}
    drawn |= {tuning.title: list(tuning_charts(tuning)) for tuning in report.tunings}
    overall = overall_charts(report.overall, look) if report.overall else ()
    return drawn | {_ALL_TASKS: _noted(overall, shortfall(report.study.groups))}


def _noted(drawn: Iterable[Chart], shortfall: str) -> list[Chart]:
    return [replace(chart, description=chart.description + shortfall) for chart in drawn]


def _look(report: Report) -> Styles:
    """A style for each agent; where they are more than the colours, the best ones come first."""
    agents = list(report.study.agents)
    if len(agents) > AGENT_PAINTS:
        best = [result.group.agent for task in report.tasks for result in task.ranked[:AGENT_PAINTS]]
        agents = list(dict.fromkeys([*sorted(set(best)), *agents]))
    return styles(agents)


@functools.cache
def template() -> jinja2.Template:
    """The page's, compiled once."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("gridworld.report", "."),
        autoescape=True,  # a run's folder is data: names in it may hold anything
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("page.html.j2")


def render(report: Report, drawn: dict[str, list[Chart]]) -> str:
    """The page's HTML.

    Args:
        report: what it shows.
        drawn: the figures, from `charts`.
    """
    look = _look(report)
    headline = _headline(report)
    return template().render(
        title=f"{headline or _names(report)}, gridworld",
        headline=headline or "Which agent solves which task",
        lead=_lead(report),
        answers=[
            *(
                tuning.sentence if headline else f"{tuning.title}. {tuning.sentence}"
                for tuning in report.tunings
            ),
            *map(_answer, report.tasks),
        ],
        answer=tables.answer_table(report.study, report.tasks),
        few=_FEW,
        kinds="agents" if len(_agents(report)) == len(report.study.agents) else "configurations",
        problems=list(map(plain, [*report.problems, *report.damage])),
        warnings=list(map(plain, report.study.warnings)),
        notes=list(map(plain, [*report.study.notes, *report.notes])),
        tunings=[_tuning(tuning, drawn[tuning.title], headline) for tuning in report.tunings],
        tasks=[_task(task, drawn[task.task], look) for task in report.tasks],
        overall=tables.overall_table(report.overall, report.study.groups) if report.overall else None,
        overall_figures=_figures(drawn[_ALL_TASKS]),
        overall_improvements=tables.improvement_tables(
            report.overall.comparisons, "all tasks", report.study.groups
        )
        if report.overall
        else [],
        unusable=tables.unusable_table(report.unusable),
        reasons=tables.reasons_table(report.study, report.reasons),
        runs=tables.runs_table(report.study),
        settings=tables.settings_table(report.study),
        resamples=f"{RESAMPLES:,}",
        provenance=_provenance(report),
        light=LIGHT,
        dark=DARK,
        styles=look,
        main_text=main_text,
        interval_text=interval_text,
        share_of=_share_of,
        is_text=is_text,
        breakable=_breakable,
    )


def _breakable(heading: str) -> Markup:
    """A column's heading that may go on in the next line after "_" and "=", as labels are long."""
    return Markup(re.sub(r"(?<=[_=])", "<wbr>", str(escape(heading))))


def _task(task: TaskAnalysis, drawn: Sequence[Chart], look: Styles) -> dict[str, Any]:
    run = task.results[0].group.runs[0]
    return {
        "title": task.task,
        "facts": _facts(task),
        "figures": _figures(drawn),
        "tables": [tables.task_table(task), tables.scores_table(task)],
        "improvements": tables.improvement_tables(task.comparisons, task.task, task.groups),
        "pictures": [found for result in task.ranked if (found := list(pictures(result)))],
        "layout": run.layout,
    }


def _tuning(tuning: TuningStudy, drawn: Sequence[Chart], headline: str) -> dict[str, Any]:
    return {
        "title": "The search" if tuning.title == headline else tuning.title,
        "facts": [
            f"Study {tuning.name}, {tuning.counts}.",
            *([_MEDIANS] if "median" in tuning.sentence else []),
        ],
        "figures": _figures(chart for chart in drawn if not chart.is_wide),
        "wide": _figures(chart for chart in drawn if chart.is_wide),
        "tables": [winner_table(tuning), finalists_table(tuning)],
        "trials": trials_table(tuning),
    }


_MEDIANS = (
    "The sentence above has two medians, of the winner's held-out runs and of those with the settings that "
    "the search began from: from that step on, half of the runs were certified for good, to the end. The "
    "tasks below tell the step of the first certificate, which a run may lose again, so it can be earlier."
)


def _figures(drawn: Iterable[Chart]) -> list[tuple[Markup, str]]:
    """Each as its element and its caption."""
    return [(Markup(chart.svg_element()), chart.caption) for chart in drawn]


def _headline(report: Report) -> str:
    """Of a page about one tuning study; "" for any other."""
    folders = [run.folder.absolute() for group in report.study.groups for run in group.runs]
    for tuning in report.tunings:
        if all(folder.is_relative_to(tuning.folder.absolute()) for folder in folders):
            return tuning.title
    return ""


def _names(report: Report) -> str:
    """The agents and the tasks, where that is short."""
    agents, tasks = report.study.agents, report.study.tasks
    told = [
        ", ".join(names) if len(names) <= _MOST_TOLD else f"{len(names)} {what}"
        for names, what in ((agents, "agents"), (tasks, "tasks"))
    ]
    return plain(" on ".join(told))[:120]


def _facts(task: TaskAnalysis) -> list[str]:
    run, world = task.results[0].group.runs[0], task.world
    told = [f"Optimum: value {number(world.optimal_value)} at a discount of {run.gamma:g}"]
    if math.isfinite(world.random_value):
        told[0] += f", return {number(world.optimal_return)}"
        told.append(
            f"Uniformly random policy: value {number(world.random_value)}, "
            f"return {number(world.random_return)}"
        )
    names: Sequence[str] = ("slip", "step_reward", "goal_reward", "trap_reward", "max_episode_steps")
    if "env.source" in run.settings:
        names = sorted(name.removeprefix("env.") for name in run.settings if name.startswith("env."))
    settings = ((name.replace("_", " "), run.settings.get(f"env.{name}")) for name in names)
    shown = [f"{name} {value}" for name, value in settings if value not in (None, "null", "{}")]
    if run.settings.get("env.max_episode_steps") in (None, "null"):
        shown.append(f"max episode steps {run.step_limit}")
    told.append("World: " + ", ".join(shown))
    return [f"{sentence}." for sentence in told]


def _lead(report: Report) -> str:
    runs = sum(len(group.runs) for group in report.study.groups)
    counts = (
        (runs, "run"),
        (len(agents := _agents(report)), "agent"),
        *([(count, "configuration")] if (count := len(report.study.agents)) > len(agents) else []),
        (len(report.study.tasks), "task"),
    )
    return ", ".join(f"{count} {name}{'s' if count > 1 else ''}" for count, name in counts) + _days(report)


def _agents(report: Report) -> set[str]:
    """The agents' own names, whatever settings they were run with."""
    return {run.agent for group in report.study.groups for run in group.runs}


def _days(report: Report) -> str:
    days = sorted({run.started for group in report.study.groups for run in group.runs if run.started})
    return "" if not days else f", {days[0]}" if len(days) == 1 else f", {days[0]} to {days[-1]}"


def _answer(task: TaskAnalysis) -> str:
    ranked = task.ranked
    told = [_verdict(result) for result in ranked] if len(ranked) <= _MOST_TOLD else _verdicts(ranked)
    return f"On {task.task}, {'; '.join(told)}{task.shortfall}."


def _verdicts(ranked: Sequence[Result]) -> list[str]:
    """The best of many agents, and how many others are certified."""
    whole = sum(result.certified.count == result.certified.total for result in ranked)
    none = sum(result.certified.count == 0 for result in ranked)
    names = {result.group.runs[0].agent for result in ranked}
    what = f"configurations of {names.pop()}" if len(names) == 1 else "agents"
    counts = [f"{whole} of {len(ranked)} {what} are certified optimal on all of their seeds"]
    return [*counts, *([f"{none} on none"] if none else []), f"best of all: {_verdict(ranked[0])}"]


def _verdict(result: Result) -> str:
    share, agent = result.certified, result.group.agent
    if share.count == 0:
        regret = number(result.estimates["regret", "iqm"].point)
        return f"{agent} is certified on none of {share.total} seeds (IQM of the regret {regret})"
    seeds = (
        f"all {share.total} seeds" if share.count == share.total else f"{share.count} of {share.total} seeds"
    )
    if share.total == 1:
        seeds = "its one seed"
    if result.ever.count > share.count:  # a certificate can be lost again
        return f"{agent} ends certified optimal on {seeds}, and was so at some time on {result.ever.count}"
    return f"{agent} is certified optimal on {seeds}{_after(result)}"


def _after(result: Result) -> str:
    cell = tables.estimate(result, "steps", "median")
    if cell is None or math.isinf(cell.interval.point):
        return ""
    return f", by step {main_text(cell)}" + (" in the median" if len(result.group.runs) > 1 else "")


def _provenance(report: Report) -> str:
    versions = sorted({run.version for group in report.study.groups for run in group.runs})
    return f"The runs were written by gridworld {', '.join(versions)}. Bootstrap seed {report.seed}."


def _share_of(cell: Cell) -> float | None:
    return round(100 * cell.count / cell.total, 1) if isinstance(cell, Share) else None
