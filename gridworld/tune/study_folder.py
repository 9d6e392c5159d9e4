"""A study's folder: whose it is, and what it says of the search.

search.json     the study's name and what makes its trials comparable, from its beginning on
trials.csv      a row per trial that has ended
study.json      what was searched and what came of it, with the checksum of trials.csv
confirm/        the held-out runs; see `confirmation`
experiment/     the winner as a recipe; see `recipe`
study.db        Optuna's storage, unless tune.storage names another
.lock           held by the command at work, unless the study is in a database that others share

The tables are made anew from the storage, which may be elsewhere, or be deleted. The report reads them, so
that it needs neither Optuna nor the database.
"""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from statistics import fmean
from typing import Any

import optuna
from optuna.trial import FrozenTrial, TrialState

from gridworld.errors import InputError
from gridworld.process.console import recorded_command_line
from gridworld.report.tuning_study import STUDY_JSON, TRIALS_CSV, TRIALS_SUM
from gridworld.run.folder import LOCK, MANIFEST, SWEEP_JSON, alone_in, check_writable
from gridworld.run.provenance import versions
from gridworld.storage.atomic_write import check_no_links, make_folder, tidy, write_json, write_text
from gridworld.storage.csv_text import csv_text
from gridworld.storage.safe_read import LARGEST_CSV, file_sha256, read_sealed, sealed
from gridworld.tune.confirmation import CONFIRM
from gridworld.tune.objective import ERROR, SEEDS, WORKER
from gridworld.tune.recipe import EXPERIMENT
from gridworld.tune.search_space import SearchSpace
from gridworld.tune.study_spec import StudySpec

SEARCH_JSON = "search.json"
_STATUSES = {TrialState.COMPLETE: "done", TrialState.PRUNED: "pruned", TrialState.FAIL: "failed"}


def check_study_folder(folder: Path) -> None:
    """Raise `InputError` for a folder of something else, one that cannot be written, or links in it."""
    for name, kind in ((MANIFEST, "a single run"), (SWEEP_JSON, "a sweep")):
        if (folder / name).exists():
            raise InputError(f"{folder}: is the folder of {kind}; choose another tune.folder")
    check_writable(folder, "tune.folder")
    for names in ((), (CONFIRM,), (EXPERIMENT,)):
        check_no_links(folder, *names)


@contextlib.contextmanager
def at_work_in(folder: Path, is_shared: bool = False) -> Iterator[None]:
    """Make the folder and hold it, unless others share the study; one that stays empty is removed."""
    make_folder(folder)
    try:
        with contextlib.nullcontext() if is_shared else alone_in(folder):
            if not is_shared:
                tidy(folder)
            yield
    finally:
        with contextlib.suppress(OSError):
            if [path.name for path in folder.iterdir()] == [LOCK]:
                (folder / LOCK).unlink()
            folder.rmdir()


def is_claimed(folder: Path, name: str) -> bool:
    """Whether the folder is the named study's already."""
    if not os.path.lexists(folder / SEARCH_JSON):
        return False
    owner = read_sealed(folder / SEARCH_JSON).get("study")
    if owner != name:
        raise InputError(
            f"{folder}: is the folder of the study {owner}; choose another tune.folder, or tune.study={owner}"
        )
    return True


def claim(folder: Path, name: str, about: Mapping[str, Any]) -> None:
    """Write that the folder is this study's."""
    write_json(folder / SEARCH_JSON, sealed({"study": name, "about": about}), durable=True)


def write_trials(folder: Path, study: optuna.Study, space: SearchSpace, durable: bool = False) -> None:
    """Write a row per trial, with its values as a run would get them; `durable` as for `replacing`."""
    rows = []
    for trial in study.get_trials(deepcopy=False, states=tuple(_STATUSES)):
        values = space.values(trial.params)
        rows.append(_row(trial) | {key: values.get(key, "") for key in space.dimensions})
    head = [*_row(optuna.create_trial(state=TrialState.FAIL)), *space.dimensions]
    write_text(folder / TRIALS_CSV, csv_text([head, *(list(row.values()) for row in rows)]), durable)


def _row(trial: FrozenTrial) -> dict[str, Any]:
    seeds = trial.user_attrs.get(SEEDS, [])
    steps = [seed["certified_since"] for seed in seeds if seed["certified_since"] is not None]
    value = trial.value
    if trial.state == TrialState.PRUNED and trial.intermediate_values:
        value = trial.intermediate_values[max(trial.intermediate_values)]
    duration = trial.duration
    return {
        "trial": trial.number,
        "status": _STATUSES[trial.state],
        "score": "" if value is None or math.isnan(value) else f"{value:.6f}",
        "certified": f"{len(steps)}/{len(seeds)}" if seeds else "",
        "steps": round(fmean(steps)) if steps else "",
        "regret": f"{fmean(seed['regret'] for seed in seeds):.6g}" if seeds else "",
        "seconds": "" if duration is None else f"{duration.total_seconds():.2f}",
        "worker": trial.user_attrs.get(WORKER, ""),
        "error": trial.user_attrs.get(ERROR, ""),
    }


def write_study(spec: StudySpec, study: optuna.Study, outcome: dict[str, Any]) -> None:
    """Write what was searched, and the `outcome`: the winner, the finalists and the confirmation."""
    content = {
        "study": spec.name,
        "agent": spec.base.agent.name,
        "env": spec.base.env.name,
        "command": recorded_command_line(),
        "versions": versions() | {"optuna": optuna.__version__},
        "total_timesteps": spec.base.total_timesteps,
        "seeds": list(spec.objective.seeds),
        "space": spec.space.plain(),
        "began_from": spec.space.parameters_of(spec.base),
        "importances": _importances(study),
        **outcome,
        TRIALS_SUM: file_sha256(spec.folder / TRIALS_CSV, LARGEST_CSV),
    }
    write_json(spec.folder / STUDY_JSON, sealed(content), durable=True)


def _importances(study: optuna.Study) -> dict[str, float]:
    """The importance of each key, by Optuna's PED-ANOVA; empty where there are too few trials for it."""
    complete = study.get_trials(deepcopy=False, states=[TrialState.COMPLETE])
    if len(complete) < 4 or len({trial.value for trial in complete}) < 2:
        return {}
    evaluator = optuna.importance.PedAnovaImportanceEvaluator()
    found = optuna.importance.get_param_importances(study, evaluator=evaluator)
    return {key: round(float(share), 6) for key, share in found.items() if math.isfinite(share)}
