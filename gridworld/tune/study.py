"""A study from its beginning to its verdict: search, finalists, confirmation."""

from __future__ import annotations

import dataclasses
import itertools
import shlex
import signal
from pathlib import Path
from typing import Any

import optuna
from optuna.trial import FrozenTrial

from gridworld.config.compose import search_path
from gridworld.config.recipe_file import TRUST, overrides
from gridworld.config.train import TrainConfig
from gridworld.errors import InputError
from gridworld.process.console import command, printable, tell
from gridworld.process.processes import can_fork
from gridworld.process.signals import Interrupted, exiting
from gridworld.report.writer import write_over_seeds
from gridworld.run.folder import LOCK
from gridworld.storage.atomic_write import is_locked
from gridworld.sweep.console import shell_path
from gridworld.sweep.plan import may_fork
from gridworld.training.setup import import_for
from gridworld.training.tensorboard import hparams
from gridworld.tune.confirmation import (
    CONFIRM,
    Finalist,
    HeldOutRun,
    HeldOutRuns,
    choose_finalists,
    held_out_runs,
    prepare,
    rank_finalists,
    read_results,
    verdict_on,
)
from gridworld.tune.objective import ERROR, with_values
from gridworld.tune.search import in_reach, open_study, search, study_url
from gridworld.tune.study_folder import (
    at_work_in,
    check_study_folder,
    claim,
    is_claimed,
    write_recipe,
    write_study,
)
from gridworld.tune.study_spec import StudySpec
from gridworld.tune.workers import SearchError, Workers


def tune(spec: StudySpec) -> None:
    """Run what the study lacks, confirm the winner, and write and print what came of it."""
    check_study_folder(spec.folder)
    is_shared = spec.settings.storage is not None
    try:
        with at_work_in(spec.folder, is_shared), exiting(signal.SIGINT, signal.SIGTERM):
            _tune(spec)
    except SystemExit as stop:
        raise Interrupted(int(str(stop.code)) - 128) from None


def _tune(spec: StudySpec) -> None:
    url, about = study_url(spec), _about(spec)
    is_begun = is_claimed(spec.folder, spec.name)
    study = open_study(url, spec.name, about, spec.space, must_exist=is_begun)
    claim(spec.folder, spec.name, about)
    workers = Workers(int(spec.settings.workers), can_fork() and may_fork(spec.base))
    if workers.forks:
        import_for(spec.base)  # once for all of them
    with in_reach(url):
        search(spec, study, workers)
        trials = choose_finalists(study, spec)
        if not trials:
            errors = [error for trial in study.trials if (error := trial.user_attrs.get(ERROR))]
            why = f"all {len(errors)} failed, the first: {errors[0]}" if errors else "there was no time"
            raise SearchError(f"{shell_path(spec.folder)}: no trial came to a score; {why}")
        ranked = rank_finalists(spec, study, trials, workers)
        best = next(trial for trial in trials if trial.number == ranked[0].trial)
        _conclude(spec, study, best, ranked, workers)


def _about(spec: StudySpec) -> dict[str, Any]:
    """What makes trials comparable, as JSON; a study of anything else is refused."""
    settings = {key: value for key, value in hparams(spec.base).items() if value is not None}
    del settings["seed"]
    return {
        "search space": spec.space.plain(),
        "configuration": settings | {"map": spec.base.env.compile().text()},
        "objective": {
            "seeds": list(spec.objective.seeds),
            "stop_after": spec.settings.stop_after,
            "evaluations": spec.settings.evaluations,
            "reports": spec.settings.reports,
        },
    }


def _conclude(
    spec: StudySpec, study: optuna.Study, best: FrozenTrial, ranked: list[Finalist], workers: Workers
) -> None:
    """Confirm the winner, write the recipe and study.json, and print the outcome."""
    values, before = spec.space.values(best.params), spec.space.parameters_of(spec.base)
    is_new = before != best.params
    tuned = _tuned(spec.base, values) if is_new else spec.base
    measured, name = spec.objective.base, f"trial={best.number}"
    winner = held_out_runs(spec.folder, name, _tuned(measured, values), spec.held_out) if is_new else []
    began_from = held_out_runs(spec.folder, "default", measured, spec.held_out)
    confirmed = _confirm(spec, winner, began_from, workers)
    about = f"the best of {len(study.trials)} trials; study.json has what came of it"
    recipe = write_recipe(spec.folder, spec.folders, spec.choices, tuned, about)
    outcome = {
        "winner": {"trial": best.number, "score": best.value, "values": values},
        "finalists": [dataclasses.asdict(finalist) for finalist in ranked],
        "confirmation": confirmed,
    }
    write_study(spec, study, outcome)
    lines = ["winner:"]
    for key, value in values.items():
        was = f"  (was {before[key]})" if before and before[key] != value else ""
        lines.append(f"  {key:<{max(map(len, values))}}  {value}{was}")
    train_it = f"{command('train')} recipe={shell_path(spec.folder)} {_words_for(recipe, spec)}".rstrip()
    lines += [confirmed["sentence"], f"  recipe: {shell_path(recipe)}", f"  train it: {train_it}"]
    runs = spec.folder / CONFIRM
    if (over_seeds := write_over_seeds(runs, spec.folder)) is not None:
        folders = f"{shell_path(over_seeds)}  (of each run: {shell_path(runs)})"
        lines.append(f"  curves over seeds: tensorboard --logdir {folders}")
    lines.append(f"  look at it: {command('report')} {shell_path(spec.folder)}")
    print(*map(printable, lines), sep="\n", flush=True)


def _words_for(recipe: Path, spec: StudySpec) -> str:
    """What train.py needs with the recipe: the user's own folders, and trust in the user's own classes."""
    words = [search_path(spec.folders.own)] if spec.folders.own else []
    try:
        overrides(recipe)
    except InputError:
        words.append(f"{TRUST}=true")
    return shlex.join(words)


def _tuned(config: TrainConfig, values: dict[str, Any]) -> TrainConfig:
    """The tuned configuration, with an agent's name of its own, by which a report tells it apart."""
    tuned = with_values(config, values)
    agent = dataclasses.replace(tuned.agent, name=f"{tuned.agent.name}_tuned")
    return dataclasses.replace(tuned, agent=agent)


def _confirm(
    spec: StudySpec, winner: list[HeldOutRun], began_from: list[HeldOutRun], workers: Workers
) -> dict[str, Any]:
    """Run both and compare them; an empty `winner` is for settings that the search began from."""
    runs = [run for pair in itertools.zip_longest(began_from, winner) for run in pair if run is not None]
    count = len(began_from)
    tell(f"{len(runs)} runs on {count} held-out seeds confirm the winner")
    prepare(spec.folder, runs)
    while runs:
        shares = workers.shares(runs, spec.base.agent.shape is not None)
        workers.run_all(HeldOutRuns(tuple(share)) for share in shares)
        runs = [run for run in runs if is_locked(run.folder / LOCK)]  # another machine is at work on them
    before = read_results(began_from)
    if winner:
        return verdict_on(read_results(winner), before, "the winner")
    return {
        "verdict": "is",
        "sentence": f"No trial came out better than the settings that the search began from: on {count} "
        f"held-out seeds these are {before.text()}.",
    }
