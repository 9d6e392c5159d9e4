"""The report as one HTML page without scripts, network, or files beside it."""

from __future__ import annotations

import base64
import functools
import io
import math
import re
import struct
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import jinja2
from markupsafe import Markup, escape
from PIL import Image

from gridworld.config.pictures import PICTURES
from gridworld.process.console.terminal import plain
from gridworld.report import tables
from gridworld.report.analysis.analyse import Result, TaskAnalysis
from gridworld.report.analysis.statistics import RESAMPLES, Share
from gridworld.report.build import Report
from gridworld.report.charts.agent_charts import overall_charts, task_charts
from gridworld.report.charts.chart import AGENT_PAINTS, DARK, LIGHT, Chart, Styles, styles
from gridworld.report.charts.tuning_charts import tuning_charts
from gridworld.report.evidence.grouping import shortfall
from gridworld.report.table import Cell, interval_text, is_text, main_text, number
from gridworld.storage.safe_read import read_bytes, sha256

_ALL_TASKS = ""  # no task's name
_FEW = 6  # agents; of more, what is long is folded away
_MOST_TOLD = 4  # agents, each by name in the opening
_LARGEST = {".png": 4 * 2**20, ".gif": 256 * 2**10}  # bytes; an animation stands in the page as it is
_MOST_PIXELS = 4_000_000
_WIDTH = 960  # pixels, where it is shown large


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
    study = report.study
    runs = [run for group in study.groups for run in group.runs]
    folders = [run.folder.absolute() for run in runs]
    agents = {run.agent for run in runs}  # their own names, whatever settings they were run with
    headline = next(  # of a page about one tuning study
        (
            tuning.title
            for tuning in report.tunings
            if all(folder.is_relative_to(tuning.folder.absolute()) for folder in folders)
        ),
        "",
    )
    names = " on ".join(
        ", ".join(names) if len(names) <= _MOST_TOLD else f"{len(names)} {what}"
        for names, what in ((study.agents, "agents"), (study.tasks, "tasks"))
    )
    days = sorted({run.started for run in runs if run.started})
    counts = {"run": len(runs), "agent": len(agents), "configuration": len(study.agents)}
    if len(study.agents) == len(agents):
        del counts["configuration"]
    counts["task"] = len(study.tasks)
    return template().render(
        report=report,
        study=study,
        headline=headline,
        names=plain(names)[:120],
        counts=counts,
        days=list(dict.fromkeys([*days[:1], *days[-1:]])),
        problems=[*report.problems, *report.damage],
        answers=list(map(_answer, report.tasks)),
        kinds="agents" if len(agents) == len(study.agents) else "configurations",
        versions=sorted({run.version for run in runs}),
        drawn=drawn,
        overall_figures=drawn[_ALL_TASKS],
        resamples=f"{RESAMPLES:,}",
        few=_FEW,
        light=LIGHT,
        dark=DARK,
        styles=_look(report),
        tables=tables,
        facts=_facts,
        galleries=_galleries,
        plain=plain,
        markup=Markup,
        main_text=main_text,
        interval_text=interval_text,
        share_of=_share_of,
        is_text=is_text,
        breakable=_breakable,
    )


def _breakable(heading: str) -> Markup:
    """A column's heading that may go on in the next line after "_" and "=", as labels are long."""
    return Markup(re.sub(r"(?<=[_=])", "<wbr>", str(escape(heading))))


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


def _answer(task: TaskAnalysis) -> str:
    """How each agent did on a task; of many, the best one, and how many others are certified."""
    ranked = task.ranked
    told = list(map(_verdict, ranked[:_MOST_TOLD]))
    if len(ranked) > _MOST_TOLD:
        whole = sum(result.certified.count == result.certified.total for result in ranked)
        none = sum(result.certified.count == 0 for result in ranked)
        names = {result.group.runs[0].agent for result in ranked}
        what = f"configurations of {names.pop()}" if len(names) == 1 else "agents"
        told = [
            f"{whole} of {len(ranked)} {what} are certified optimal on all of their seeds",
            *([f"{none} on none"] if none else []),
            f"best of all: {told[0]}",
        ]
    return f"On {task.task}, {'; '.join(told)}{task.shortfall}."


def _verdict(result: Result) -> str:
    share, agent = result.certified, result.group.agent
    if share.count == 0:
        regret = number(result.estimates["regret", "iqm"].point)
        return f"{agent} is certified on none of {share.total} seeds (IQM of the regret {regret})"
    seeds = f"{'all' if share.count == share.total else f'{share.count} of'} {share.total} seeds"
    if share.total == 1:
        seeds = "its one seed"
    if result.ever.count > share.count:  # a certificate can be lost again
        return f"{agent} ends certified optimal on {seeds}, and was so at some time on {result.ever.count}"
    told = f"{agent} is certified optimal on {seeds}"
    cell = tables.estimate(result, "steps", "median")
    if cell is not None and math.isfinite(cell.interval.point):
        told += f", by step {main_text(cell)}" + (" in the median" if share.total > 1 else "")
    return told


def _share_of(cell: Cell) -> float | None:
    return round(100 * cell.count / cell.total, 1) if isinstance(cell, Share) else None


@dataclass(frozen=True)
class _Picture:
    """An image as a data URI."""

    uri: str
    width: int
    height: int
    caption: str


def _galleries(task: TaskAnalysis) -> list[list[_Picture]]:
    """The pictures of each agent that has any, the best one first."""
    return [found for result in task.ranked if (found := list(_pictures(result)))]


def _pictures(result: Result) -> Iterator[_Picture]:
    """Those of the run with the median regret that are there, unchanged and not too large."""
    ranked = sorted(result.group.runs, key=lambda run: (run.regret, run.seed))
    run = ranked[(len(ranked) - 1) // 2]
    verdict = "certified optimal" if run.certified else f"regret {number(run.regret)}"
    for picture in PICTURES:
        if picture.caption is None or picture.file not in run.pictures:
            continue
        if (found := _embedded(run.folder / picture.file, run.pictures[picture.file])) is not None:
            yield _Picture(*found, f"{result.group.agent}, seed {run.seed}, {verdict}: {picture.caption}")


def _embedded(path: Path, digest: str | None) -> tuple[str, int, int] | None:
    """Data URI, width and height of a PNG or GIF.

    None where it is missing, damaged, too large, or has another SHA-256 than `digest`, of which None is any.
    """
    kind = path.suffix[1:]
    try:
        content = read_bytes(path, _LARGEST[path.suffix])
        if digest not in (None, sha256(content)):
            return None
        with Image.open(io.BytesIO(content), formats=[kind.upper()]) as image:
            if image.width * image.height > _MOST_PIXELS:
                return None
            width, height = image.size
            if kind == "png":
                small = image.convert("RGB")
                small.thumbnail((_WIDTH, 2 * _WIDTH), Image.Resampling.LANCZOS)
                buffer = io.BytesIO()
                small.save(buffer, format="PNG")  # the highest compression takes four times as long for 6 %
                content, (width, height) = buffer.getvalue(), small.size
    # What Pillow raises for a damaged one; ValueError is ours, too.
    except (OSError, ValueError, SyntaxError, EOFError, struct.error, Image.DecompressionBombError):
        return None
    return f"data:image/{kind};base64,{base64.b64encode(content).decode('ascii')}", width, height
