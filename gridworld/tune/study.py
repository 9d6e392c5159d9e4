"""Running a study: search, finalists, confirmation, verdict."""

from __future__ import annotations

import dataclasses
import itertools
import math
import shlex
import sys
import time
from pathlib import Path
from typing import Any

import optuna

from gridworld.config.composition.compose import search_path
from gridworld.config.composition.recipe_file import TRUST, overrides
from gridworld.config.train import TrainConfig
from gridworld.errors import InputError
from gridworld.process.console.command_line import command
from gridworld.process.console.terminal import printable
from gridworld.report.writer import write_over_seeds
from gridworld.sweep.console import shell_path
from gridworld.training.tensorboard import hparams
from gridworld.tune.confirmation import (
    CONFIRM,
    HeldOutRun,
    HeldOutRuns,
    held_out_runs,
    prepare,
    read_results,
    run_held_out,
    verdict_on,
)
from gridworld.tune.existing_study import check_study, legible
from gridworld.tune.finalists import Finalist, FinalRuns, choose_finalists, missing, ranking, run_finals
from gridworld.tune.progress import SearchProgress
from gridworld.tune.recipe import write_recipe
from gridworld.tune.search.objective import ERROR, Objective
from gridworld.tune.search.search_space import with_values
from gridworld.tune.search.storage import StudyStorage, count_trials
from gridworld.tune.search.worker import StudyContext, run_trials
from gridworld.tune.search.worker_pool import SearchError, run_workers
from gridworld.tune.study_folder import at_work_in, check_study_folder, claim, is_claimed, write_study
from gridworld.tune.study_spec import ConfFolders, StudySpec


def tune(spec: StudySpec) -> None:
    """Run what the study lacks, confirm the winner, and write and print what came of it.

    Raises:
        InputError: the folder or the storage cannot be used; nothing was run.
        SearchError: no trial came to a score, or the workers could not go on.
        Interrupted: at Ctrl-C and SIGTERM.
    """
    check_study_folder(spec.folder)
    with at_work_in(spec.folder):
        context = _begin(spec)
        with context.storage.in_reach():
            study = context.storage.load()
            _search(spec, study, context)
            _conclude(spec, study, _rank_finalists(spec, study, context))


def _begin(spec: StudySpec) -> StudyContext:
    """Make the study, or see that the one there is of this search."""
    settings, about = spec.settings, _about(spec)
    url = settings.storage or f"sqlite:///{spec.folder.absolute() / 'study.db'}"
    storage = StudyStorage(url, spec.name, settings)
    if is_claimed(spec.folder, spec.name, about):
        with legible(storage.shown_url):
            if not storage.has_study():
                raise InputError(
                    f"{spec.folder}: is of the study {spec.name}, which {storage.shown_url} does not have; "
                    "bring its database back, or choose another tune.folder"
                )
    with legible(storage.shown_url):
        study = storage.begin(about)
        check_study(study, spec.space)
    claim(spec.folder, spec.name, about)
    objective = Objective(spec.measured, spec.space, spec.seeds, settings.reports, settings.stop_after)
    deadline = time.time() + (settings.timeout or math.inf)
    return StudyContext(spec.folder, storage, objective, deadline, spec.space.parameters_of(spec.base))


def _about(spec: StudySpec) -> dict[str, Any]:
    """What makes trials comparable, as JSON; a study of anything else is refused."""
    settings = {key: value for key, value in hparams(spec.base).items() if value is not None}
    del settings["seed"]
    return {
        "search space": spec.space.plain(),
        "configuration": settings | {"map": spec.base.env.compile().text()},
        "objective": {
            "seeds": list(spec.seeds),
            "stop_after": spec.settings.stop_after,
            "evaluations": spec.settings.evaluations,
            "reports": spec.settings.reports,
        },
    }


def _search(spec: StudySpec, study: optuna.Study, context: StudyContext) -> None:
    progress, trials = SearchProgress(spec, study), spec.settings.trials
    try:
        if count_trials(study).ended < trials:
            progress.begin()
            run_workers(run_trials, context, min(spec.settings.workers, trials), progress.look)
    finally:
        progress.end()


