"""A report's folder: one HTML page without scripts or network, figures and tables as files, event files.

The page links to that of the playground, which lies beside it and has scripts. The folder is written whole or
not at all. The event files have the curves over seeds, since TensorBoard cannot average runs.
"""

from __future__ import annotations

import base64
import dataclasses
import functools
import io
import logging
import math
import re
import struct
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from PIL import Image

from gridworld.base.atomic_write import replacing_folder, write_text
from gridworld.base.console import plain, tell
from gridworld.base.errors import InputError, reason
from gridworld.base.safe_read import read_bytes, sha256
from gridworld.config.train import PICTURES
from gridworld.report import statistics, tables
from gridworld.report.analysis import Report, Result, first_ones, gather
from gridworld.report.playground.page import maps_page
from gridworld.report.tables import to_captioned_markdown, to_csv
from gridworld.run.folder import EVENTS as EVENT_FILE
from gridworld.run.folder import SUMMARY, check_writable
from gridworld.training.learning_curve import GREEDY, GREEDY_MORE
from gridworld.training.tensorboard import EventWriter

if TYPE_CHECKING:  # a sweep does not wait for matplotlib and Jinja
    import jinja2

    from gridworld.report.chart import Chart, Styles

PAGE, PLAYGROUND = "report.html", "playground.html"
FIGURES, TABLES, EVENTS = "figures", "tables", "tensorboard"
OVER_SEEDS = "_over_seeds"  # in a sweep's folder or a study's; TensorBoard shows it before the runs
FORMATS = ("png", "pdf", "svg")  # of the figures
_TAGS = {
    **{name: f"{GREEDY}/{name}" for name in ("regret", "value")},
    "certified": f"{GREEDY_MORE}/certified",
    "online_return": "online/return",
}
# Tags of a value, its lower and its upper end: the value's is that of the runs, so that it is in their chart.
BANDS = {name: (tag, f"over_seeds/{name}_low", f"over_seeds/{name}_high") for name, tag in _TAGS.items()}
MARKERS = "<!-- results -->", "<!-- /results -->"

_MOST_READ_UNASKED = 500  # runs of a sweep: a second
_OURS = {PAGE, PLAYGROUND, FIGURES, TABLES, EVENTS}
_LONGEST_NAME = 120
_LARGEST = {".png": 4 * 2**20, ".gif": 256 * 2**10}  # bytes
_MOST_PIXELS = 4_000_000


def check_out(folder: Path) -> None:
    """Raise `InputError` unless a report can be written there: nothing is in the way but an older report."""
    if folder.is_symlink():
        raise InputError(f"--out {folder}: is a symbolic link; name the folder itself")
    if folder.is_dir():
        strange = sorted(path.name for path in folder.iterdir() if path.name not in _OURS)
        if strange:
            raise InputError(
                f"--out {folder}: holds {strange[0]}, which is not part of a report; choose a new folder"
            )
    elif folder.exists():
        raise InputError(f"--out {folder}: is not a folder; choose a new one")
    check_writable(folder.absolute().parent, "--out")  # where the new one takes its place


def write_report(report: Report, folder: Path, formats: Sequence[str] = FORMATS) -> Path:
    """Write all in the place of an older report, whole or not at all; returns the page's path."""
    check_out(folder)
    # It keeps what matplotlib says about its fonts and folders, also on import, off standard error.
    logging.getLogger("matplotlib").addHandler(logging.NullHandler())
    of_all, all_tables = charts(report), list(tables.all_tables(report))
    drawn = [chart for of_one in of_all.values() for chart in of_one]
    with replacing_folder(folder) as new:
        write_text(new / PAGE, render(report, of_all))
        if any(task.world.link for task in report.tasks):
            write_text(new / PLAYGROUND, maps_page())
        (new / FIGURES).mkdir()
        for name, chart in zip(_file_names(chart.name for chart in drawn), drawn, strict=True):
            for kind in formats:
                (new / FIGURES / f"{name}.{kind}").write_bytes(chart.saved_as(kind))
        (new / TABLES).mkdir()
        for name, table in zip(_file_names(table.name for table in all_tables), all_tables, strict=True):
            write_text(new / TABLES / f"{name}.csv", to_csv(table))
            write_text(new / TABLES / f"{name}.md", to_captioned_markdown(table))
        if not (folder.parent / OVER_SEEDS).exists():  # TensorBoard would show the same curves twice
            _write_events(report, new / EVENTS)
    return folder / PAGE


