"""The search space: for each key of the configuration the values to choose from.

    agent.learning_rate: {type: float, low: 1e-4, high: 3e-2, log: true}
    agent.n_epochs: {type: int, low: 2, high: 10}
    agent.policy_kwargs.net_arch: {type: categorical, choices: [[64], [64, 64]]}

A key is one of a run's configuration, or an argument of the agent's class. Before anything runs, both ends of
a range and every choice of a list are put into the configuration, and it is checked as a run's would be.
"""

from __future__ import annotations

import dataclasses
import json
import math
import random
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from omegaconf import OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

from gridworld.config.composition.compose import to_config
from gridworld.config.fields import Effect
from gridworld.config.settings import effect_of
from gridworld.config.train import TrainConfig
from gridworld.config.tune import DimensionConfig
from gridworld.errors import InputError
from gridworld.training.setup import check_settings
from gridworld.world.mdp import Mdp

if TYPE_CHECKING:
    from optuna.trial import Trial

Values = Mapping[str, Any]  # {"agent.learning_rate": 0.01, ...}

_TYPES = ("float", "int", "categorical")
_GIVEN = (Effect.TASK, Effect.LENGTH, Effect.EVALUATION, Effect.SEED)
_CORNERS = 100
_DIGITS = 4  # of a real number: no learning rate needs more, and recipes are read by people


@dataclass(frozen=True)
class SearchSpace:
    """The dimensions, by key. Raises `InputError` for one that is wrong in itself."""

    dimensions: Mapping[str, DimensionConfig]
    name: str  # of its file

    def __post_init__(self) -> None:
        if not self.dimensions:
            raise InputError(
                f"tune={self.name}: there is nothing to search; its file needs the first line "
                "'# @package tune.space' and a line for each key"
            )
        for key, dimension in self.dimensions.items():
            try:
                _check(key, dimension)
            except InputError as error:
                raise InputError(f"tune={self.name}: {error}") from None

    def check(self, base: TrainConfig, mdp: Mdp) -> None:
        """Raise `InputError` unless every key is one of the configuration's and takes these values.

        A value that does not go with the base may still go with other choices, as a batch does with longer
        rollouts. It is refused if it goes with none of those that are tried.

        Args:
            base: the configuration that the search begins from.
            mdp: its world.
        """

        def mistake(values: Values) -> InputError | None:
            try:
                check_settings(with_values(base, values), lambda env: mdp)
            except InputError as error:
                return error
            return None

        for key, dimension in self.dimensions.items():
            for value in _extremes(dimension):
                found = mistake({key: value})
                if found and all(mistake({**others, key: value}) for others in self._corners()):
                    raise InputError(f"tune={self.name}: {found}")

    def _corners(self) -> Iterator[dict[str, Any]]:
        """Each value alone, then some points that have an extreme value for every key."""
        extremes = {key: list(_extremes(dimension)) for key, dimension in self.dimensions.items()}
        yield from ({key: value} for key, values in extremes.items() for value in values)
        rng = random.Random(0)
        for _ in range(_CORNERS):
            yield {key: rng.choice(values) for key, values in extremes.items()}

    def suggest(self, trial: Trial) -> dict[str, Any]:
        """Let the study's sampler choose a value for every key of a trial."""
        return {key: _suggest(trial, key, dimension) for key, dimension in self.dimensions.items()}

    def values(self, parameters: Values) -> dict[str, Any]:
        """The values of a trial's parameters, which are as Optuna stores them."""
        return {
            key: _value(dimension, parameters[key])
            for key, dimension in self.dimensions.items()
            if key in parameters
        }

    def parameters_of(self, config: TrainConfig) -> dict[str, Any] | None:
        """The parameters, as Optuna stores them, of a configuration; None where it lies outside."""
        node = OmegaConf.structured(config)
        found = {}
        for key, dimension in self.dimensions.items():
            value = OmegaConf.select(node, key)
            value = OmegaConf.to_container(value) if OmegaConf.is_config(value) else value
            parameter = _parameter(dimension, value)
            if parameter is _OUTSIDE:
                return None
            found[key] = parameter
        return found

    def plain(self) -> dict[str, Any]:
        """The dimensions as JSON."""
        return {
            key: {name: value for name, value in dataclasses.asdict(dimension).items() if value is not None}
            for key, dimension in self.dimensions.items()
        }


