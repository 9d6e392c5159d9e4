"""A study from its beginning to its verdict."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import sys
import time
from pathlib import Path
from typing import Any

import optuna
from optuna.trial import TrialState

from gridworld.config import AgentConfig
from gridworld.errors import InputError
from gridworld.report.tuning import TRIALS_CSV
from gridworld.run import MANIFEST, SWEEP_JSON, check_writable
from gridworld.sweep.report import shown
from gridworld.tune import confirm
from gridworld.tune.asked import Asked
from gridworld.tune.crew import cores, run_crew
from gridworld.tune.progress import SearchProgress
from gridworld.tune.recipe import RECIPE, Source, write_recipe
from gridworld.tune.records import write_study
from gridworld.tune.space import with_values
from gridworld.tune.storage import begin, open_storage, open_study, standing
from gridworld.tune.trial import Objective
from gridworld.tune.worker import Task, search


def tune(asked: Asked, conf: Path, config_dir: Path | None) -> None:
    """Run what the study lacks. Raises `InputError`, nothing run, and `Interrupted`."""
    _check_folder(asked.folder)
    settings = asked.settings
    made = not asked.folder.exists()
    asked.folder.mkdir(parents=True, exist_ok=True)
    url = settings.storage or f"sqlite:///{asked.folder.absolute() / 'study.db'}"
    try:
        begin(open_storage(settings, url), asked.name, _about(asked), asked.space.parameters_of(asked.base))
    except InputError:
        if made:
            with contextlib.suppress(OSError):
                asked.folder.rmdir()
        raise
    task = Task(
        asked.folder,
        url,
        asked.name,
        settings,
        Objective(asked.base, asked.space, asked.seeds, settings.reports, settings.stop_after),
        time.time() + (settings.timeout or float("inf")),
    )
    study = open_study(settings, url, asked.name)
    workers = cores(settings.workers)
    progress = SearchProgress(asked, study)
    try:
        if standing(study).ended < settings.trials:
            progress.begin(workers)
            run_crew(search, task, min(workers, settings.trials), progress.look)
    finally:
        progress.end()
    _conclude(asked, study, conf, config_dir, workers)


def _check_folder(folder: Path) -> None:
    for name, kind in ((MANIFEST, "a single run"), (SWEEP_JSON, "a sweep")):
        if (folder / name).exists():
            raise InputError(f"{folder}: is the folder of {kind}; choose another tune.folder")
    check_writable(folder, "tune.folder")


def _about(asked: Asked) -> dict[str, Any]:
    """What makes trials comparable; the study of another is refused."""
    settings = dataclasses.asdict(asked.base)
    for without_effect in ("logging", "recording", "seed"):
        del settings[without_effect]
    flat = dict(_flat(settings))
    return {
        "search space": asked.space.plain(),
        "configuration": {key: value for key, value in flat.items() if value is not None},
        "objective": {
            "seeds": list(asked.seeds),
            "stop_after": asked.settings.stop_after,
            "reports": asked.settings.reports,
        },
    }


def _flat(content: dict[str, Any], prefix: str = "") -> Any:
    for key, value in content.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield prefix + key, value


def _conclude(asked: Asked, study: optuna.Study, conf: Path, config_dir: Path | None, workers: int) -> None:
    """Confirm the winner, write it down, and tell."""
    if not study.get_trials(deepcopy=False, states=[TrialState.COMPLETE]):
        raise InputError(
            f"{shown(asked.folder)}: none of {standing(study).ended} trials came to an end; "
            f"the reasons are in {TRIALS_CSV}"
        )
    best = study.best_trial
    values = asked.space.values(best.params)
    is_new = asked.space.parameters_of(asked.base) != best.params
    tuned = with_values(asked.base, values)
    tuned = dataclasses.replace(tuned, agent=_named(tuned.agent)) if is_new else asked.base
    winner = confirm.jobs(asked.folder, f"trial={best.number}", tuned, asked.held_out)
    began_from = confirm.jobs(asked.folder, "default", asked.base, asked.held_out)
    verdict = _confirm(asked, winner if is_new else [], began_from, workers)
    about = f"the best of {standing(study).ended} trials; study.json has what came of it"
    recipe = write_recipe(asked.folder, Source(conf, config_dir), asked.choices, tuned, about)
    found = {"trial": best.number, "score": best.value, "values": values}
    write_study(asked, study, {"winner": found, "confirmation": verdict})
    _tell(asked, values, verdict["sentence"], recipe)


def _named(agent: AgentConfig) -> AgentConfig:
    """So that a report tells it from what it was before."""
    return dataclasses.replace(agent, name=f"{agent.name}_tuned")


def _confirm(
    asked: Asked, winner: list[confirm.Job], began_from: list[confirm.Job], workers: int
) -> dict[str, Any]:
    """Run both; without a winner there is nothing to compare."""
    runs = [job for pair in itertools.zip_longest(began_from, winner) for job in pair if job is not None]
    count = len(began_from)
    print(f"{len(runs)} runs on {count} held-out seeds confirm the winner", file=sys.stderr, flush=True)
    confirm.prepare(asked.folder, runs)
    run_crew(confirm.work, runs, min(workers, len(runs)), lambda: None)
    before = confirm.sample(began_from)
    if winner:
        return confirm.compare(confirm.sample(winner), before, "the winner")
    return {
        "verdict": "is",
        "sentence": f"No trial came out better than the settings that the search began from: on {count} "
        f"held-out seeds these are {before.text()}.",
    }


def _tell(asked: Asked, values: dict[str, Any], sentence: str, recipe: Path) -> None:
    before = asked.space.parameters_of(asked.base) or {}
    width = max(map(len, values))
    print("winner:")
    for key, value in values.items():
        was = f"  (was {before[key]})" if key in before and before[key] != value else ""
        print(f"  {key:<{width}}  {value}{was}")
    where = shown(asked.folder)
    print(f"{sentence}\n  recipe: {shown(recipe)}")
    print(f"  train it: python scripts/train.py --config-dir {where} experiment={RECIPE}")
    print(f"  look at it: python scripts/report.py {where}", flush=True)
