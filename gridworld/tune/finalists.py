"""Finalists: the best few trials on more seeds, among which the winner is chosen by all of their seeds.

The best of many trials on a few seeds is so partly by luck, and settings that fail one seed in seven look as
good as those that never fail. The configuration that the search began from is always among the finalists.
Results are attributes of the study, so that machines share them.
"""

from __future__ import annotations

import contextlib
import dataclasses
import sys
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

from gridworld.errors import InputError, reason
from gridworld.process.console.terminal import tell
from gridworld.process.parallel.together import LARGEST
from gridworld.training.together import Training
from gridworld.tune.search.objective import SEEDS, Objective, SeedScore, Stopped, learning, read_score, score
from gridworld.tune.search.worker import StudyContext, become_worker, is_stopped, run_all, study_of
from gridworld.tune.search.worker_pool import share

if TYPE_CHECKING:
    from optuna import Study
    from optuna.trial import FrozenTrial

_FAILED = sys.float_info.max  # the regret of a run that did
FINAL = "final "  # what the names of these attributes begin with


@dataclass(frozen=True)
class FinalRuns:
    """Runs of finalists on final seeds, and how many workers share them."""

    context: StudyContext
    runs: tuple[tuple[int, Mapping[str, Any], int], ...]  # (number of the trial, its values, seed)
    workers: int


@dataclass(frozen=True)
class Finalist:
    """How a trial stands after its final runs, by its own seeds and the final seeds together."""

    trial: int
    score: float
    certified: int
    seeds: int
    failed: int  # of these, runs that ended by an error, and count as not certified


def choose_finalists(study: Study, count: int, began_from: Mapping[str, Any] | None) -> list[FrozenTrial]:
    """The best complete trials, no two alike, and the one of the configuration that the search began from.

    Args:
        study: the study.
        count: how many of the best.
        began_from: that configuration's parameters, where it lies in the search space.
    """
    from optuna.trial import TrialState

    complete = study.get_trials(deepcopy=False, states=[TrialState.COMPLETE])
    found: list[FrozenTrial] = []
    for trial in sorted(complete, key=lambda trial: (trial.value, trial.number)):
        is_new = all(trial.params != other.params for other in found)
        if is_new and (len(found) < count or trial.params == began_from):
            found.append(trial)
    return found


def run_finals(runs: FinalRuns, worker: int, parent: int) -> None:
    """A worker's process: run a part, or for a worker that was lost whatever nobody has run yet.

    See `worker_pool.WorkerMain`.
    """
    become_worker(parent)
    with study_of(runs.context) as storage, contextlib.suppress(Stopped):
        _run_missing(runs, storage.load(), worker)
    sys.exit(0)


def _run_missing(runs: FinalRuns, study: Study, worker: int) -> None:
    part = share(runs.runs, worker, runs.workers)
    attributes = study.user_attrs
    tasks = [
        partial(_run, runs.context.objective, study, *run)
        for run in part
        if _name(run[0], run[2]) not in attributes
    ]
    together = LARGEST if runs.context.objective.can_join() else 1
    for start in range(0, len(tasks), together):
        run_all(tasks[start : start + together])


def _run(
    objective: Objective, study: Study, number: int, values: Mapping[str, Any], seed: int
) -> Training[None]:
    try:
        result = yield from learning(objective.config(values), seed, is_stopped)
    except Exception as error:  # the run failed, though its trial did not
        tell(f"trial {number} on the final seed {seed} failed, and counts as not certified: {reason(error)}")
        if not isinstance(error, InputError | ArithmeticError):
            traceback.print_exc()
        result = SeedScore(seed, None, _FAILED)
    study.set_user_attr(_name(number, seed), dataclasses.asdict(result))


def ranking(study: Study, trials: Sequence[FrozenTrial], seeds: Sequence[int], total: int) -> list[Finalist]:
    """Rank the finalists by all of their seeds.

    Args:
        study: the study, which has every final run's result.
        trials: the finalists.
        seeds: the final seeds.
        total: a run's budget in environment steps.

    Returns:
        The finalists, the winner first.
    """
    attributes = study.user_attrs
    found = []
    for trial in trials:
        results = [read_score(each) for each in trial.user_attrs[SEEDS]]
        results += [read_score(attributes[_name(trial.number, seed)]) for seed in seeds]
        certified = sum(result.certified_since is not None for result in results)
        value = score(results, total, len(results))
        failed = sum(result.regret == _FAILED for result in results)
        found.append(Finalist(trial.number, value, certified, len(results), failed))
    return sorted(found, key=lambda finalist: (finalist.score, finalist.trial))


def missing(
    study: Study, finalists: Sequence[tuple[int, Mapping[str, Any]]], seeds: Sequence[int]
) -> tuple[tuple[int, Mapping[str, Any], int], ...]:
    """The final runs, as in `FinalRuns`, that have no result yet.

    Args:
        study: the study.
        finalists: the number of each one's trial, and its values.
        seeds: the final seeds.
    """
    attributes = study.user_attrs
    runs = ((number, values, seed) for seed in seeds for number, values in finalists)
    return tuple(run for run in runs if _name(run[0], run[2]) not in attributes)


def _name(number: int, seed: int) -> str:
    return f"{FINAL}trial={number},seed={seed}"
