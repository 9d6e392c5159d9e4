"""The runs of a report: found below the given folders, and read within bounds. Nothing in them is imported.

The given folders may be links, since the user named them. A link in them may be a stranger's: it is not
followed, so that a report covers what is in the folder, and the search ends.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gridworld.base.console import plain, printable
from gridworld.base.errors import InputError
from gridworld.config.settings import NEWER, flat, privileges
from gridworld.run.console import scope_of
from gridworld.run.folder import CURVE, MANIFEST, SUMMARY, VISITS
from gridworld.run.reader import ONLINE, REQUIRED, RunReader, check_is_folder, read_columns, read_run
from gridworld.world.mdp import FloatArray
from gridworld.world.metrics import METRICS

MOST_ENTRIES = 2_000_000  # files and folders below a given one: some seconds
SAMPLED_RETURN = "sampled_return"

# The metrics of which a report has the last value, in the order of its tables.
_ORDER = ("value", "return", "goal_probability")
REPORTED = sorted(
    (metric for metric in METRICS if metric.in_report), key=lambda each: (*_ORDER, each.name).index(each.name)
)
_LONGEST_NAME = 80  # characters
_LONGEST_SCOPE = 300
_DIGITS = 9  # after the point: two ways to compute one regret differ later than that

Settings = Mapping[str, str]  # flat: {"agent.gamma": "0.9"}


@dataclass(frozen=True, eq=False)
class Evidence:
    """A finished run, as far as the statistics need it."""

    folder: Path
    agent: str  # its name in the settings
    env: str  # the map's name
    seed: int
    settings: Settings  # all of them
    world: Mapping[str, Any]  # env.* as the manifest has it
    layout: str  # the map's text
    gamma: float  # the evaluation's discount
    optimal_value: float  # of the optimal policy at the start
    certified: bool  # whether the final greedy policy is optimal
    certified_since_step: float  # of the certificate that still holds; infinite without one
    first_certified_step: float
    seconds: float  # of training
    started: str  # the date
    version: str  # of this package; "?" where the manifest does not say
    curve: Mapping[str, FloatArray]  # (evaluations,): the columns in `REQUIRED`, and what else the file has
    pictures: Mapping[str, str]  # as `RunReader.pictures`
    step_limit: Any  # of an episode, as the summary has it
    privileges: Sequence[str]  # as `config.settings.privileges` finds them in its settings
    recipe: str | None  # AGENT/NAME
    proven_regret: float | None  # at least the final greedy policy's; None: nothing is proven
    scope: str  # how the tables of its world are known; "" by construction
    damage: tuple[str, ...]  # a sentence for each of its other files that is not the one that it wrote

    @property
    def steps(self) -> int:
        """Environment steps at the last evaluation."""
        return int(self.curve["step"][-1])

    @property
    def regret(self) -> float:
        """The final greedy policy's regret; exactly 0 for a certified one, so that two of them are a tie."""
        return 0.0 if self.certified else round(float(self.curve["regret"][-1]), _DIGITS)


@dataclass(frozen=True)
class Unusable:
    """A run that is in no statistic, and why."""

    reasons: tuple[str, ...]  # a sentence each, which begins with the folder
    is_damaged: bool = True  # or it is not finished
    agent: str | None = None  # None where the manifest does not say
    env: str | None = None


def find_runs(paths: Sequence[Path]) -> tuple[list[Path], list[str]]:
    """The folders of runs at or below the paths, each once, and a sentence for every path without any."""
    folders: dict[Path, Path] = {}  # by what they really are
    problems: list[str] = []
    for path in dict.fromkeys(paths):
        try:
            check_is_folder(path, "a run, of a sweep, or one above them")
        except InputError as error:
            problems.append(str(error))
            continue
        found = sorted(_search(path, problems))
        for folder in found:
            folders.setdefault(folder.resolve(), folder)
        if not found:
            where = f"no {MANIFEST} in it or below it (links to folders are not followed)"
            problems.append(f"{path}: contains no run: {where}")
    return list(folders.values()), problems


