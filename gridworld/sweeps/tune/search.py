"""The search: Optuna chooses the settings of trials, workers train them, and what has ended is stored.

The study in the database has only trials that have ended. Those that run are in a study in memory, which
begins with a copy of them. So nothing is to be cleaned up after a kill: a trial that was cut short has left
nothing, and is drawn again.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import os
import socket
import time
import uuid
import warnings
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from statistics import fmean
from typing import Any

import optuna
from optuna.exceptions import ExperimentalWarning, OptunaError
from optuna.trial import FrozenTrial, TrialState
from sqlalchemy.engine import make_url
from sqlalchemy.exc import SQLAlchemyError

from gridworld.base.atomic_write import write_text
from gridworld.base.console import ProgressLine, tell, time_left
from gridworld.base.errors import InputError
from gridworld.base.processes import LostError, Processes
from gridworld.base.safe_read import csv_text
from gridworld.report.tuning_study import TRIALS_CSV
from gridworld.run.folder import shell_path
from gridworld.sweeps.folder import one_line
from gridworld.sweeps.tune.objective import (
    ERROR,
    FINAL,
    SEEDS,
    WORKER,
    Outcome,
    Report,
    Trials,
    Values,
    read_score,
)
from gridworld.sweeps.tune.study_spec import SearchSpace, StudySpec

ABOUT = "gridworld"  # the study's attribute that says what makes its trials comparable

_CONNECT_SECONDS = 10
_LOCKED_SECONDS = 60  # to wait for others at an SQLite file
_EXAMPLES = "sqlite:////shared/study.db or postgresql://user@host/name"
_SECONDS_BETWEEN_TABLES = 2.0
_STATUSES = {TrialState.COMPLETE: "done", TrialState.PRUNED: "pruned", TrialState.FAIL: "failed"}
_DAMAGE = (
    *(ValueError, TypeError, LookupError, AttributeError, ArithmeticError, RuntimeError, AssertionError),
    *(SQLAlchemyError, OptunaError),
)


class SearchError(Exception):
    """A search that had begun came to nothing, or cannot be continued; in one sentence."""


def _shown(url: str) -> str:
    """The URL without its password."""
    return f"tune.storage={make_url(url).render_as_string(hide_password=True)}"


def _connect(url: str) -> optuna.storages.RDBStorage:
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    try:
        parsed = make_url(url)
    except SQLAlchemyError:
        raise InputError(f"tune.storage={url}: is not the URL of a database, e.g. {_EXAMPLES}") from None
    is_sqlite = parsed.drivername.startswith("sqlite")
    if is_sqlite and (parsed.database in (None, "", ":memory:", "file::memory:") or "mode" in parsed.query):
        raise InputError(f"{_shown(url)}: is a database in memory; name a file, e.g. {_EXAMPLES}")
    options = {"timeout": _LOCKED_SECONDS} if is_sqlite else {"connect_timeout": _CONNECT_SECONDS}
    try:
        return optuna.storages.RDBStorage(url, engine_kwargs={"connect_args": options})
    except (ImportError, SQLAlchemyError, OptunaError, RuntimeError) as error:
        raise InputError(f"{_shown(url)}: cannot be reached ({_first_line(error)})") from None


def open_study(
    url: str, name: str, about: Mapping[str, Any], space: SearchSpace, must_exist: bool = False
) -> optuna.Study:
    """Make the study, or check that the one there is of the same search and can be read."""
    is_gone = (
        must_exist and url.startswith("sqlite:///") and not Path(url.removeprefix("sqlite:///")).exists()
    )
    try:
        storage = None if is_gone else _connect(url)
        names = [] if storage is None else optuna.get_all_study_names(storage)
        if storage is None or (must_exist and name not in names):
            raise InputError(
                f"{_shown(url)}: does not have the study {name}, which has started; restore its database, "
                "or choose another tune.folder"
            )
        if name not in names:  # the index of names is missing where making the tables was cut short
            optuna.create_study(storage=storage, study_name=name, load_if_exists=True)
        study = optuna.load_study(study_name=name, storage=storage)
        if ABOUT not in study.user_attrs:
            study.set_user_attr(ABOUT, about)
        _check_same(name, study.user_attrs[ABOUT], about)
        _check_readable(study, space)
    except InputError:
        raise
    except _DAMAGE as error:
        raise InputError(
            f"{_shown(url)}: cannot be read as a study: it was changed or damaged ({type(error).__name__}: "
            f"{_first_line(error)[:200]}); restore a good copy"
        ) from None
    return study


def _check_same(name: str, before: Mapping[str, Any], about: Mapping[str, Any]) -> None:
    """Refuse to continue the study with the first difference between what it was begun with, and now."""
    for part, now in json.loads(json.dumps(about)).items():
        was = dict(before[part])
        for key in sorted({*was, *now}):
            if was.get(key) != now.get(key):
                told = [json.dumps(each.get(key)) for each in (was, now)]
                raise InputError(
                    f"tune.study={name}: was started with another {part}: {key} was {told[0]}, now it is "
                    f"{told[1]}; choose another tune.study, or set it back"
                )


def _check_readable(study: optuna.Study, space: SearchSpace) -> None:
    """Raise one of `_DAMAGE` for a study from which a search could not be continued."""
    scratch = optuna.create_study()
    if study.directions != scratch.directions:
        raise ValueError("it does not minimise")
    for trial in study.get_trials(deepcopy=False):
        scratch.add_trial(trial)  # which validates it
        seeds = [read_score(seed) for seed in trial.user_attrs.get(SEEDS, [])]
        if trial.state != TrialState.FAIL and trial.distributions != space.distributions:
            raise ValueError(f"trial {trial.number} belongs to another search space")
        if trial.state == TrialState.COMPLETE and not (seeds and math.isfinite(trial.value or 0.0)):
            raise ValueError(f"trial {trial.number} has no score")
    for key, value in study.user_attrs.items():
        if key.startswith(FINAL):
            read_score(value)


@contextlib.contextmanager
def in_reach(url: str) -> Iterator[None]:
    """Raise `SearchError`, in a sentence, for what a database that goes away in the block causes."""
    try:
        yield
    except (SQLAlchemyError, OptunaError) as error:
        raise SearchError(
            f"{_shown(url)}: the study can no longer be reached ({_first_line(error)}); restore the "
            "database, then run the command again"
        ) from None


def _first_line(error: BaseException) -> str:
    lines = str(getattr(error, "orig", None) or error).strip().splitlines()
    return lines[0] if lines else type(error).__name__


def search(spec: StudySpec, study: optuna.Study, workers: Processes) -> None:
    """Run trials until there are enough or it is time to end; keeps trials.csv up to date."""
    run, line = Search(spec, study), ProgressLine(spec.base.logging.progress)
    asked, before = spec.settings.trials, len(study.get_trials(deepcopy=False))
    begun = wrote = time.monotonic()

    def text() -> str:
        states = [trial.state for trial in study.get_trials(deepcopy=False)]
        text = f"tune: {len(states)} of {asked} trials, {states.count(TrialState.PRUNED)} pruned"
        text += f", {len(run.running)} running"
        if failed := states.count(TrialState.FAIL):
            text += f", {failed} failed"
        if TrialState.COMPLETE in states:
            text += f", best score {study.best_value:.4f}"
        return text + time_left(len(states) - before, asked - len(states), time.monotonic() - begun)

    def on_tick() -> None:
        nonlocal wrote
        if time.monotonic() - wrote >= _SECONDS_BETWEEN_TABLES:
            wrote = time.monotonic()
            write_trials(spec.folder, study, spec.space)
            line.show(text)

    try:
        if before < asked:
            more = f", {before} of them already there" if before else ""
            tell(
                f"study {spec.name} in {shell_path(spec.folder)}: {asked} trials of {spec.settings.seeds} "
                f"seeds{more}, {workers.count * (spec.settings.together or 1)} at once"
            )
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", ExperimentalWarning)  # of multivariate sampling
                warnings.filterwarnings("ignore", "The reported value is ignored")  # of a trial run again
                workers.run(iter(run.next, None), run.end, on_tick, run.answer)
    finally:
        line.clear()
        write_trials(spec.folder, study, spec.space, durable=True)


class Search:
    """The trials that run, and what is to run next."""

    def __init__(self, spec: StudySpec, study: optuna.Study) -> None:
        self.running: dict[int, optuna.Trial] = {}
        self._spec, self._settings, self._study = spec, spec.settings, study
        self._objective = spec.objective
        self._deadline = time.monotonic() + (spec.settings.timeout or math.inf)
        self._memory = optuna.create_study(study_name=study.study_name, pruner=self._pruner())
        before = study.get_trials(deepcopy=False)
        self._memory.add_trials(before)
        if (first := spec.space.parameters_of(spec.base)) is not None:
            self._memory.enqueue_trial(first, skip_if_exists=True)
        self._seen = len(before)  # trials of the study that are in memory
        self._name = f"{socket.gethostname()}:{os.getpid()}"
        # Another one where the next number may have been drawn: elsewhere, or before a kill that left gaps.
        is_at_once = (spec.settings.workers, spec.settings.together) != (1, 1)
        self._stream = uuid.uuid4().hex if spec.settings.storage or (before and is_at_once) else ""

    def next(self) -> Trials | None:
        """As many trials as train at once, or are missing."""
        begun: dict[int, tuple[Values, tuple[int, ...]]] = {}
        while len(begun) < (self._settings.together or 1) and time.monotonic() < self._deadline:
            ended = self._study.get_trials(deepcopy=False)
            draw = len(ended) + len(self.running)
            if draw >= self._settings.trials:
                break
            for trial in ended[self._seen :]:
                if trial.user_attrs.get(WORKER) != self._name:  # it is of another process or machine
                    self._memory.add_trial(trial)
            self._seen = len(ended)
            self._memory.sampler = self._sampler(draw)
            new = self._memory.ask(self._spec.space.distributions)
            new.set_user_attr(WORKER, self._name)
            begun[new.number] = self._spec.space.values(new.params), self._objective.seeds
            self.running[new.number] = new
        return Trials(self._objective, begun) if begun else None

    def answer(self, report: Report) -> bool:
        """Note a trial's score on its way; returns whether it is to end."""
        trial = self.running[report.trial]
        trial.report(report.value, report.step)
        return report.can_prune and trial.should_prune()

    def end(self, trials: Trials, outcomes: list[Outcome] | LostError) -> None:
        """Store how trials ended."""
        for number, outcome in trials.ended(outcomes):
            trial = self.running.pop(number)
            if outcome.seeds:
                trial.set_user_attr(SEEDS, [dataclasses.asdict(seed) for seed in outcome.seeds])
            if outcome.error:
                trial.set_user_attr(ERROR, one_line(outcome.error))
            states = TrialState.FAIL if outcome.error else TrialState.PRUNED
            state = states if outcome.value is None else None
            self._study.add_trial(self._memory.tell(trial, outcome.value, state))

    def _sampler(self, draw: int) -> optuna.samplers.BaseSampler:
        """With a random stream of the draw's: one worker's study is the same whether interrupted or not."""
        seed = zlib.crc32(repr((self._settings.sampler_seed, draw, self._stream)).encode())
        if self._settings.sampler == "random":
            return optuna.samplers.RandomSampler(seed=seed)
        return optuna.samplers.TPESampler(seed=seed, multivariate=True, constant_liar=True)

    def _pruner(self) -> optuna.pruners.BasePruner:
        reports = self._settings.reports
        if self._settings.pruner == "none":
            return optuna.pruners.NopPruner()
        if self._settings.pruner == "hyperband":
            most = reports * self._settings.seeds
            return optuna.pruners.HyperbandPruner(min_resource=reports, max_resource=most)
        # Half a seed's budget is given to everybody: until then most have learned nothing yet.
        return optuna.pruners.MedianPruner(n_warmup_steps=reports // 2)


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