def _rank_finalists(spec: StudySpec, study: optuna.Study, context: StudyContext) -> list[Finalist]:
    """Run the finalists on the final seeds; returns them, the winner first."""
    trials = choose_finalists(study, spec.settings.finalists, spec.space.parameters_of(spec.base))
    if not trials:
        reasons = [trial.user_attrs[ERROR] for trial in study.trials if trial.user_attrs.get(ERROR)]
        why = f"all {len(reasons)} failed, the first: {reasons[0]}" if reasons else "there was no time"
        raise SearchError(f"{shell_path(spec.folder)}: no trial came to a score; {why}")
    seeds = tuple(spec.final_seeds)
    named = [(trial.number, spec.space.values(trial.params)) for trial in trials]
    if runs := missing(study, named, seeds):
        print(
            f"the {len(trials)} finalists on {len(seeds)} seeds more: {len(runs)} runs",
            file=sys.stderr,
            flush=True,
        )
    while runs := missing(study, named, seeds):
        workers = min(spec.settings.workers, len(runs))
        run_workers(run_finals, FinalRuns(context, runs, workers), workers)
    return ranking(study, trials, seeds, spec.base.total_timesteps)


def _conclude(spec: StudySpec, study: optuna.Study, ranked: list[Finalist]) -> None:
    """Confirm the winner, write the recipe and study.json, and print the outcome."""
    best = study.get_trials(deepcopy=False)[ranked[0].trial]
    values = spec.space.values(best.params)
    is_new = spec.space.parameters_of(spec.base) != best.params
    tuned = _tuned(spec.base, values) if is_new else spec.base
    name = f"trial={best.number}"
    winner = held_out_runs(spec.folder, name, _tuned(spec.measured, values), spec.held_out)
    began_from = held_out_runs(spec.folder, "default", spec.measured, spec.held_out)
    confirmed = _confirm(spec, winner if is_new else [], began_from)
    about = f"the best of {count_trials(study).ended} trials; study.json has what came of it"
    recipe = write_recipe(spec.folder, spec.folders, spec.choices, tuned, about)
    outcome = {
        "winner": {"trial": best.number, "score": best.value, "values": values},
        "finalists": [dataclasses.asdict(finalist) for finalist in ranked],
        "confirmation": confirmed,
    }
    write_study(spec, study, outcome)
    words = shlex.join(_words_beside(recipe, spec.folders))
    train_it = f"{command('train')} recipe={shell_path(spec.folder)} {words}".rstrip()
    lines = [confirmed["sentence"], f"  recipe: {shell_path(recipe)}", f"  train it: {train_it}"]
    runs = spec.folder / CONFIRM
    if (over_seeds := write_over_seeds(runs, spec.folder)) is not None:
        told = f"{shell_path(over_seeds)}  (of each run: {shell_path(runs)})"
        lines.append(f"  curves over seeds: tensorboard --logdir {told}")
    _print_outcome(spec, values, lines)


def _words_beside(recipe: Path, folders: ConfFolders) -> list[str]:
    """What train.py needs beside the recipe: the user's own folders, and trust in the user's own classes."""
    words = [search_path(folders.own)] if folders.own else []
    try:
        overrides(recipe)
    except InputError:
        words.append(f"{TRUST}=true")
    return words


def _tuned(config: TrainConfig, values: dict[str, Any]) -> TrainConfig:
    """The tuned configuration, with an agent's name of its own, by which a report tells it apart."""
    tuned = with_values(config, values)
    agent = dataclasses.replace(tuned.agent, name=f"{tuned.agent.name}_tuned")
    return dataclasses.replace(tuned, agent=agent)


def _confirm(spec: StudySpec, winner: list[HeldOutRun], began_from: list[HeldOutRun]) -> dict[str, Any]:
    """Run both and compare them; an empty `winner` is for settings that the search began from."""
    runs = [run for pair in itertools.zip_longest(began_from, winner) for run in pair if run is not None]
    count = len(began_from)
    print(f"{len(runs)} runs on {count} held-out seeds confirm the winner", file=sys.stderr, flush=True)
    prepare(spec.folder, runs)
    workers = min(spec.settings.workers, len(runs))
    run_workers(run_held_out, HeldOutRuns(tuple(runs), workers), workers)
    before = read_results(began_from)
    if winner:
        return verdict_on(read_results(winner), before, "the winner")
    return {
        "verdict": "is",
        "sentence": f"No trial came out better than the settings that the search began from: on {count} "
        f"held-out seeds these are {before.text()}.",
    }


def _print_outcome(spec: StudySpec, values: dict[str, Any], lines: list[str]) -> None:
    before = spec.space.parameters_of(spec.base) or {}
    width = max(map(len, values))
    print("winner:")
    for key, value in values.items():
        was = f"  (was {before[key]})" if key in before and before[key] != value else ""
        print(printable(f"  {key:<{width}}  {value}{was}"))
    print(*map(printable, lines), sep="\n")
    print(f"  look at it: {command('report')} {shell_path(spec.folder)}", flush=True)
