"""A process that runs trials until the study has enough of them."""

from __future__ import annotations

import contextlib
import math
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from gridworld.errors import reason
from gridworld.process.parallel.parent_watch import end_with
from gridworld.process.parallel.together import run_together
from gridworld.process.signals import set_on
from gridworld.storage.file_lock import locked
from gridworld.sweep.job_table import one_line
from gridworld.tune.search.objective import ERROR, STOPPED, Objective, Stopped
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
    count = context.storage.settings.together or 1
    own: set[int] = set()
    with study_of(context) as storage, contextlib.suppress(Stopped):
        studies = storage.load_several(count)
        with among_workers(studies[0], context):
            run_all([partial(_run_trials, study, context, own) for study in studies])
    sys.exit(0)


@contextlib.contextmanager
def among_workers(study: Study, context: StudyContext) -> Iterator[None]:
    """Share the workers' lock for the block; who finds nobody at it gives up all trials that run.

    Workers of a database that was named may be elsewhere, with a lock of their own.
    """
    from gridworld.tune.search.storage import give_up_running

    lock, settings = context.folder / WORKERS, context.storage.settings
    if settings.storage is None:
        with locked(lock, wait=_ORPHAN_SECONDS if settings.workers == 1 else 0) as is_alone:
            if is_alone:
                give_up_running(study)
    with locked(lock, shared=True):
        yield


def run_all(tasks: Sequence[Callable[[], T]]) -> list[T]:
    """Run tasks, together where they are several; returns what each returned.

    Raises:
        Exception: what the first of them raised that failed, after the others have ended.
    """
    if len(tasks) == 1:
        return [tasks[0]()]
    found = []
    for result in run_together(tasks):
        if isinstance(result, Exception):
            raise result
        found.append(result)
    return found


def _run_trials(study: Study, context: StudyContext, own: set[int]) -> None:
    while not is_stopped() and time.time() < context.deadline and _run_next(study, context, own):
        pass


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
    set_on(signal.SIGTERM, _stopped)
    end_with(parent)


def is_stopped() -> bool:
    """Whether this process was asked to end."""
    return _stopped.is_set()


def _run_next(study: Study, context: StudyContext, own: set[int]) -> bool:
    """Run a trial, or wait for those that others run; False once there are enough.

    Args:
        study: the study, loaded for this trial and those after it.
        context: what is run.
        own: the numbers of the trials that this process runs, which are not waited for.
    """
    from gridworld.tune.search.storage import count_trials, give_up_stale, next_draw, seed_sampler, show_ended

    settings = context.storage.settings
    with ExitStack() as turn:
        turn.enter_context(locked(context.folder / TURN))
        give_up_stale(study, settings)
        counts = count_trials(study)
        if counts.ended >= settings.trials:
            return False
        if counts.ended + counts.running < settings.trials:
            begun: list[int] = []
            draw = next_draw(study)
            place = f"{socket.gethostname()}:{context.folder.absolute()}" if settings.storage else ""
            seed_sampler(study, settings, draw, place)
            if draw == 0 and context.first is not None and counts.waiting == 0:
                study.enqueue_trial(context.first)
            run = partial(_run, objective=context.objective, draw=draw, turn=turn, begun=begun, own=own)
            try:
                study.optimize(run, n_trials=1, catch=(Exception,))
            finally:
                own.difference_update(begun)
                show_ended(study)
            return True
    if own:
        return False
    _stopped.wait(_POLL_SECONDS)
    return True


def _run(
    trial: Trial, objective: Objective, draw: int, turn: ExitStack, begun: list[int], own: set[int]
) -> float:
    """Evaluate the objective; note the reason where it fails."""
    import optuna

    from gridworld.tune.search.storage import sign_on

    begun.append(trial.number)
    own.add(trial.number)
    sign_on(trial, draw, f"{socket.gethostname()}:{os.getpid()}")
    turn.close()
    try:
        value = objective(trial, is_stopped)
    except optuna.TrialPruned:
        raise
    except Stopped:
        trial.set_user_attr(STOPPED, True)
        raise
    except Exception as error:
        trial.set_user_attr(ERROR, one_line(reason(error)))
        raise
    if math.isnan(value):
        trial.set_user_attr(ERROR, "the objective is NaN")
    return value
