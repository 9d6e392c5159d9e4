"""A process that runs trials until the study has enough of them."""

from __future__ import annotations

import contextlib
import itertools
import math
import os
import signal
import socket
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from filelock import ReadWriteLock, Timeout

from gridworld.errors import reason
from gridworld.process.parallel.parent_watch import end_with
from gridworld.storage.file_lock import locked
from gridworld.sweep.job_table import one_line
from gridworld.training.together import Training, run_together
from gridworld.tune.search.objective import ERROR, STOPPED, Objective, Seeds, Stopped
from gridworld.tune.search.worker_pool import UNREACHABLE, StorageLostError

if TYPE_CHECKING:
    from optuna import Study
    from optuna.trial import Trial

    from gridworld.tune.search.storage import StudyStorage

T = TypeVar("T")

TURN = ".turn.lock"  # in the study's folder: held while a worker counts the trials and begins one
WORKERS = ".workers.lock"  # the same: all workers share it
_POLL_SECONDS = 0.5
_ORPHAN_SECONDS = 4.0  # that a worker may outlive a command that was killed

_stopped = threading.Event()


@dataclass(frozen=True)
class StudyContext:
    """What all workers of a study need to know."""

    folder: Path
    storage: StudyStorage
    objective: Objective
    deadline: float  # `time.time()` after which no trial begins
    first: dict[str, Any] | None = None  # the parameters of the first trial, if it is to have given ones


def run_trials(context: StudyContext, worker: int, parent: int) -> None:
    """A worker's process: run trials until there are enough. See `worker_pool.WorkerMain`."""
    become_worker(parent)
    with study_of(context) as storage, contextlib.suppress(Stopped):
        study = storage.load()
        with among_workers(study, context):
            search(study, context)
    sys.exit(0)


@contextlib.contextmanager
def among_workers(study: Study, context: StudyContext) -> Iterator[None]:
    """Share the workers' lock for the block; who finds nobody at it gives up all trials that run.

    Workers of a database that was named may be elsewhere, with a lock of their own.
    """
    from gridworld.tune.search.storage import give_up_running

    guard, settings = ReadWriteLock(context.folder / WORKERS), context.storage.settings
    if settings.storage is None:
        wait = _ORPHAN_SECONDS if settings.workers == 1 else 0
        with contextlib.suppress(Timeout), guard.write_lock(timeout=wait):
            give_up_running(study)
    with guard.read_lock():
        yield


def run_all(tasks: Sequence[Callable[[], Training[T]]]) -> list[T]:
    """Run trainings together; returns what each returned.

    Raises:
        Exception: what the first of them raised that failed, after the others have ended.
    """
    found = []
    for result in run_together(tasks):
        if isinstance(result, Exception):
            raise result
        found.append(result)
    return found


def search(study: Study, context: StudyContext) -> None:
    """Run trials, some at a time, until there are enough or it is time to end.

    Raises:
        Stopped: this process was asked to end.
    """
    while not is_stopped() and time.time() < context.deadline:
        begun, is_over = _begin(study, context)
        if begun:
            _run(begun, context)
        elif is_over:
            return
        else:
            _stopped.wait(_POLL_SECONDS)  # for those that others run


@contextlib.contextmanager
def study_of(context: StudyContext) -> Iterator[StudyStorage]:
    """The study's storage for a worker, which exits with `UNREACHABLE`, and no message, when it is lost."""
    from gridworld.tune.search.storage import storage_error

    def heartbeat_failed(thread: threading.ExceptHookArgs) -> None:
        if storage_error(thread.exc_value) is None:
            threading.__excepthook__(thread)

    threading.excepthook = heartbeat_failed  # the trial itself meets the error too
    try:
        with context.storage.in_reach():
            yield context.storage
    except StorageLostError:
        sys.exit(UNREACHABLE)


def become_worker(parent: int) -> None:
    """Leave Ctrl-C to the parent; stop at its SIGTERM, and when it is gone."""
    signal.signal(signal.SIGTERM, lambda number, frame: _stopped.set())
    end_with(parent)


def is_stopped() -> bool:
    """Whether this process was asked to end."""
    return _stopped.is_set()


def _begin(study: Study, context: StudyContext) -> tuple[list[Begun], bool]:
    """Begin as many trials as train at once, or are missing; returns them, and whether there are enough."""
    from gridworld.tune.search.storage import count_trials, give_up_stale, next_draw, seed_sampler, sign_on

    settings, begun = context.storage.settings, list[Begun]()
    while len(begun) < (settings.together or 1):
        with locked(context.folder / TURN):
            give_up_stale(study, settings)
            counts = count_trials(study)
            if counts.ended + counts.running >= settings.trials:
                return begun, counts.ended >= settings.trials
            draw = next_draw(study)
            place = f"{socket.gethostname()}:{context.folder.absolute()}" if settings.storage else ""
            seed_sampler(study, settings, draw, place)
            if draw == 0 and context.first is not None and counts.waiting == 0:
                study.enqueue_trial(context.first)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # that `ask` has no heartbeat, for which there is `beating`
                trial = study.ask()
            sign_on(trial, draw, f"{socket.gethostname()}:{os.getpid()}")
        try:
            begun.append(Begun(study, trial, context.objective.begin(trial)))
        except Exception as error:
            _fail(study, trial, error)
    return begun, False


@dataclass(frozen=True)
class Begun:
    """A trial that has begun."""

    study: Study
    trial: Trial
    seeds: Seeds

    def end(self) -> None:
        """Tell Optuna what it has come to; note the reason where it failed."""
        import optuna

        try:
            value = self.seeds.score()
            if math.isnan(value):
                raise ArithmeticError("the objective is NaN")
        except optuna.TrialPruned:
            self.study.tell(self.trial, state=optuna.trial.TrialState.PRUNED)
        except Exception as error:
            _fail(self.study, self.trial, error)
        else:
            self.study.tell(self.trial, value)


def _fail(study: Study, trial: Trial, error: Exception) -> None:
    import optuna

    trial.set_user_attr(ERROR, one_line(reason(error)))
    study.tell(trial, state=optuna.trial.TrialState.FAIL)


def _run(begun: Sequence[Begun], context: StudyContext) -> None:
    """Train trials that have begun, together where they can."""
    import optuna

    from gridworld.tune.search.storage import beating, show_ended

    groups = [each.seeds.trainings(is_stopped) for each in begun]
    try:
        with beating([each.trial for each in begun], context.storage.settings.heartbeat):
            if all(len(group) == 1 for group in groups):
                run_all([training for group in groups for training in group[0]])
            else:
                for part in itertools.chain.from_iterable(groups):
                    run_all(part)
        for each in begun:
            each.end()
    except BaseException:
        states = optuna.trial.TrialState
        for each in begun:
            if each.study.get_trials(deepcopy=False)[each.trial.number].state == states.RUNNING:
                each.trial.set_user_attr(STOPPED, True)
                each.study.tell(each.trial, state=states.FAIL)
        raise
    show_ended(begun[0].study)
