"""A study in its database, by Optuna's storage, where several processes and machines find it.

A worker that runs a trial leaves a sign of life every few seconds. A trial without one for three times as
long is failed by the next worker that begins one, and its draw is another's. Optuna has that for its
relational storages, SQLite among them, but not for its journal files and Redis; so those are refused. It
takes a trial that was begun and never left a sign for alive; so a worker leaves one before its name, and a
trial without a name is failed when it has been running for as long.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import math
import threading
import time
import warnings
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import optuna
from optuna.exceptions import DuplicatedStudyError, ExperimentalWarning, OptunaError, StorageInternalError
from optuna.storages import RDBStorage, fail_stale_trials
from optuna.trial import FrozenTrial, TrialState
from sqlalchemy.engine import URL, make_url
from sqlalchemy.exc import SQLAlchemyError

from gridworld.config.tune import TuneConfig
from gridworld.errors import InputError
from gridworld.process.console.command_line import program
from gridworld.tune.search.objective import DRAW, ERROR, STOPPED, WORKER
from gridworld.tune.search.worker_pool import StorageLostError

_ABOUT = "gridworld"  # the study's attribute that says what is searched
_MOST_KILLED = 3  # workers, by which a draw is given up: what kills them may be its settings
_SILENT_BEATS = 3
_CONNECT_SECONDS = 10
_EXAMPLES = "sqlite:////shared/study.db or postgresql://user@host/name"
_SECONDS_BETWEEN_READINGS = 1.0
_LOCKED_SECONDS = 60  # that a worker waits for others at an SQLite file


@dataclass(frozen=True)
class TrialCounts:
    """How many trials of a study stand how, without those that were lost, which are run again."""

    complete: int
    pruned: int
    failed: int
    running: int
    waiting: int

    @property
    def ended(self) -> int:
        """How many have an answer."""
        return self.complete + self.pruned + self.failed


@dataclass(frozen=True)
class StudyStorage:
    """Where a study is: a database, the study's name in it, and the settings of its search."""

    url: str
    name: str
    settings: TuneConfig

    @property
    def shown_url(self) -> str:
        """The URL without its password; as it is where it is none."""
        with contextlib.suppress(SQLAlchemyError):
            return make_url(self.url).render_as_string(hide_password=True)
        return self.url

    def connect(self) -> RDBStorage:
        """Open the database. Raises `InputError` where it cannot be reached."""
        optuna.logging.set_verbosity(optuna.logging.ERROR)
        try:
            parsed = make_url(self.url)
        except SQLAlchemyError:
            raise InputError(f"tune.storage={self.url}: is no URL of a database, e.g. {_EXAMPLES}") from None
        driver, shown, heartbeat = parsed.drivername, self.shown_url, self.settings.heartbeat
        is_sqlite = driver.startswith("sqlite")
        if is_sqlite and _is_in_memory(parsed):
            raise InputError(
                f"tune.storage={shown}: is a database in the memory of one process, where no worker finds "
                f"it; name a file, e.g. {_EXAMPLES}"
            )
        connect = {"timeout": _LOCKED_SECONDS} if is_sqlite else {"connect_timeout": _CONNECT_SECONDS}
        try:
            with _quiet():
                return RDBStorage(
                    self.url,
                    engine_kwargs={"connect_args": connect},
                    heartbeat_interval=heartbeat,
                    grace_period=_SILENT_BEATS * heartbeat,
                )
        except ImportError as error:
            cause = error.__cause__ or error
            raise InputError(f"tune.storage={shown}: {cause}; pip install the driver for {driver}") from None
        except (SQLAlchemyError, OptunaError, RuntimeError) as error:
            raise InputError(f"tune.storage={shown}: cannot be reached ({_first_line(error)})") from None

    def has_study(self) -> bool:
        """Whether the study is there; makes no SQLite file to find that out. Raises `InputError`."""
        with contextlib.suppress(SQLAlchemyError):
            parsed = make_url(self.url)
            file = parsed.database or ""
            is_file = parsed.drivername.startswith("sqlite") and not file.startswith("file:")
            if is_file and not Path(file).exists():
                return False
        with _quiet():
            return self.name in optuna.get_all_study_names(self.connect())

    def begin(self, about: Mapping[str, Any]) -> optuna.Study:
        """Make the study, or see that the one there is the same search.

        Args:
            about: what makes its trials comparable, as JSON.
        """
        storage, name = self.connect(), self.name
        try:
            with _quiet():
                study = optuna.create_study(storage=storage, study_name=name)
        except DuplicatedStudyError:
            study = optuna.load_study(storage=storage, study_name=name)
        if _ABOUT not in study.user_attrs:
            if any(trial.state.is_finished() for trial in study.get_trials(deepcopy=False)):
                raise InputError(
                    f"tune.study={name}: is there, but not of {program('tune')}; choose another tune.study"
                )
            study.set_user_attr(_ABOUT, about)
        check_same_search(name, study.user_attrs[_ABOUT], about)
        return study

    def load(self) -> optuna.Study:
        """The study that `begin` has made. Raises `StorageLostError` where it is gone since."""
        storage = optuna.storages.get_storage(self.connect())
        try:
            with _quiet():
                return optuna.load_study(storage=storage, study_name=self.name, pruner=_pruner(self.settings))
        except KeyError:
            raise StorageLostError(f"it has no study {self.name}") from None

    @contextlib.contextmanager
    def in_reach(self) -> Iterator[None]:
        """Raise `StorageLostError`, in a sentence, for what a storage that goes away in the block causes."""
        try:
            yield
        except Exception as error:
            if (cause := storage_error(error)) is None:
                raise
            raise StorageLostError(
                f"tune.storage={self.shown_url}: the study cannot be reached any more "
                f"({_first_line(cause)}); bring the database back, with what has ended in it, and run the "
                "command again"
            ) from None