def _file_names(names: Iterable[str], unsafe: str = r"[^\w.=+-]+", instead: str = "_") -> list[str]:
    """Names that are safe for files and different from each other, even where capitals do not count."""
    out: dict[str, str] = {}  # by their small letters
    for name in names:
        safe = unique = re.sub(unsafe, instead, name).strip(" ._-")[:_LONGEST_NAME] or "unnamed"
        count = 1
        while unique.lower() in out:
            count += 1
            unique = f"{safe}_{count}"
        out[unique.lower()] = unique
    return list(out.values())


# ---- the page ------------------------------------------------------------------------------------------


def charts(report: Report) -> dict[str, list[Chart]]:
    """The figures by task, those of tuning studies by title, and those over tasks by ""."""
    from gridworld.report.agent_charts import overall_charts, task_charts
    from gridworld.report.setting_charts import tuning_charts

    look = _look(report)
    drawn = {task.task: list(task_charts(task, look)) for task in report.tasks}
    drawn |= {tuning.title: list(tuning_charts(tuning)) for tuning in report.tunings}
    return drawn | {"": list(overall_charts(report.overall, look)) if report.overall else []}


def _look(report: Report) -> Styles:
    """A style for each agent; where they are more than the colours, the best ones come first."""
    from gridworld.report.chart import COLOURS, styles

    agents = list(report.study.agents)
    if len(agents) > len(COLOURS):
        best = [result.group.agent for task in report.tasks for result in task.ranked[: len(COLOURS)]]
        agents = list(dict.fromkeys([*sorted(set(best)), *agents]))
    return styles(agents)


@functools.cache
def template() -> jinja2.Template:
    """The page's, compiled once."""
    import jinja2

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
    from gridworld.report.setting_charts import sweep_answer

    folders = [run.folder.absolute() for run in report.runs]
    of_one_study = (
        tuning.title
        for tuning in report.tunings
        if all(folder.is_relative_to(tuning.folder.absolute()) for folder in folders)
    )
    return template().render(
        report=report,
        study=report.study,
        headline=next(of_one_study, ""),
        drawn=drawn,
        resamples=statistics.RESAMPLES,
        colours={agent: look["color"] for agent, look in _look(report).items()},
        tables=tables,
        is_finite=math.isfinite,
        pictures=lambda task: [
            (result.group.agent, pictures) for result in task.ranked if (pictures := list(_embedded(result)))
        ],
        sweep_answer=sweep_answer,
        plain=plain,
        base64=lambda content: base64.b64encode(content).decode(),
    )


