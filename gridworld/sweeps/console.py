"""What a sweep prints: its start, its end, and a table of results.

A row of the table is an agent, a task and settings, over the seeds. Settings are named by the words that
asked for them, since many others may follow from these.
"""

from __future__ import annotations

import math
import shlex
import statistics
import sys
from collections import Counter, defaultdict
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gridworld.base.console import aligned, command, command_line, duration, printable
from gridworld.base.errors import InputError
from gridworld.config.fields import Effect
from gridworld.config.recipe_file import literal
from gridworld.config.settings import ON_RESULT, effect_of, flat, with_effects
from gridworld.report.statistics import share
from gridworld.run.folder import shell_path
from gridworld.run.reader import read_run
from gridworld.sweeps.folder import DONE, FAILED, INTERRUPTED, JOBS_CSV, PENDING, RUNNING, STATUSES, JobRow

_COLUMNS = {"agent": "<0", "task": "<0", "settings": "<0", "certified": ">0", "median steps": ">0"}
_OF_SETTINGS = ON_RESULT - {Effect.SEED, Effect.LABELS, Effect.MACHINE}
_MOST_NAMED = 3  # jobs
_LONGEST = 60  # characters of settings
_MOST_LISTED = 50  # of a kind, on the terminal


def counts_text(rows: Iterable[JobRow]) -> str:
    """The number of jobs by status: "3 jobs: 2 done, 1 failed"."""
    counts = Counter(row.status for row in rows)
    parts = [f"{counts[status]} {status}" for status in STATUSES if counts[status]]
    return f"{counts.total()} {'job' if counts.total() == 1 else 'jobs'}: {', '.join(parts)}"


def tell_start(folder: Path, rows: Sequence[JobRow], to_run: int) -> None:
    """Print how the jobs stand and how many of them are run now."""
    print(f"sweep {shell_path(folder)}: {counts_text(rows)}; {to_run} to run", file=sys.stderr, flush=True)


def tell_end(
    folder: Path, rows: Sequence[JobRow], seconds: float, stopped: str, mistakes: Container[str]
) -> None:
    """Print the results, how the jobs stand, why some did not end well, and how to go on with the rest."""
    where, results = shell_path(folder), results_lines(folder, rows)
    lines = [f"sweep {where}: {counts_text(rows)}, in {duration(seconds)}"]
    lines += ["", *_most(f"  {line}".rstrip() for line in results), ""] if results else []
    lines += [f"  jobs: {shell_path(folder / JOBS_CSV)}", f"  curves: tensorboard --logdir {where}"]
    lines += [f"  report: {command('report')} {where}"] if results else []
    print(*map(printable, lines), sep="\n", flush=True)
    failed = [row for row in rows if row.status == FAILED]
    halted = [row for row in rows if row.error and row.status in (PENDING, INTERRUPTED)]
    lines = []
    for what, listed in (("interrupted", halted), ("failed", failed)):
        lines += [f"{what}:", *_most(f"  {row.overrides}: {row.error}" for row in listed)] if listed else []
    if stopped:
        lines.append(f"{stopped}; resume with: {resume_command(folder)}")
    elif any(row.job not in mistakes for row in failed):
        lines.append(f"to try them again: {resume_command(folder, 'hydra.sweeper.retry_failed=true')}")
    elif any(row.status == RUNNING for row in rows):
        lines.append(f"the rest runs elsewhere; to see its progress:  {resume_command(folder)}")
    elif any(row.status not in (DONE, FAILED) for row in rows):
        lines.append(f"the rest did not finish; resume with: {resume_command(folder)}")
    for line in lines:
        print(printable(line), file=sys.stderr, flush=True)


def _most(lines: Iterable[str]) -> list[str]:
    first, *rest = list(lines)
    more = len(rest) - _MOST_LISTED
    return [first, *rest[:_MOST_LISTED], *([f"  and {more} more; {JOBS_CSV} has all"] if more > 0 else [])]


def resume_command(folder: Path, *more: str) -> str:
    """This command line with `more` words, and with the folder if it does not name it."""
    words = command_line()
    if not any(word.startswith("hydra.sweep.dir=") for word in words):
        more = (f"hydra.sweep.dir={literal(str(folder), 'hydra.sweep.dir')}", *more)
    return printable(shlex.join([*words, *(word for word in more if word not in words)]))


def results_lines(folder: Path, rows: Sequence[JobRow]) -> list[str]:
    """The table of the results, a line each with the headings first; empty where no job is done."""
    groups: dict[tuple[str, str], dict[str, list[_Result]]] = defaultdict(lambda: defaultdict(list))
    lost = []
    for row in rows:
        found = _result(folder / row.job) if row.status == DONE else None
        if found is None:
            lost.append(row.job)
        else:
            groups[found.summary["agent"], found.summary["env"]][str(found.settings)].append(found)
    cells = []
    for (agent, task), alike in groups.items():
        labels = _differences([results[0] for results in alike.values()])
        for results, label in zip(alike.values(), labels, strict=True):
            certified = share(sum(each.summary["certified"] for each in results), len(results))
            cells.append([agent, task, label, str(certified), _steps(results)])
    if not cells:
        return []
    columns = [column for column in zip(_COLUMNS, *cells, strict=True) if any(column[1:])]
    table = [[f"{cell} " for cell in row] for row in zip(*columns, strict=True)]
    lines = aligned(table, [_COLUMNS[heading] for heading, *_ in columns])  # two blanks between columns
    if lost:
        named = f"{', '.join(lost[:_MOST_NAMED])}{', ...' if len(lost) > _MOST_NAMED else ''}"
        lines.append(f"{len(lost)} of {len(rows)} jobs are not counted: {named}")
    return lines


@dataclass(frozen=True)
class _Result:
    """What a job came to."""

    summary: Mapping[str, Any]
    settings: Mapping[str, str]  # values as text, by dotted names
    words: Mapping[str, str]  # of the command line, by the settings that they choose


def _result(folder: Path) -> _Result | None:
    try:
        run = read_run(folder)
        chosen = flat(with_effects(_OF_SETTINGS, run.manifest["config"]))
        settings = {name: str(value) for name, value in chosen}
        words = {}
        for word in run.manifest["overrides"]:
            key = word.partition("=")[0].lstrip("+~").partition("@")[0]
            if effect_of(key) in _OF_SETTINGS:
                follows = "${" in word and key in settings  # from other settings, as `n_envs=${seed}` does
                words[key] = f"{key}={settings[key]}" if follows else word
        return _Result(run.read_summary(), settings, words)
    except InputError:  # it was changed since; `report` says in what
        return None


def _differences(results: Sequence[_Result]) -> list[str]:
    """The words of each that not all have; where one names no such setting, its value."""
    keys = {key: {result.words.get(key) for result in results} for found in results for key in found.words}
    labels = []
    for result in results:
        values = {key: f"{key}={value}" for key, value in result.settings.items()} | dict(result.words)
        words = [values[key].removeprefix("agent.") for key in keys if len(keys[key]) > 1 and key in values]
        text = " ".join(words)
        labels.append(text if len(text) <= _LONGEST else f"{text[: _LONGEST - 1]}…")
    return labels


def _steps(results: Sequence[_Result]) -> str:
    """The median step of being certified for good, or more than what the runs that are not were given."""
    since = [result.summary["certified_since_step"] for result in results]
    median = statistics.median(math.inf if step is None else step for step in since)
    if math.isfinite(median):
        return f"{round(median):,}"
    summaries = [result.summary for result in results]
    given = [summary["timesteps"] for summary in summaries if summary["certified_since_step"] is None]
    return f"> {min(given):,}"
