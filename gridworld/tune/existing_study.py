"""Checks of a study that is there already: its database may have been changed by anybody."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Mapping
from typing import Any

import optuna
from optuna.exceptions import OptunaError
from optuna.study import StudyDirection
from optuna.trial import FrozenTrial, TrialState
from sqlalchemy.exc import SQLAlchemyError

from gridworld.errors import InputError
from gridworld.tune.finalists import FINAL
from gridworld.tune.search.objective import DRAW, ERROR, SEEDS, WORKER, read_score
from gridworld.tune.search.search_space import SearchSpace

_NOT_OURS = (
    *(ValueError, TypeError, LookupError, AttributeError, ArithmeticError, RuntimeError, AssertionError),
)


@contextlib.contextmanager
def legible(shown_url: str) -> Iterator[None]:
    """Raise `InputError`, naming the URL, for what a database causes that Optuna cannot read."""
    try:
        yield
    except InputError:
        raise
    except (SQLAlchemyError, OptunaError, *_NOT_OURS) as error:
        lines = str(getattr(error, "orig", None) or error).strip().splitlines() or [""]
        raise InputError(
            f"tune.storage={shown_url}: cannot be read as a study, it was changed or damaged "
            f"({type(error).__name__}: {lines[0][:200]}); put back a good copy"
        ) from None


def check_study(study: optuna.Study, space: SearchSpace) -> None:
    """Raise `InputError` unless all trials are of this space, with scores that a search can go on from."""
    if study.directions != [StudyDirection.MINIMIZE]:
        raise InputError(f"tune.study={study.study_name}: is to make something else than one score small")
    for trial in study.get_trials(deepcopy=False):
        try:
            _check_trial(trial, space)
        except _NOT_OURS as error:
            raise InputError(
                f"tune.study={study.study_name}: trial {trial.number} was changed or damaged ({error}); put "
                "back a good copy of the database"
            ) from None
    for key, value in study.user_attrs.items():
        if key.startswith(FINAL):
            try:
                read_score(value)
            except ValueError as error:
                raise InputError(f"tune.study={study.study_name}: {key}: {error}") from None


def _check_trial(trial: FrozenTrial, space: SearchSpace) -> None:
    values = space.values(trial.params)
    if unknown := trial.params.keys() - values.keys():
        raise ValueError(f"{min(unknown)} is not searched")
    for key, value in values.items():
        dimension = space.dimensions[key]
        low, high = dimension.low, dimension.high
        if low is not None and high is not None and not low <= value <= high:
            raise ValueError(f"{key}={value} must be from {low} to {high}")
    if trial.state == TrialState.COMPLETE:
        _check_complete(trial, space)
    if any(type(value) is not float for value in trial.intermediate_values.values()):
        raise ValueError("a score on its way is no number")
    _check_attributes(trial.user_attrs)


def _check_complete(trial: FrozenTrial, space: SearchSpace) -> None:
    if trial.value is None or not math.isfinite(trial.value):
        raise ValueError(f"its score {trial.value} is no number")
    if missing := space.dimensions.keys() - trial.params.keys():
        raise ValueError(f"it has no {min(missing)}")
    if not trial.user_attrs.get(SEEDS):
        raise ValueError("it has no seeds")


def _check_attributes(own: Mapping[str, Any]) -> None:
    for key in (ERROR, WORKER):
        if not isinstance(own.get(key, ""), str):
            raise ValueError(f"{key} must be a text")
    for seed in own.get(SEEDS, []):
        read_score(seed)
    if type(own.get(DRAW, 0)) is not int:
        raise ValueError(f"{DRAW} must be a whole number")
