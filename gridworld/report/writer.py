"""A report's folder: the page, its figures and tables as files, event files. Written whole or not at all.

The event files have the curves over seeds, since TensorBoard cannot average runs.
"""

from __future__ import annotations

import dataclasses
import logging
import math
import os
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from gridworld.errors import InputError, reason
from gridworld.process.console import tell
from gridworld.report import tables
from gridworld.report.analysis import (
    MOST_SHOWN,
    Band,
    NothingFinishedError,
    Report,
    Result,
    TaskAnalysis,
    gather,
)
from gridworld.report.tables import to_captioned_markdown, to_csv, to_markdown
from gridworld.run.folder import EVENTS as EVENT_FILE
from gridworld.run.folder import MANIFEST, check_writable
from gridworld.storage.atomic_write import replacing_folder, write_text
from gridworld.training.tensorboard import EventWriter

PAGE = "report.html"
FIGURES, TABLES, EVENTS = "figures", "tables", "tensorboard"
OVER_SEEDS = "_over_seeds"  # in a sweep's folder or a study's; TensorBoard shows it before the runs
_MOST_READ_UNASKED = 500  # runs of a sweep: a second
_OURS = {PAGE, FIGURES, TABLES, EVENTS}
_LONGEST_NAME = 120

FORMATS = ("png", "pdf", "svg")  # of the figures

BANDS = {  # tags of a value, its lower and its upper end
    name: (f"{name}/{'mean' if name == 'seeds certified' else 'iqm'}", f"{name}/low", f"{name}/high")
    for name in ("regret", "value", "on-line return", "seeds certified")
}

MARKERS = "<!-- results -->", "<!-- /results -->"


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
    existing = next(parent for parent in folder.absolute().parents if parent.exists())
    if not existing.is_dir() or not os.access(existing, os.W_OK | os.X_OK):
        raise InputError(f"--out {folder}: {existing} cannot be written to; choose another folder")


def write_report(report: Report, folder: Path, formats: Sequence[str] = FORMATS) -> Path:
    """Write all in the place of an older report, whole or not at all; returns the page's path."""
    check_out(folder)
    # It keeps what matplotlib says about its fonts and folders, also on import, off standard error.
    logging.getLogger("matplotlib").addHandler(logging.NullHandler())
    try:
        from gridworld.report.page import charts, render
    except (ValueError, OSError) as error:  # it reads the user's settings when it is imported
        raise InputError(
            f"matplotlib: its settings cannot be read ({error}); mend or remove matplotlibrc"
        ) from None
    of_all = charts(report)
    with replacing_folder(folder) as new:
        write_text(new / PAGE, render(report, of_all))
        (new / FIGURES).mkdir()
        drawn = [chart for of_one in of_all.values() for chart in of_one]
        for name, chart in zip(_file_names(chart.name for chart in drawn), drawn, strict=True):
            for kind in formats:
                (new / FIGURES / f"{name}.{kind}").write_bytes(chart.saved_as(kind))
        (new / TABLES).mkdir()
        all_tables = list(tables.all_tables(report))
        for name, table in zip(_file_names(table.name for table in all_tables), all_tables, strict=True):
            write_text(new / TABLES / f"{name}.csv", to_csv(table))
            write_text(new / TABLES / f"{name}.md", to_captioned_markdown(table))
        _write_events(report, new / EVENTS)
    return folder / PAGE


