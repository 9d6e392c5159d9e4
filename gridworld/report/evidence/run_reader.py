"""Reading a run for a report. Its folder is data: JSON and CSV, read within bounds, nothing imported."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gridworld.config.flatten import flat
from gridworld.config.privileges import privileges
from gridworld.config.settings_by_effect import is_newer
from gridworld.config.train import TrainConfig
from gridworld.errors import InputError
from gridworld.process.console.terminal import printable
from gridworld.report.evidence.curve_reader import read_curve
from gridworld.run.folder import CURVE, SUMMARY
from gridworld.run.reader import RunReader, read_run
from gridworld.storage.safe_read import read_object
from gridworld.world.mdp import FloatArray

DAMAGED = "damaged"
_LONGEST_NAME = 80  # characters
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
    seconds: float  # of training
    started: str  # the date
    version: str  # of this package; "?" where the manifest does not say
    curve: Mapping[str, FloatArray]  # (evaluations,): `curve_reader.REQUIRED`, and what else the file has
    pictures: Mapping[str, str | None]  # as `RunReader.pictures`
    step_limit: Any = None  # of an episode, as the summary has it
    privileges: Sequence[str] = ()  # as `config.privileges` finds them in its settings
    damage: tuple[str, ...] = ()  # a sentence for each of its other files that is not the one that it wrote

    @property
    def steps(self) -> int:
        """Environment steps at the last evaluation."""
        return int(self.curve["step"][-1])

    @property
    def certified(self) -> bool:
        """Whether the final greedy policy is optimal."""
        return bool(self.curve["certified"][-1])

    @property
    def regret(self) -> float:
        """The final greedy policy's regret; exactly 0 for a certified one, so that two of them are a tie."""
        return 0.0 if self.certified else round(float(self.curve["regret"][-1]), _DIGITS)

    @property
    def first_certified_step(self) -> float:
        """Environment steps at the first certificate; infinite where there was none."""
        hits = np.flatnonzero(self.curve["certified"])
        return float(self.curve["step"][hits[0]]) if len(hits) else math.inf


@dataclass(frozen=True)
class Unusable:
    """A run that is in no statistic, and why."""

    folder: Path
    reasons: tuple[str, ...]  # a sentence each, which begins with the folder
    state: str = DAMAGED  # or how the run stands that is not finished
    agent: str | None = None  # as in `Evidence`; None, as those below, where no file says so
    env: str | None = None
    seed: int | None = None
    settings: Settings | None = None
    layout: str | None = None


def read(folder: Path) -> Evidence | Unusable:
    """Read the run in `folder`, every file that its manifest vouches for.

    Returns:
        What the statistics need of it, or the reasons why it cannot be used; nothing is raised.
    """
    try:
        run = read_run(folder)
    except InputError as error:  # what it is of, its summary may still say, though unverified
        try:
            told = read_object(folder / SUMMARY)
        except InputError:
            told = {}
        agent, env = _name_in(told, "agent"), _name_in(told, "env")
        return Unusable(folder, (str(error),), agent=agent, env=env, seed=_whole_in(told, "seed"))
    config = run.manifest["config"]
    names = (_name_in(config.get("env"), key) for key in ("layout", "id", "source"))
    unusable = Unusable(
        folder,
        (),
        agent=_name_in(config.get("agent"), "name"),
        env=next(filter(None, names), None),
        seed=_whole_in(config, "seed"),
        settings=dict(_settings(config)),
        layout="\n".join(run.manifest["layout"]),
    )
    if not run.is_finished:
        state = _printable(run.manifest["status"])
        return dataclasses.replace(unusable, reasons=(_unfinished(run),), state=state)
    damaged = run.damage()
    try:
        if not damaged.keys() & {CURVE, SUMMARY}:
            return dataclasses.replace(_evidence(run), damage=tuple(damaged.values()))
    except InputError as error:
        damaged = {"": str(error)} | damaged
    return dataclasses.replace(unusable, reasons=tuple(damaged.values()))


