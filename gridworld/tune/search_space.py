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
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import optuna
from omegaconf import OmegaConf
from optuna.distributions import (
    BaseDistribution,
    CategoricalDistribution,
    FloatDistribution,
    IntDistribution,
)

from gridworld.config.fields import Effect
from gridworld.config.settings import effect_of
from gridworld.config.sweep import DimensionConfig
from gridworld.config.train import TrainConfig
from gridworld.errors import InputError
from gridworld.training.setup import check_settings
from gridworld.tune.objective import Values, with_values
from gridworld.world.mdp import Mdp

_GIVEN = (Effect.TASK, Effect.LENGTH, Effect.EVALUATION, Effect.SEED)
_CORNERS = 100
_DIGITS = 4  # of a real number: no learning rate needs more, and recipes are read by people


@dataclass(frozen=True)
class SearchSpace:
    """The dimensions, by key. Raises `InputError` for one that is wrong in itself."""

    dimensions: Mapping[str, DimensionConfig]
    name: str  # of its file

    def __post_init__(self) -> None:
        if not self.distributions:
            raise InputError(
                f"tune={self.name}: there is nothing to search; its file needs the first line "
                "'# @package tune.space' and a line for each key"
            )

    @cached_property
    def distributions(self) -> dict[str, BaseDistribution]:
        """The dimensions as Optuna's."""
        try:
            return {key: _distribution(key, each) for key, each in self.dimensions.items()}
        except InputError as error:
            raise InputError(f"tune={self.name}: {error}") from None

    def check(self, base: TrainConfig, mdp: Mdp) -> None:
        """Raise `InputError` unless every key is one of the configuration's and takes these values.

        A value that does not go with the base may still go with other choices, as a batch does with longer
        rollouts. It is refused if it goes with none of those that are tried.
        """

        def mistake(values: Values) -> InputError | None:
            try:
                check_settings(with_values(base, values), lambda env: mdp)
            except InputError as error:
                return error
            return None

        extremes = {key: self._extremes(key) for key in self.dimensions}
        rng = random.Random(0)
        alone = [{key: value} for key, values in extremes.items() for value in values]
        corners = ({key: rng.choice(values) for key, values in extremes.items()} for _ in range(_CORNERS))
        others = [*alone, *corners]
        for values in alone:
            found = mistake(values)
            if found and all(mistake(other | values) for other in others):
                raise InputError(f"tune={self.name}: {found}")

    def _extremes(self, key: str) -> list[Any]:
        distribution = self.distributions[key]
        if isinstance(distribution, FloatDistribution | IntDistribution):
            return [distribution.low, distribution.high]
        return self.dimensions[key].choices or []

    def values(self, parameters: Values) -> dict[str, Any]:
        """The values of a trial's parameters, which are as Optuna stores them."""
        known = [key for key in self.dimensions if key in parameters]
        return {key: _value(self.dimensions[key], parameters[key]) for key in known}

    def parameters_of(self, config: TrainConfig) -> dict[str, Any] | None:
        """The parameters, as Optuna stores them, of a configuration; None where it lies outside."""
        node = OmegaConf.structured(config)
        found = {}
        for key in self.dimensions:
            value = OmegaConf.select(node, key)
            found[key] = _token(OmegaConf.to_container(value) if OmegaConf.is_config(value) else value)
        try:
            optuna.create_trial(params=found, distributions=self.distributions, value=0.0)
        except (ValueError, TypeError):
            return None
        return found

    def plain(self) -> dict[str, Any]:
        """The dimensions as JSON."""
        return {
            key: {name: value for name, value in dataclasses.asdict(dimension).items() if value is not None}
            for key, dimension in self.dimensions.items()
        }


def _distribution(key: str, dimension: DimensionConfig) -> BaseDistribution:
    """The dimension as Optuna's. Raises `InputError` for a mistake in it."""
    kind, choices = dimension.type, dimension.choices
    low, high, step, log = dimension.low, dimension.high, dimension.step, dimension.log
    if (effect := effect_of(key)) in _GIVEN:
        raise InputError(f"{key}: is part of the task, not of what may be chosen to solve it")
    if effect is not Effect.LEARNING:
        raise InputError(f"{key}: changes nothing about what is learnt, so there is nothing to search")
    if kind == "categorical":
        if not choices or len(set(map(json.dumps, choices))) < len(choices):
            raise InputError(f"{key}: type=categorical takes choices, a list of different values")
        return CategoricalDistribution([_token(choice) for choice in choices])
    if kind not in ("float", "int"):
        raise InputError(f"{key}: type={kind} must be float, int or categorical")
    if low is None or high is None or not -math.inf < low < high < math.inf:
        raise InputError(f"{key}: type={kind} takes two numbers, low={low} below high={high}")
    if kind == "int" and not all(float(number).is_integer() for number in (low, high, step or 1.0)):
        raise InputError(f"{key}: type=int takes whole numbers; it has low={low}, high={high}, step={step}")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # that the step does not lead from low to high
            if kind == "float":
                return FloatDistribution(low, high, log=log, step=step)
            return IntDistribution(int(low), int(high), log=log, step=int(step or 1))
    except (ValueError, UserWarning) as error:
        raise InputError(f"{key}: {error}") from None


def _value(dimension: DimensionConfig, parameter: Any) -> Any:
    if dimension.type == "categorical":
        return {_token(choice): choice for choice in dimension.choices or []}[parameter]
    if dimension.type == "int":
        return int(parameter)
    return min(max(float(f"{parameter:.{_DIGITS}g}"), dimension.low or 0.0), dimension.high or 0.0)


def _token(choice: Any) -> Any:
    """The choice as a scalar, which Optuna's storages need: lists and mappings as JSON."""
    return choice if choice is None or isinstance(choice, bool | int | float | str) else json.dumps(choice)
