"""What a sweep's finished jobs came to: a row for each agent, task and settings, over the seeds.

Settings are told by the words that asked for them, since many others may follow from these.
"""

from __future__ import annotations

import math
import statistics
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from gridworld.config.fields import Effect
from gridworld.config.settings import ON_RESULT, effect_of, flat, with_effects
from gridworld.envs.rollout import wilson_interval
from gridworld.errors import InputError
from gridworld.process.console.terminal import aligned
from gridworld.run.reader import read_run
from gridworld.run.summary import Summary
from gridworld.sweep.job_table import DONE, JobRow

_HEADINGS = ("agent", "task", "settings", "certified", "steps to certificate, median")
_OF_SETTINGS = ON_RESULT - {Effect.SEED, Effect.LABELS, Effect.MACHINE}
_MOST_NAMED = 3  # jobs
_LONGEST = 60  # characters of settings

Settings = tuple[tuple[str, str], ...]  # dotted names, values as text


def results_lines(folder: Path, rows: Sequence[JobRow]) -> list[str]:
    """The table of the results, a line each with the headings first; empty where no job is done.

    Args:
        folder: the sweep's.
        rows: of its jobs; those that are not done or were changed since are left out, which the headings say.
    """
    groups: dict[tuple[str, str], dict[Settings, list[_Result]]] = defaultdict(lambda: defaultdict(list))
    lost = []
    for row in rows:
        found = _result(folder / row.job) if row.status == DONE else None
        if found is None:
            lost.append(row.job)
        else:
            groups[found.summary["agent"], found.summary["env"]][found.settings].append(found)
    cells = []
    for (agent, task), alike in groups.items():
        told = _differences([results[0] for results in alike.values()])
        for results, difference in zip(alike.values(), told, strict=True):
            summaries = [result.summary for result in results]
            cells.append([agent, task, difference, _certified(summaries), _steps(summaries)])
    if not cells:
        return []
    keep = [0, 1, *([2] if any(row[2] for row in cells) else []), 3, 4]
    table = [[row[column] for column in keep] for row in [list(_HEADINGS), *cells]]
    forms = ["<0" if column < 3 else ">0" for column in keep]
    lines = aligned([[f"{cell} " for cell in row] for row in table], forms)  # two blanks between columns
    if lost:
        named = f"{', '.join(lost[:_MOST_NAMED])}{', ...' if len(lost) > _MOST_NAMED else ''}"
        lines[0] += f"; {len(lost)} of {len(rows)} jobs are not counted: {named}"
    return lines


@dataclass(frozen=True)
class _Result:
    """What a job came to, and by which settings and words."""

    summary: Summary
    settings: Settings
    words: tuple[str, ...]  # that chose settings


def _result(folder: Path) -> _Result | None:
    try:
        run = read_run(folder)
        chosen = with_effects(_OF_SETTINGS, run.manifest["config"])
        settings = tuple((name, str(value)) for name, value in flat(chosen))
        asked = [word for word in run.manifest["overrides"] if effect_of(_key(word)) in _OF_SETTINGS]
        words = tuple(_resolved(word, dict(settings)) for word in asked)
        return _Result(run.read_summary(), settings, words)
    except InputError:  # it was changed since; `report` says in what
        return None


def _resolved(word: str, settings: dict[str, str]) -> str:
    """The word with its value where it names other settings, as `n_envs=${seed}` does."""
    value = settings.get(_key(word))
    return f"{_key(word)}={value}" if "${" in word and value is not None else word


def _key(word: str) -> str:
    return word.partition("=")[0].lstrip("+~").partition("@")[0]


def _differences(results: Sequence[_Result]) -> list[str]:
    """The words of each that not all have; where one names no such setting, its value."""
    shared = set(results[0].words).intersection(*(result.words for result in results))
    keys = dict.fromkeys(_key(word) for result in results for word in result.words if word not in shared)
    told = []
    for result in results:
        given = {_key(word): word for word in result.words}
        values = {key: f"{key}={value}" for key, value in result.settings}
        words = [given.get(key) or values.get(key, "") for key in keys]
        told.append(_shortened(" ".join(word.removeprefix("agent.") for word in words if word)))
    return told


def _shortened(text: str) -> str:
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 1]}…"


def _certified(found: Sequence[Summary]) -> str:
    count = sum(bool(summary["certified"]) for summary in found)
    low, high = wilson_interval(count, len(found))
    return f"{count} of {len(found)} [{100 * low:.0f} %, {100 * high:.0f} %]"


def _steps(found: Sequence[Summary]) -> str:
    """The median step of the first certificate, or more than what the runs without one were given."""
    first = [summary["first_certified_step"] for summary in found]
    median = statistics.median(math.inf if step is None else step for step in first)
    if math.isfinite(median):
        return f"{round(median):,}"
    given = [summary["timesteps"] for summary in found if summary["first_certified_step"] is None]
    return f"> {min(given):,}"