def write_over_seeds(runs: Path, folder: Path) -> Path | None:
    """Write the curves over seeds of a sweep or a study, for TensorBoard to show next to those of the runs.

    What is damaged is named on standard error. Returns what was made in `folder`; None where no agent has two
    seeds, there are too many runs to read them all, or none has curves for TensorBoard or can be used.
    """
    count = sum(1 for _ in runs.glob(f"*/{MANIFEST}"))
    if count > _MOST_READ_UNASKED or not any(runs.glob(f"*/{EVENT_FILE}")):
        return None
    try:
        report = gather([runs])
        for sentence in report.damage[:MOST_SHOWN]:
            tell(sentence)
        if len(report.damage) > MOST_SHOWN:
            tell(f"{runs}: {len(report.damage) - MOST_SHOWN} more files are damaged; the report has all")
        if all(len(result.group.runs) < 2 for task in report.tasks for result in task.results):
            return None
        with replacing_folder(folder / OVER_SEEDS) as new:
            _write_events(report, new)
    except NothingFinishedError:  # who ran them has said so
        return None
    except (InputError, OSError) as error:
        tell(f"{folder / OVER_SEEDS}: is not written, {reason(error)}")
        return None
    return folder / OVER_SEEDS


def _write_events(report: Report, folder: Path) -> None:
    results = [(task, result) for task in report.tasks for result in task.results]
    # TensorBoard shows these names, so they keep their blanks.
    names = _file_names((f"{result.group.agent} on {task.task}" for task, result in results), blank=" ")
    for name, (task, result) in zip(names, results, strict=True):
        (folder / name).mkdir(parents=True)
        events = EventWriter(folder / name)
        curves = _curves(result, task)
        events.bands("over seeds, with 95 % intervals", {name: BANDS[name] for name in curves})
        for of, band in curves.items():
            parts = {"iqm": band.point, "low": band.low, "high": band.high, "mean": band.mean}
            for index, step in enumerate(band.steps.astype(np.int64).tolist()):
                values = {f"{of}/{part}": float(numbers[index]) for part, numbers in parts.items()}
                events.scalars({tag: value for tag, value in values.items() if math.isfinite(value)}, step)
        events.close()


def _curves(result: Result, task: TaskAnalysis) -> dict[str, Band]:
    """The curves by name."""
    regret, best = result.regret, task.world.optimal_value
    # The value is the optimum's minus the regret: its upper end belongs to the regret's lower one.
    value = dataclasses.replace(
        regret,
        point=best - regret.point,
        mean=best - regret.mean,
        low=best - regret.high,
        high=best - regret.low,
    )
    curves = {"regret": regret, "value": value, "seeds certified": result.certificates}
    return curves if result.online is None else curves | {"on-line return": result.online}


def check_markers(path: Path) -> None:
    """Raise `InputError` unless the Markdown file has the two markers, in order, and can be replaced."""
    _around_markers(path)
    check_writable(path.parent, "--readme")


def write_readme(report: Report, path: Path) -> None:
    """Put the table of results between the two markers of a Markdown file; see `check_markers`."""
    before, after = _around_markers(path)
    table = to_markdown(tables.results_table(report.tasks, report.reasons))
    write_text(path, f"{before}{MARKERS[0]}\n{table}{MARKERS[1]}{after}")


def _around_markers(path: Path) -> tuple[str, str]:
    if not path.is_file():
        raise InputError(f"--readme {path}: no such file")
    try:
        text = path.read_text("utf-8")
    except UnicodeDecodeError:
        raise InputError(f"--readme {path}: is no UTF-8 text") from None
    begin, end = MARKERS
    if text.count(begin) != 1 or text.count(end) != 1 or text.index(begin) > text.index(end):
        raise InputError(f"--readme {path}: must have one line {begin} and, after it, one line {end}")
    return text.split(begin)[0], text.split(end)[1]


def _file_names(names: Iterable[str], blank: str = "_") -> list[str]:
    """Names that are safe for files and different from each other, even where capitals do not count."""
    out: list[str] = []
    for name in names:
        plain = re.sub(r"[^\w.,=()+ -]+", "-", name).strip(" .-")[:_LONGEST_NAME] or "unnamed"
        plain = plain.replace(" ", blank)
        count, unique = 1, plain
        while unique.lower() in {other.lower() for other in out}:
            count += 1
            unique = f"{plain}{blank}{count}"
        out.append(unique)
    return out
