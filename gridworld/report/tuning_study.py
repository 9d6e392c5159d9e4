"""A tuning study on disk: study.json and trials.csv, read within bounds as a run's files are."""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gridworld.base.console import plain
from gridworld.base.errors import InputError
from gridworld.base.safe_read import LARGEST_CSV, as_table, csv_rows, read_bytes, read_sealed, sha256
from gridworld.base.user_input import check_memory

STUDY_JSON, TRIALS_CSV = "study.json", "trials.csv"
TRIALS_SUM = "trials_sha256"  # in the former, of the latter
_OF_A_TRIAL = 6000  # bytes of memory that one comes to in the tables and figures of a page


@dataclass(frozen=True)
class TrialRow:
    """A trial as trials.csv has it."""

    number: int
    status: str
    score: float  # NaN where it has none
    row: Mapping[str, str]  # all columns, what was chosen by its key


@dataclass(frozen=True, eq=False, repr=False)
class TuningStudy:
    """A finished study."""

    folder: Path
    name: str
    agent: str
    env: str
    sentence: str  # the verdict
    winner: int  # its trial
    values: Mapping[str, Any]  # the winner's
    began_from: Mapping[str, Any]  # the same keys before; empty where that was outside the space
    space: Mapping[str, Mapping[str, Any]]
    importances: Mapping[str, float]
    finalists: Sequence[Sequence[str | float]]  # trial, score, certified; the winner first
    trials: Sequence[TrialRow]

    def __repr__(self) -> str:
        return f"TuningStudy({str(self.folder)!r}, {dict(self.values)}: {self.sentence})"

    @property
    def title(self) -> str:
        """Of its section."""
        return f"Tuning {self.agent} on {self.env}"

    @property
    def scored(self) -> list[TrialRow]:
        """Those that have a score."""
        return [
            each for each in self.trials if each.status in ("done", "pruned") and math.isfinite(each.score)
        ]


def find_tunings(paths: Sequence[Path]) -> tuple[list[TuningStudy], list[str]]:
    """Read the studies in these folders and right below them; a sentence for each that cannot be read."""
    found: dict[Path, TuningStudy] = {}
    problems = []
    for path in paths:
        below = sorted(path.iterdir()) if path.is_dir() and os.access(path, os.R_OK) else []
        for folder in [path, *(each for each in below if each.is_dir() and not each.is_symlink())]:
            file = folder / STUDY_JSON
            if os.path.lexists(file):
                try:
                    found.setdefault(file.resolve(), _read(folder))
                except InputError as error:
                    problems.append(str(error))
    return list(found.values()), problems


def _read(folder: Path) -> TuningStudy:
    file, trials = folder / STUDY_JSON, folder / TRIALS_CSV
    content, of_trials = read_sealed(file), read_bytes(trials, LARGEST_CSV)
    if content.get(TRIALS_SUM, digest := sha256(of_trials)) != digest:  # the first format has none
        raise InputError(
            f"{trials}: does not match {STUDY_JSON}; it was changed or damaged, or a continued search has "
            "not finished"
        )
    table = as_table(of_trials, trials)
    check_memory(trials, _OF_A_TRIAL * table.count("\n"))
    try:
        head, *rows = csv_rows(table)
        name, agent, env = (_text(content[key])[:80] for key in ("study", "agent", "env"))
        space = {str(key): _dimension(dimension) for key, dimension in content["space"].items()}
        return TuningStudy(
            folder=folder,
            name=name,
            agent=agent,
            env=env,
            sentence=_text(content["confirmation"]["sentence"]),
            winner=int(content["winner"]["trial"]),
            values=dict(content["winner"]["values"]),
            began_from=dict(content["began_from"] or {}),
            space=space,
            finalists=[_finalist(each) for each in content["finalists"]],
            importances={str(key): float(share) for key, share in content["importances"].items()},
            trials=[_trial(dict(zip(head, row, strict=True)), space) for row in rows],
        )
    except (KeyError, TypeError, ValueError, AttributeError, csv.Error) as error:
        raise InputError(f"{file}: is not a finished study, or was changed ({error!r})") from None


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError(f"{str(value)[:40]} is not a text")
    return plain(value)


def _finalist(content: Mapping[str, Any]) -> tuple[str, float, str]:
    failed = int(content.get("failed", 0))
    certified = f"{content['certified']} / {content['seeds']}" + (f", {failed} failed" if failed else "")
    return str(int(content["trial"])), float(content["score"]), certified


def _dimension(content: Mapping[str, Any]) -> dict[str, Any]:
    if content["type"] == "categorical":
        return {"type": "categorical", "choices": [str(choice) for choice in content["choices"]]}
    low, high, log = float(content["low"]), float(content["high"]), bool(content["log"])
    if not (0 if log else -math.inf) < low < high < math.inf:
        raise ValueError(f"a range from {low} to {high}")
    return {"type": str(content["type"]), "low": low, "high": high, "log": log}


def _trial(row: Mapping[str, str], space: Mapping[str, Mapping[str, Any]]) -> TrialRow:
    for key, dimension in space.items():
        if row[key] and dimension["type"] != "categorical" and not float(row[key]) >= dimension["low"]:
            raise ValueError(f"{key}={row[key]}")
    return TrialRow(int(row["trial"]), row["status"], float(row["score"] or "nan"), row)
