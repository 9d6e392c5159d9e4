"""The report as one HTML page without scripts, network, or other files."""

from __future__ import annotations

import base64
import functools
import io
import math
import re
import struct
from pathlib import Path
from typing import NamedTuple

import jinja2
from markupsafe import Markup, escape
from PIL import Image

from gridworld.config.train import PICTURES
from gridworld.process.console import plain
from gridworld.report import tables
from gridworld.report.agent_charts import overall_charts, task_charts
from gridworld.report.analysis import Report, Result, TaskAnalysis
from gridworld.report.chart import COLOURS, Chart, Styles, styles
from gridworld.report.setting_charts import tuning_charts
from gridworld.report.statistics import RESAMPLES, Share
from gridworld.storage.safe_read import read_bytes, sha256

_ALL_TASKS = ""  # no task's name
_FEW = 6  # agents; of more, what is long is folded away
_MOST_NAMED = 4  # agents, each by name in the opening
_LARGEST = {".png": 4 * 2**20, ".gif": 256 * 2**10}  # bytes
_MOST_PIXELS = 4_000_000


def charts(report: Report) -> dict[str, list[Chart]]:
    """The figures by task, those of tuning studies by title, and over tasks, in the agents' colours."""
    look = _look(report)
    drawn = {task.task: list(task_charts(task, look)) for task in report.tasks}
    drawn |= {tuning.title: list(tuning_charts(tuning)) for tuning in report.tunings}
    return drawn | {_ALL_TASKS: list(overall_charts(report.overall, look)) if report.overall else []}


def _look(report: Report) -> Styles:
    """A style for each agent; where they are more than the colours, the best ones come first."""
    agents = list(report.study.agents)
    if len(agents) > len(COLOURS):
        best = [result.group.agent for task in report.tasks for result in task.ranked[: len(COLOURS)]]
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
    """The page's HTML with the figures of `charts`."""
    study = report.study
    runs = [run for group in study.groups for run in group.runs]
    folders = [run.folder.absolute() for run in runs]
    agents = {run.agent for run in runs}  # their own names, whatever settings they were run with
    of_one_study = (
        tuning.title
        for tuning in report.tunings
        if all(folder.is_relative_to(tuning.folder.absolute()) for folder in folders)
    )
    names = " on ".join(
        ", ".join(names) if len(names) <= _MOST_NAMED else f"{len(names)} {what}"
        for names, what in ((study.agents, "agents"), (study.tasks, "tasks"))
    )
    days = sorted({run.started for run in runs if run.started})
    counts = {"run": len(runs), "agent": len(agents), "configuration": len(study.agents)}
    if len(study.agents) == len(agents):
        del counts["configuration"]
    return template().render(
        report=report,
        study=study,
        headline=next(of_one_study, ""),
        names=plain(names)[:120],
        counts=counts | {"task": len(study.tasks)},
        days=list(dict.fromkeys([*days[:1], *days[-1:]])),
        problems=[*report.problems, *report.damage],
        kinds="agents" if len(agents) == len(study.agents) else "configurations",
        versions=sorted({run.version for run in runs}),
        drawn=drawn,
        overall_figures=drawn[_ALL_TASKS],
        resamples=f"{RESAMPLES:,}",
        few=_FEW,
        most_named=_MOST_NAMED,
        colours={agent: look["color"] for agent, look in _look(report).items()},
        tables=tables,
        is_finite=math.isfinite,
        is_share=lambda cell: isinstance(cell, Share),
        world=_world,
        galleries=lambda task: list(filter(None, map(_gallery, task.ranked))),
        plain=plain,
        svg=lambda chart: f"data:image/svg+xml;base64,{base64.b64encode(chart.saved_as('svg')).decode()}",
        # A column's heading may break after "_" and "=", as labels are long.
        breakable=lambda heading: Markup(re.sub(r"(?<=[_=])", "<wbr>", str(escape(heading)))),
    )


def _world(task: TaskAnalysis) -> str:
    """The settings of a task's world."""
    run = task.results[0].group.runs[0]
    names = ["slip", "step_reward", "goal_reward", "trap_reward", "max_episode_steps"]
    if "env.source" in run.settings:
        names = sorted(name.removeprefix("env.") for name in run.settings if name.startswith("env."))
    settings = {name: run.settings.get(f"env.{name}", "null") for name in names}
    shown = [f"{name} {value}" for name, value in settings.items() if value not in ("null", "{}")]
    if run.settings.get("env.max_episode_steps", "null") == "null":
        shown.append(f"max_episode_steps {run.step_limit}")
    return ", ".join(shown).replace("_", " ")


class _Picture(NamedTuple):
    """An image as a data URI."""

    uri: str
    width: int
    height: int
    caption: str


def _gallery(result: Result) -> list[_Picture]:
    """The pictures of the run with the median regret that are there, unchanged and not too large."""
    ranked = sorted(result.group.runs, key=lambda run: (run.regret, run.seed))
    run = ranked[(len(ranked) - 1) // 2]
    verdict = "certified optimal" if run.certified else f"regret {tables.number(run.regret)}"
    pictures = []
    for picture in PICTURES:
        if picture.caption is not None and picture.file in run.pictures:
            path, caption = run.folder / picture.file, f"{result.group.agent}, seed {run.seed}, {verdict}"
            embedded = _embedded(path, run.pictures[picture.file], f"{caption}: {picture.caption}")
            pictures += [] if embedded is None else [embedded]
    return pictures


def _embedded(path: Path, digest: str | None, caption: str) -> _Picture | None:
    """A PNG or GIF; None where it is missing, damaged, too large, or has another SHA-256 than `digest`."""
    kind = path.suffix[1:]
    try:
        content = read_bytes(path, _LARGEST[path.suffix])
        with Image.open(io.BytesIO(content), formats=[kind.upper()]) as image:
            width, height = image.size
            if width * height > _MOST_PIXELS or digest not in (None, sha256(content)):
                return None
            image.load()
    # What Pillow raises for a damaged one; ValueError is ours, too.
    except (OSError, ValueError, SyntaxError, EOFError, struct.error, Image.DecompressionBombError):
        return None
    return _Picture(f"data:image/{kind};base64,{base64.b64encode(content).decode()}", width, height, caption)
