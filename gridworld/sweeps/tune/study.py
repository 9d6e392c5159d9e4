"""A study from its beginning to its verdict, and its folder.

search.json     the study's name and what makes its trials comparable, from its beginning on
trials.csv      a row per trial that has ended
study.json      what was searched and what came of it, with the checksum of trials.csv
confirm/        the held-out runs; see `confirmation`
experiment/     the winner as a recipe, which train.py takes: recipe=runs/STUDY
study.db        Optuna's storage, unless tune.storage names another
.lock           held by the command at work, unless the study is in a database that others share

The tables are made anew from the storage, which may be elsewhere, or be deleted. The report reads them, so
that it needs neither Optuna nor the database.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import os
import shlex
import signal
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import optuna
from omegaconf import OmegaConf
from optuna.trial import FrozenTrial, TrialState

from gridworld.base.atomic_write import check_no_links, inside, is_locked, write_json, write_text
from gridworld.base.console import command, printable, recorded_command_line, tell
from gridworld.base.errors import InputError
from gridworld.base.processes import Processes, can_fork
from gridworld.base.safe_read import LARGEST_CSV, file_sha256, read_sealed, sealed
from gridworld.base.signals import Interrupted, exiting
from gridworld.config.compose import compose_run, compose_whole, search_path
from gridworld.config.fields import Effect
from gridworld.config.recipe_file import IN_A_STUDY, TRUST, literal, overrides
from gridworld.config.settings import ON_RESULT, flat, with_effects
from gridworld.config.train import TrainConfig
from gridworld.report.tuning_study import STUDY_JSON, TRIALS_CSV, TRIALS_SUM
from gridworld.report.writer import write_over_seeds
from gridworld.run.folder import LOCK, MANIFEST, SWEEP_JSON, check_writable, claimed, shell_path, shown
from gridworld.run.provenance import versions
from gridworld.sweeps.plan import Job, may_fork
from gridworld.sweeps.tune.confirmation import (
    CONFIRM,
    Finalist,
    choose_finalists,
    held_out_runs,
    prepare,
    rank_finalists,
    read_results,
    run_held_out,
    verdict_on,
)
from gridworld.sweeps.tune.objective import ERROR, with_values
from gridworld.sweeps.tune.search import SearchError, in_reach, open_study, search
from gridworld.sweeps.tune.study_spec import StudySpec
from gridworld.training.setup import import_for
from gridworld.training.tensorboard import hparams

SEARCH_JSON = "search.json"
_EXPERIMENT, _WINNER = IN_A_STUDY
_OF_A_RECIPE = ON_RESULT - {Effect.SEED, Effect.MACHINE}


def tune(spec: StudySpec) -> None:
    """Run what the study lacks, confirm the winner, and write and print what came of it."""
    check_study_folder(spec.folder)
    alone = spec.settings.storage is None  # nobody else searches for this study
    try:
        with claimed(spec.folder, SEARCH_JSON, alone), exiting(signal.SIGINT, signal.SIGTERM):
            _tune(spec)
    except SystemExit as stop:
        raise Interrupted(int(str(stop.code)) - 128) from None


def _tune(spec: StudySpec) -> None:
    url, about = spec.settings.storage or f"sqlite:///{spec.folder.absolute() / 'study.db'}", _about(spec)
    study = open_study(url, spec.name, about, spec.space, must_exist=is_claimed(spec.folder, spec.name))
    write_json(spec.folder / SEARCH_JSON, sealed({"study": spec.name, "about": about}), durable=True)
    workers = Processes(spec.settings.workers, can_fork() and may_fork(spec.base), attempts=4)
    if workers.forks:
        import_for(spec.base)  # once for all of them
    with in_reach(url):
        search(spec, study, workers)
        trials = choose_finalists(study, spec)
        if not trials:
            errors = [error for trial in study.trials if (error := trial.user_attrs.get(ERROR))]
            why = f"all {len(errors)} failed, the first: {errors[0]}" if errors else "time ran out"
            raise SearchError(f"{shell_path(spec.folder)}: no trial got a score; {why}")
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
    spec: StudySpec, study: optuna.Study, best: FrozenTrial, ranked: list[Finalist], workers: Processes
) -> None:
    """Confirm the winner, write the recipe and study.json, and print the outcome."""
    values, before = spec.space.values(best.params), spec.space.parameters_of(spec.base)
    is_new = before != best.params
    tuned = _tuned(spec.base, values) if is_new else spec.base
    measured, name = spec.objective.base, f"trial={best.number}"
    began_from = held_out_runs(spec.folder, "default", measured, spec.held_out, spec.words)
    words = [word for word in spec.words if word.lstrip("+").partition("=")[0] not in values]
    words += [f"++{key}={literal(each, key)}" for key, each in values.items()]
    winner = (
        held_out_runs(spec.folder, name, _tuned(measured, values), spec.held_out, words) if is_new else []
    )
    confirmed = _confirm(spec, winner, began_from, workers)
    about = f"the best of {len(study.trials)} trials; study.json has the results"
    recipe = write_recipe(spec.folder, spec.conf, spec.choices, tuned, about)
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
    words = [f"--config-dir={shown(folder)}" for folder in spec.conf]
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


def _confirm(spec: StudySpec, winner: list[Job], began_from: list[Job], workers: Processes) -> dict[str, Any]:
    """Run both and compare them; an empty `winner` is for settings that the search began from."""
    runs = [run for pair in itertools.zip_longest(began_from, winner) for run in pair if run is not None]
    count = len(began_from)
    tell(f"{len(runs)} runs on {count} held-out seeds confirm the winner")
    prepare(spec.folder, runs)
    while runs:
        shares = workers.shares(runs, spec.base.agent.shape is not None)
        workers.run(partial(run_held_out, share) for share in shares)
        runs = [run for run in runs if is_locked(run.folder / LOCK)]  # another machine is at work on them
    before = read_results(began_from)
    if winner:
        return verdict_on(read_results(winner), before)
    return {
        "verdict": "is",
        "sentence": f"No trial beat the baseline: on {count} held-out seeds it is {before.text()}.",
    }


def check_study_folder(folder: Path) -> None:
    """Raise `InputError` for a folder of something else, one that cannot be written, or links in it."""
    for name, kind in ((MANIFEST, "a single run"), (SWEEP_JSON, "a sweep")):
        if (folder / name).exists():
            raise InputError(f"{folder}: is the folder of {kind}; choose another tune.folder")
    check_writable(folder, "tune.folder")
    for names in ((), (CONFIRM,), (_EXPERIMENT,)):
        check_no_links(folder, *names)


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


def write_recipe(
    folder: Path, conf: tuple[Path, ...], choices: Mapping[str, str], config: TrainConfig, about: str
) -> Path:
    """Write the winner as a recipe, and check that it composes to `config` again.

    It names the agent, the world and the observation, and every value in which the winner differs from
    these. `config.recipe_file` reads it as data. In a study of one's own, Hydra takes it as well:
    --config-dir runs/STUDY experiment=winner.
    """

    def composed(words: list[str], *more: Path) -> dict[str, Any]:
        return _relevant(compose_run([*words, *search_path((*conf, *more))])[0])

    chosen = [f"{group}={choice}" for group, choice in choices.items()]
    plain: Any = OmegaConf.to_container(compose_whole("train", [*chosen, *search_path(conf)]))
    bare = dict(flat(with_effects(_OF_A_RECIPE, plain)))  # which may lack values, as a world's id
    values = OmegaConf.create()
    for key, value in flat(_relevant(config)):
        if key not in bare or value != bare[key]:
            OmegaConf.update(values, key, value)
    lines = ["# @package _global_", f"# {about}", "defaults:"]
    lines += [f"  - override /{group}: {choice}" for group, choice in choices.items()]
    lines += ["  - _self_", "", OmegaConf.to_yaml(values) if values else ""]
    path = inside(folder, _EXPERIMENT) / _WINNER
    path.parent.mkdir(exist_ok=True)
    write_text(path, "\n".join(lines), durable=True)
    for words in ([f"experiment={path.stem}"], overrides(path, trust=True)):
        assert composed(words, folder) == _relevant(config), f"{path} does not say what the winner is"
    return path


def _relevant(config: TrainConfig) -> dict[str, Any]:
    return with_effects(_OF_A_RECIPE, dataclasses.asdict(config))