def storage_error(error: BaseException | None) -> BaseException | None:
    """The storage's own error that an error follows from; None where it follows from none.

    Optuna's handlers of a storage's error raise others in turn.
    """
    while error is not None and not isinstance(
        error, SQLAlchemyError | StorageInternalError | StorageLostError
    ):
        error = error.__cause__ or error.__context__
    return error


def count_trials(study: optuna.Study) -> TrialCounts:
    """Count a study's trials by how they stand."""
    trials = study.get_trials(deepcopy=False)
    states = [trial.state for trial in trials if not is_lost(trial)]
    return TrialCounts(
        states.count(TrialState.COMPLETE),
        states.count(TrialState.PRUNED),
        states.count(TrialState.FAIL),
        states.count(TrialState.RUNNING),
        states.count(TrialState.WAITING),
    )


def is_lost(trial: FrozenTrial) -> bool:
    """Whether a trial ended without an answer; then it is run again."""
    return trial.state == TrialState.FAIL and not trial.user_attrs.get(ERROR)


def draw_of(trial: FrozenTrial) -> int:
    """Which of the sampler's draws a trial is; it has no other's settings unless that one was lost."""
    return int(trial.user_attrs.get(DRAW, trial.number))


def next_draw(study: optuna.Study) -> int:
    """The first draw that no trial has, but those that were lost."""
    trials = [trial for trial in study.get_trials(deepcopy=False) if trial.state != TrialState.WAITING]
    lost = [trial for trial in trials if is_lost(trial)]
    killed = Counter(draw_of(trial) for trial in lost if STOPPED not in trial.user_attrs)
    taken = {draw for draw, count in killed.items() if count > _MOST_KILLED}
    taken |= {draw_of(trial) for trial in trials if not is_lost(trial)}
    return next(draw for draw in itertools.count() if draw not in taken)


def sign_on(trial: optuna.Trial, draw: int, worker: str) -> None:
    """Leave a trial's first sign of life, its draw, and then the name of the worker that runs it."""
    cast(Any, trial.storage).record_heartbeat(trial._trial_id)
    trial.set_user_attr(DRAW, draw)
    trial.set_user_attr(WORKER, worker)


@contextlib.contextmanager
def beating(trials: Sequence[optuna.Trial], every: float) -> Iterator[None]:
    """Show for the block that this process runs some trials, by a sign of life every so many seconds."""
    is_over = threading.Event()

    def beat() -> None:
        while not is_over.wait(every):
            for trial in trials:
                cast(Any, trial.storage).record_heartbeat(trial._trial_id)

    thread = threading.Thread(target=beat, daemon=True)
    thread.start()
    try:
        yield
    finally:
        is_over.set()
        thread.join()