def with_values(config: TrainConfig, values: Values) -> TrainConfig:
    """The configuration with these values in it. Raises `InputError` where one does not fit its schema."""
    node = OmegaConf.structured(config)
    for key, value in values.items():
        try:
            with open_dict(node):
                OmegaConf.update(node, key, value)
        except OmegaConfBaseException as error:
            raise InputError(f"{key}={value}: {str(error).splitlines()[0]}") from None
    return to_config(node)


_OUTSIDE: Any = object()


def _check(key: str, dimension: DimensionConfig) -> None:
    kind = dimension.type
    if kind not in _TYPES:
        raise InputError(f"{key}: type={kind} must be {', '.join(_TYPES[:-1])} or {_TYPES[-1]}")
    if (effect := effect_of(key)) in _GIVEN:
        raise InputError(f"{key}: is part of the task, not of what may be chosen to solve it")
    if effect is not Effect.LEARNING:
        raise InputError(f"{key}: changes nothing about what is learnt, so there is nothing to search")
    if kind == "categorical":
        choices = dimension.choices or []
        if len({json.dumps(choice) for choice in choices}) < max(1, len(choices)):
            raise InputError(f"{key}: choices={choices} must be a list of different values")
        if (dimension.low, dimension.high, dimension.step, dimension.log) != (None, None, None, False):
            raise InputError(f"{key}: a categorical key has choices, no low, high, step or log")
        return
    if dimension.choices is not None:
        raise InputError(f"{key}: choices are for type=categorical; type={kind} has low and high")
    low, high, step = dimension.low, dimension.high, dimension.step
    if low is None or high is None or not -math.inf < low < high < math.inf:
        raise InputError(f"{key}: low={low}, high={high} must be two numbers, the first below the second")
    if dimension.log and (low <= 0 or step is not None):
        raise InputError(f"{key}: log=true needs a positive low and no step; it has low={low}, step={step}")
    if step is not None and not (step > 0 and _is_multiple(high - low, step)):
        raise InputError(f"{key}: step={step} must lead from low={low} to high={high}")
    if kind == "int" and not all(float(number).is_integer() for number in (low, high, step or 1.0)):
        raise InputError(f"{key}: type=int takes whole numbers; it has low={low}, high={high}, step={step}")


def _is_multiple(distance: float, step: float) -> bool:
    return math.isclose(distance / step, round(distance / step), abs_tol=1e-9)


def _extremes(dimension: DimensionConfig) -> Iterator[Any]:
    if dimension.type == "categorical":
        yield from dimension.choices or []
    else:
        number = int if dimension.type == "int" else float
        yield from (number(dimension.low or 0), number(dimension.high or 0))


def _suggest(trial: Trial, key: str, dimension: DimensionConfig) -> Any:
    if dimension.type == "categorical":
        return _value(
            dimension, trial.suggest_categorical(key, [_token(choice) for choice in dimension.choices or []])
        )
    low, high, step = dimension.low or 0.0, dimension.high or 0.0, dimension.step
    if dimension.type == "int":
        return trial.suggest_int(key, int(low), int(high), step=int(step or 1), log=dimension.log)
    return _value(dimension, trial.suggest_float(key, low, high, step=step, log=dimension.log))


def _value(dimension: DimensionConfig, parameter: Any) -> Any:
    if dimension.type == "categorical":
        found = [choice for choice in dimension.choices or [] if _token(choice) == parameter]
        if not found:
            raise ValueError(f"{str(parameter)[:40]} is none of the choices")
        return found[0]
    if dimension.type == "int":
        return int(parameter)
    return min(max(float(f"{parameter:.{_DIGITS}g}"), dimension.low or 0.0), dimension.high or 0.0)


def _parameter(dimension: DimensionConfig, value: Any) -> Any:
    if dimension.type == "categorical":
        return _token(value) if value in (dimension.choices or []) else _OUTSIDE
    if isinstance(value, bool) or not isinstance(value, int | float):
        return _OUTSIDE
    low, high = dimension.low or 0.0, dimension.high or 0.0
    step = dimension.step or (1.0 if dimension.type == "int" else None)
    is_on_grid = step is None or _is_multiple(value - low, step)
    return value if low <= value <= high and is_on_grid else _OUTSIDE


def _token(choice: Any) -> Any:
    """The choice as a scalar, which Optuna's storages need: lists and mappings as JSON."""
    return choice if choice is None or isinstance(choice, bool | int | float | str) else json.dumps(choice)
