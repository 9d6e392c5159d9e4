"""A study from its beginning to its verdict."""

from __future__ import annotations

import dataclasses
import sys
import time
from pathlib import Path
from typing import Any

import optuna
from optuna.trial import TrialState

from gridworld.config import TrainConfig
from gridworld.errors import InputError
from gridworld.lock import locked
from gridworld.run import MANIFEST, SWEEP_JSON, check_writable
from gridworld.sweep.progress import duration
from gridworld.sweep.report import shown
from gridworld.tune import confirm
from gridworld.tune.asked import Asked
from gridworld.tune.crew import cores, run_crew
from gridworld.tune.recipe import RECIPE, write_recipe
from gridworld.tune.records import TRIALS_CSV, write_study, write_trials
from gridworld.tune.space import with_values
from gridworld.tune.storage import Standing, begin, open_storage, open_study, standing
from gridworld.tune.trial import Objective
from gridworld.tune.worker import Task, search

_SECONDS_BETWEEN_TABLES = 2.0
_SECONDS_BETWEEN_LINES = 10.0
_CLEAR_TO_END = "\x1b[K"


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
    progress = _Progress(asked, study)
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


def _conclude(
    asked: Asked, study: optuna.Study, conf: Path, config_dir: Path | None, workers: int
) -> None:
    """Confirm the winner, write it down, and tell."""
    folder = asked.folder
    counts = standing(study)
    if not study.get_trials(deepcopy=False, states=[TrialState.COMPLETE]):
        write_study(asked, study, {"winner": None})
        raise InputError(
            f"{shown(folder)}: no trial of {counts.ended} came to an end; the reasons are in {TRIALS_CSV}"
        )
    best = study.best_trial
    values = asked.space.values(best.params)
    tuned = _named(with_values(asked.base, values), f"{asked.base.agent.name}_tuned")
    outcome: dict[str, Any] = {
        "winner": {"trial": best.number, "score": best.value, "values": values},
        "counts": dataclasses.asdict(counts),
    }
    name = f"trial={best.number}"
    sides = [confirm.jobs(folder, "default", asked.base, asked.held_out)]
    is_new = asked.space.parameters_of(asked.base) != best.params
    if is_new:
        sides.append(confirm.jobs(folder, name, tuned, asked.held_out))
    confirm.clear_others(folder, ("default", name))
    runs = [job for pair in zip(*sides, strict=True) for job in pair]
    print(f"confirming on {len(asked.held_out)} held-out seeds: {len(runs)} runs", file=sys.stderr, flush=True)
    (folder / confirm.CONFIRM).mkdir(exist_ok=True)
    run_crew(confirm.work, runs, min(workers, len(runs)), lambda: None)
    samples = [confirm.sample(side) for side in sides]
    if is_new:
        verdict = confirm.compare(samples[1], samples[0], f"trial {best.number}")
    else:
        verdict = {
            "verdict": "is",
            "sentence": f"No trial of {counts.ended} came out better than the settings that the search began "
            f"from: on {len(asked.held_out)} held-out seeds {samples[0].text()}.",
        }
    recipe = write_recipe(
        folder, conf, config_dir, asked.choices, tuned if is_new else asked.base, _summary(best.number, counts)
    )
    write_study(asked, study, {**outcome, "confirmation": verdict})
    _tell(asked, values, verdict["sentence"], recipe, config_dir)


def _named(config: TrainConfig, name: str) -> TrainConfig:
    return dataclasses.replace(config, agent=dataclasses.replace(config.agent, name=name))


def _summary(number: int, counts: Standing) -> str:
    return f"the best of {counts.ended} trials, number {number}; study.json has what came of it"


def _tell(asked: Asked, values: dict[str, Any], sentence: str, recipe: Path, config_dir: Path | None) -> None:
    before = asked.space.parameters_of(asked.base) or {}
    width = max(map(len, values))
    print("winner:")
    for key, value in values.items():
        was = f"  (was {before[key]})" if key in before and before[key] != value else ""
        print(f"  {key:<{width}}  {value}{was}")
    print(sentence)
    print(f"  recipe: {shown(recipe)}")
    where = shown(asked.folder)
    if config_dir is None:
        print(f"  train it: python scripts/train.py --config-dir {where} experiment={RECIPE}")
    print(f"  look at it: python scripts/report.py {where}", flush=True)


class _Progress:
    """trials.csv, and a line on standard error, kept up to date."""

    def __init__(self, asked: Asked, study: optuna.Study) -> None:
        self._asked = asked
        self._study = study
        self._terminal = sys.stderr.isatty()
        self._started = self._wrote = self._spoke = time.monotonic()
        self._before = 0
        self._shown = False

    def begin(self, workers: int) -> None:
        """The first line."""
        self._before = standing(self._study).ended
        trials = self._asked.settings.trials
        more = f", {self._before} of them there already" if self._before else ""
        print(
            f"study {self._asked.name} in {shown(self._asked.folder)}: {trials} trials of "
            f"{len(self._asked.seeds)} seeds{more}, {workers} at once",
            file=sys.stderr,
            flush=True,
        )

    def look(self) -> None:
        """Called all the time."""
        now = time.monotonic()
        if now - self._wrote < _SECONDS_BETWEEN_TABLES:
            return
        self._wrote = now
        write_trials(self._asked.folder, self._study, self._asked.space)
        if not self._asked.base.logging.progress:
            return
        if self._terminal:
            print(f"\r{self._line(now)}{_CLEAR_TO_END}", end="", file=sys.stderr, flush=True)
            self._shown = True
        elif now - self._spoke >= _SECONDS_BETWEEN_LINES:
            self._spoke = now
            print(self._line(now), file=sys.stderr, flush=True)

    def end(self) -> None:
        """The table as it stands."""
        if self._shown:
            print(f"\r{_CLEAR_TO_END}", end="", file=sys.stderr, flush=True)
        write_trials(self._asked.folder, self._study, self._asked.space)

    def _line(self, now: float) -> str:
        counts = standing(self._study)
        trials = self._asked.settings.trials
        text = f"tune: {counts.ended} of {trials} trials, {counts.pruned} pruned, {counts.running} running"
        if counts.failed:
            text += f", {counts.failed} failed"
        if counts.complete:
            text += f", best score {self._study.best_value:.4f}"
        done = counts.ended - self._before
        if done > 0:
            text += f", about {duration((trials - counts.ended) * (now - self._started) / done)} left"
        return text