def give_up_running(study: optuna.Study) -> None:
    """Fail all trials that run, for a worker which knows that there is no other."""
    for trial in study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
        study.tell(trial.number, state=TrialState.FAIL, skip_if_finished=True)


def give_up_stale(study: optuna.Study, settings: TuneConfig) -> None:
    """Fail the trials of workers that have been silent for long."""
    with _quiet():
        fail_stale_trials(study)
    latest = datetime.now() - timedelta(seconds=_SILENT_BEATS * settings.heartbeat)
    for trial in study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
        began = trial.datetime_start
        if WORKER not in trial.user_attrs and began is not None and began < latest:
            study.tell(trial.number, state=TrialState.FAIL, skip_if_finished=True)


def seed_sampler(study: optuna.Study, settings: TuneConfig, draw: int, place: str) -> None:
    """Give a draw a random stream of its own, whichever worker runs it; `place` tells machines apart.

    Neither TPE nor the median pruner counts trials that were lost. So one worker's study is the same whether
    it was interrupted or not. (Hyperband's brackets go by the trial's number, which lost ones have too.)
    """
    seed = zlib.crc32(repr((settings.sampler_seed, draw, place)).encode())
    with _quiet():
        study.sampler = (
            optuna.samplers.RandomSampler(seed=seed)
            if settings.sampler == "random"
            else optuna.samplers.TPESampler(seed=seed, multivariate=True, constant_liar=True)
        )


def _is_in_memory(url: URL) -> bool:
    """Whether an SQLite URL names no file."""
    name = url.database or ":memory:"
    return name in (":memory:", "file::memory:") or url.query.get("mode") == "memory"


def _pruner(settings: TuneConfig) -> optuna.pruners.BasePruner:
    if settings.pruner == "none":
        return optuna.pruners.NopPruner()
    if settings.pruner == "hyperband":
        return optuna.pruners.HyperbandPruner(
            min_resource=settings.reports, max_resource=settings.reports * settings.seeds
        )
    # Half a seed's budget is given to everybody: until then most have learnt nothing yet.
    return _RarelyReading(n_warmup_steps=settings.reports // 2)


class _RarelyReading(optuna.pruners.MedianPruner):
    """Optuna's median pruner, which reads once a second what other processes have ended.

    At each report it would read all trials that run, which costs more than the steps between two reports.
    """

    _complete: Sequence[FrozenTrial] = ()
    read = -math.inf  # when it did

    def prune(self, study: optuna.Study, trial: FrozenTrial) -> bool:
        if time.monotonic() - self.read > _SECONDS_BETWEEN_READINGS:
            self._complete = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
            self.read = time.monotonic()
        seen = SimpleNamespace(
            direction=optuna.study.StudyDirection.MINIMIZE, get_trials=lambda **how: self._complete
        )
        return super().prune(cast(optuna.Study, seen), trial)


def show_ended(study: optuna.Study) -> None:
    """Let the pruner see at once what has ended in this process."""
    if isinstance(study.pruner, _RarelyReading):
        study.pruner.read = -math.inf


def check_same_search(name: str, before: Any, about: Mapping[str, Any]) -> None:
    """Raise `InputError` for the first difference between what a study was begun with, and now."""
    if not (isinstance(before, dict) and all(isinstance(was, dict) for was in before.values())):
        raise InputError(f"tune.study={name}: does not say what it searches, it was changed or damaged")
    now = json.loads(json.dumps(about))
    for part, was in before.items():
        is_now = now.get(part, {})
        if was == is_now:
            continue
        changed = sorted(key for key in {*was, *is_now} if was.get(key) != is_now.get(key))
        key = changed[0]
        more = f" (and {len(changed) - 1} more)" if len(changed) > 1 else ""
        raise InputError(
            f"tune.study={name}: was begun with another {part}: {key} was {_shown(was.get(key))}, now it is "
            f"{_shown(is_now.get(key))}{more}; choose another tune.study, or set it back"
        )


def _shown(value: Any) -> str:
    return "not there" if value is None else json.dumps(value)


def _first_line(error: BaseException) -> str:
    lines = str(getattr(error, "orig", None) or error).strip().splitlines()
    return lines[0] if lines else type(error).__name__


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Heartbeats and joint sampling are marked as experimental; we test what we use of them."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ExperimentalWarning)
        yield
