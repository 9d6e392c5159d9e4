"""What a sweep's finished jobs came to: a row for each agent, task and settings, over the seeds."""

from __future__ import annotations

import math
import statistics
from collections import defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path

from gridworld.config.effects import Effect
from gridworld.config.flatten import flat
from gridworld.config.settings_by_effect import ON_RESULT, is_of_network, with_effects
from gridworld.envs.intervals import wilson_interval
from gridworld.errors import InputError
from gridworld.process.console.columns import aligned
from gridworld.run.reader import read_run
from gridworld.run.summary import Summary
from gridworld.sweep.job_table import DONE, JobRow

_HEADINGS = ("agent", "task", "settings", "certified", "steps to certificate, median")
_OF_SETTINGS = ON_RESULT - {Effect.SEED, Effect.LABELS, Effect.MACHINE}
_LONGEST = 60  # characters of settings

Settings = tuple[tuple[str, str], ...]  # dotted names, values as text


def results_lines(folder: Path, rows: Sequence[JobRow]) -> list[str]:
    """The table of the results, a line each with the headings first; empty where no job is done.

    Args:
        folder: the sweep's.
        rows: of its jobs; those that are not done are left out.
    """
    groups: dict[tuple[str, str], dict[Settings, list[Summary]]] = defaultdict(lambda: defaultdict(list))
    for row in rows:
        found = _result(folder / row.job) if row.status == DONE else None
        if found is not None:
            summary, settings = found
            groups[summary["agent"], summary["env"]][settings].append(summary)
    cells = [
        [agent, task, _difference(settings, alike), _certified(found), _steps(found)]
        for (agent, task), alike in groups.items()
        for settings, found in alike.items()
    ]
    if not cells:
        return []
    keep = [0, 1, *([2] if any(row[2] for row in cells) else []), 3, 4]
    table = [[row[column] for column in keep] for row in [list(_HEADINGS), *cells]]
    forms = ["<0" if column < 3 else ">0" for column in keep]
    return aligned([[f"{cell} " for cell in row] for row in table], forms)  # two blanks between columns


def _result(folder: Path) -> tuple[Summary, Settings] | None:
    try:
        run = read_run(folder)
        chosen = with_effects(_OF_SETTINGS, run.manifest["config"])
        return run.read_summary(), tuple((name, str(value)) for name, value in flat(chosen))
    except InputError:  # it was changed since; the report says so
        return None


def _difference(settings: Settings, alike: Iterable[Settings]) -> str:
    """In what the settings differ from the others of this agent on this task; a network's come last."""
    shared = set(settings).intersection(*alike)
    own = sorted((each for each in settings if each not in shared), key=lambda each: is_of_network(each[0]))
    told = " ".join(f"{name.removeprefix('agent.')}={value}" for name, value in own)
    return told if len(told) <= _LONGEST else f"{told[: _LONGEST - 1]}…"


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