def _embedded(result: Result) -> Iterator[dict[str, Any]]:
    """The pictures of the run with the median regret that are there, unchanged and not too large."""
    ranked = sorted(result.group.runs, key=lambda run: (run.regret, run.seed))
    run = ranked[(len(ranked) - 1) // 2]
    for picture in PICTURES.values():
        path = run.folder / picture.file
        if picture.caption is None or picture.file not in run.pictures:
            continue
        kind = path.suffix[1:]
        try:
            content = read_bytes(path, _LARGEST[path.suffix])
            with Image.open(io.BytesIO(content), formats=[kind.upper()]) as image:
                width, height = image.size
                if width * height > _MOST_PIXELS or run.pictures[picture.file] != sha256(content):
                    continue
                image.load()
        # What Pillow raises for a damaged one; ValueError is ours, too.
        except (OSError, ValueError, SyntaxError, EOFError, struct.error, Image.DecompressionBombError):
            continue
        yield {"run": run, "of": picture, "kind": kind, "content": content, "width": width, "height": height}


# ---- TensorBoard ---------------------------------------------------------------------------------------


def write_over_seeds(runs: Path, folder: Path) -> Path | None:
    """Write the curves over seeds of a sweep or a study, for TensorBoard to show next to those of the runs.

    What is damaged is named on standard error. Returns what was made in `folder`; None where no agent has two
    seeds, there are too many runs to read them all, or none has curves for TensorBoard or can be used.
    """
    finished = sum(1 for _ in runs.glob(f"*/{SUMMARY}"))
    if not 1 < finished <= _MOST_READ_UNASKED or not any(runs.glob(f"*/{EVENT_FILE}")):
        return None
    try:
        report = gather([runs])
        for sentence in first_ones(report.damage, f" damaged files in {runs}; the report lists all"):
            tell(sentence)
        if all(len(group.runs) < 2 for group in report.study.groups):
            return None
        with replacing_folder(folder / OVER_SEEDS) as new:
            _write_events(report, new)
    except (InputError, OSError) as error:
        tell(f"{folder / OVER_SEEDS}: cannot be written, {reason(error)}")
        return None
    return folder / OVER_SEEDS


def _write_events(report: Report, folder: Path) -> None:
    results = [
        (task, result) for task in report.tasks for result in task.results if len(result.group.runs) > 1
    ]
    # TensorBoard shows these names, so they keep blanks and brackets.
    labels = (f"{result.group.agent} on {task.task}" for task, result in results)
    folders = [folder / name for name in _file_names(labels, r"[^\w.,=()+ -]+", "-")]
    for of_result, (task, result) in zip(folders, results, strict=True):
        of_result.mkdir(parents=True)
        events = EventWriter(of_result, is_first=True)
        regret, best = result.regret, task.world.optimal_value
        # The value is the optimum's minus the regret: its upper end belongs to the regret's lower one.
        point, low, high = (best - each for each in (regret.point, regret.high, regret.low))
        value = dataclasses.replace(regret, point=point, low=low, high=high)
        curves = {"regret": regret, "value": value, "certified": result.certificates}
        curves |= {} if result.online is None else {"online_return": result.online}
        events.bands("over seeds, with 95 % intervals", {name: BANDS[name] for name in curves})
        for name, band in curves.items():
            columns = (band.steps, band.point, band.low, band.high)
            for step, *values in zip(*(column.tolist() for column in columns), strict=True):
                points = zip(BANDS[name], values, strict=True)
                events.scalars({tag: value for tag, value in points if math.isfinite(value)}, int(step))
        events.close()


# ---- a README ------------------------------------------------------------------------------------------


def write_readme(report: Report, path: Path) -> None:
    """Put the tables of results between the two markers of a Markdown file."""
    before, after = around_markers(path)
    certified = tables.to_coloured_markdown(tables.answer_table(report))
    details = tables.to_markdown(tables.results_table(report))
    write_text(path, f"{before}{MARKERS[0]}\n{certified}\n{details}{MARKERS[1]}{after}")


def around_markers(path: Path) -> tuple[str, str]:
    """The text before and after a Markdown file's markers; `InputError` where it lacks them, or is fixed."""
    check_writable(path.parent, "--readme")
    if not path.is_file():
        raise InputError(f"--readme {path}: no such file")
    try:
        text = path.read_text("utf-8")
    except UnicodeDecodeError:
        raise InputError(f"--readme {path}: is not UTF-8 text") from None
    begin, end = MARKERS
    if text.count(begin) != 1 or text.count(end) != 1 or text.index(begin) > text.index(end):
        raise InputError(f"--readme {path}: must have one line {begin} and, after it, one line {end}")
    return text.split(begin)[0], text.split(end)[1]