def _evidence(run: RunReader) -> Evidence:
    folder, manifest, where = run.folder, run.manifest, run.manifest_file
    config = manifest["config"]
    if not isinstance(config.get("env"), dict):
        raise InputError(f"{where}: has no settings of the world under config; is it of another version?")
    summary, curve, seed = run.read_summary(), read_curve(run), config.get("seed")
    if _whole_in(config, "seed") is None:
        raise InputError(f"{where}: config.seed={seed!r} must be a whole number")
    versions = manifest.get("versions")
    evidence = Evidence(
        folder=folder,
        agent=_text(config.get("agent"), "name", f"{where}: config.agent"),
        env=_text(summary, "env", str(folder / SUMMARY)),
        seed=seed,
        settings=dict(_settings(config)),
        world=config["env"],
        layout="\n".join(manifest["layout"]),
        gamma=_number(config.get("evaluation"), "gamma", f"{where}: config.evaluation"),
        optimal_value=_number(summary, "optimal_value", str(folder / SUMMARY)),
        seconds=_number(summary, "train_seconds", str(folder / SUMMARY)),
        started=str(manifest.get("started", ""))[:10],
        version=_printable(str(versions.get("gridworld", "?"))) if isinstance(versions, dict) else "?",
        curve=curve,
        pictures=run.pictures(),
        step_limit=summary.get("max_episode_steps"),
        privileges=privileges(TrainConfig, config),
    )
    last, told = evidence.curve["regret"][-1], summary.get("regret")
    same = told is None and not math.isfinite(last)
    if isinstance(told, int | float):
        same = math.isclose(told, last, rel_tol=1e-9, abs_tol=1e-12)
    ends = evidence.certified, evidence.steps
    if not same or (summary.get("certified"), summary.get("timesteps")) != ends:
        raise InputError(
            f"{folder}: {CURVE} ends at step {evidence.steps:,} with regret {last:.6g}, {SUMMARY} "
            "says otherwise; one of them was changed or cut off"
        )
    return evidence


def _unfinished(run: RunReader) -> str:
    """How a run stands, and how far its curve goes, which has no checksum."""
    status, told = run.manifest["status"], run.manifest.get("error")
    why = f": {' '.join(told.split())[:300]}" if told else ""
    if status == "running":
        why = ": it is still going on, or was killed"
    sentence = f"{run.folder}: this run is {status[:_LONGEST_NAME]!r}, not finished{why}"
    try:
        steps = int(read_curve(run)["step"][-1])
    except InputError:
        return sentence
    sentence += f" (last evaluated after {steps:,} steps, says {CURVE}"
    return f"{sentence}, which is not verified before the end)"


def _settings(config: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Dotted names, and values as JSON."""
    for key, value in flat(config):
        if value or not is_newer(key):
            text = value if isinstance(value, str) else json.dumps(value, sort_keys=True)
            yield printable(key), printable(text)


def _printable(text: str) -> str:
    return "".join(sign if sign.isprintable() else "?" for sign in text)[:_LONGEST_NAME]


def _in(content: Any, key: str) -> Any:
    return content.get(key) if isinstance(content, dict) else None


def _text(content: Any, key: str, where: str) -> str:
    value = _in(content, key)
    if not isinstance(value, str) or not value.strip():
        raise InputError(f"{where}: {key}={value!r} must be a name; is it of another version?")
    return _printable(value)


def _number(content: Any, key: str, where: str) -> float:
    value = _in(content, key)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{where}: {key}={value!r} must be a number; is it of another version?")
    return float(value)


def _name_in(content: Any, key: str) -> str | None:
    value = _in(content, key)
    return _printable(value) if isinstance(value, str) else None


def _whole_in(content: Any, key: str) -> int | None:
    value = _in(content, key)
    return value if type(value) is int else None