def _search(top: Path, problems: list[str]) -> Iterator[Path]:
    """The runs at or below one folder; a run whose manifest is lost is one, too."""
    entries = 0

    def refused(error: OSError) -> None:
        problems.append(f"{error.filename}: cannot be searched ({error.strerror})")

    for name, inner, files in os.walk(top, onerror=refused):
        if not {MANIFEST, CURVE, VISITS}.isdisjoint(files):
            yield Path(name)
        entries += len(inner) + len(files)
        if entries > MOST_ENTRIES:
            most = f"contains more than {MOST_ENTRIES:,} files and folders; the rest was not searched"
            problems.append(f"{top}: {most}; name the folders of the runs")
            return
        inner.sort()


def read(folder: Path) -> Evidence | Unusable:
    """Read the run in `folder`, every file that its manifest vouches for; nothing is raised."""
    try:
        run = read_run(folder)
    except InputError as error:
        return Unusable((str(error),))
    sections = (run.manifest["config"].get(key) for key in ("agent", "env"))
    agent, env = (section if isinstance(section, dict) else {} for section in sections)
    names = (agent.get("name"), env.get("layout") or env.get("id") or env.get("source"))
    named = [plain_name(name) if isinstance(name, str) else None for name in names]
    if not run.is_finished:
        return Unusable((_unfinished(run),), False, *named)
    damaged = run.damage()
    try:
        if not damaged.keys() & {CURVE, SUMMARY}:
            return _evidence(run, tuple(damaged.values()))
    except InputError as error:
        damaged = {"": str(error)} | damaged
    return Unusable(tuple(damaged.values()), True, *named)


def _unfinished(run: RunReader) -> str:
    """How far a run came, and why it ended."""
    status, cause = run.manifest["status"][:_LONGEST_NAME], run.manifest.get("error")
    why = f": {' '.join(cause.split())[:300]}" if cause else ""
    why = ": it is still running or was killed" if status == "running" else why
    try:
        steps = f"{_read_curve(run)['step'][-1]:,.0f} steps"
        why += f" (last evaluated after {steps}, according to the unverified {CURVE})"
    except InputError:
        pass  # it has not been evaluated
    return f"{run.folder}: this run is {status!r}, not finished{why}"


def _evidence(run: RunReader, damaged: tuple[str, ...]) -> Evidence:
    manifest, config = run.manifest, run.manifest["config"]
    if not isinstance(config.get("env"), dict):
        raise InputError(
            f"{run.manifest_file}: config.env must be the settings of the world; was it written by another "
            "version?"
        )
    summary, versions = run.read_summary(), manifest.get("versions")
    since, first = (
        math.inf if summary[key] is None else float(summary[key])
        for key in ("certified_since_step", "first_certified_step")
    )
    return Evidence(
        folder=run.folder,
        agent=plain_name(summary["agent"]),
        env=plain_name(summary["env"]),
        seed=summary["seed"],
        # Dotted names, and values as JSON.
        settings={
            printable(key): printable(value if isinstance(value, str) else json.dumps(value, sort_keys=True))
            for key, value in flat(config)
            if value or key not in NEWER
        },
        world=config["env"],
        layout="\n".join(manifest["layout"]),
        gamma=float(summary["gamma"]),
        optimal_value=float(summary["optimal_value"]),
        certified=summary["certified"],
        certified_since_step=since,
        first_certified_step=first,
        seconds=float(summary["train_seconds"]),
        started=str(manifest.get("started", ""))[:10],
        version=plain_name(str(versions.get("gridworld", "?"))) if isinstance(versions, dict) else "?",
        curve=_read_curve(run),
        pictures=run.pictures(),
        step_limit=summary.get("max_episode_steps"),
        privileges=privileges(config),
        recipe=recipe if isinstance(recipe := summary.get("recipe"), str) else None,
        proven_regret=proven if isinstance(proven := summary.get("proven_regret"), float) else None,
        scope=printable(scope_of(summary))[:_LONGEST_SCOPE],
        damage=damaged,
    )


def plain_name(text: str) -> str:
    """A name out of a file, with control characters escaped, and of 80 characters at most."""
    return plain(text)[:_LONGEST_NAME]


def _read_curve(run: RunReader) -> dict[str, FloatArray]:
    """The columns that the statistics need: those in `REQUIRED`, and optional ones that the file has."""
    curve = read_columns(run, (*REQUIRED, *(metric.name for metric in REPORTED), SAMPLED_RETURN, ONLINE))
    curve["regret"] = np.maximum(0.0, curve["regret"])  # below zero is rounding
    return curve
