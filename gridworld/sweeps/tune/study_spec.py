"""What a study's command line asks for: the configuration to begin from, and how to search.

There are two compositions. What does not begin with `tune` is composed as by train.py, so that a search
begins from the very configuration that train.py runs; the rest is composed with conf/tune.yaml. The search
space has a range or a list for each key of the configuration, or argument of the agent's class.
"""

from __future__ import annotations

import dataclasses
import json
import math
import random
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, cast

import optuna
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution, IntDistribution
from yaml import YAMLError

from gridworld.base.console import program
from gridworld.base.errors import InputError
from gridworld.base.processes import worker_count
from gridworld.config.compose import (
    compose_run,
    compose_whole,
    refuse_unused,
    register_schemas,
    search_path,
    slug,
)
from gridworld.config.fields import Effect
from gridworld.config.messages import sentence
from gridworld.config.recipe_file import with_recipe
from gridworld.config.recipes import CHOSEN
from gridworld.config.settings import effect_of
from gridworld.config.sweep import DimensionConfig, TuneConfig
from gridworld.config.train import TrainConfig, check_bounds
from gridworld.run.folder import check_inside
from gridworld.sweeps.tune.objective import Objective, Values, with_values
from gridworld.training.setup import check_settings
from gridworld.world.mdp import Mdp

_GIVEN = (Effect.TASK, Effect.LENGTH, Effect.EVALUATION, Effect.SEED)
_CORNERS = 100
_DIGITS = 4  # of a real number: no learning rate needs more, and recipes are read by people
_KNOWN = {"sampler": ("tpe", "random"), "pruner": ("median", "hyperband", "none")}
_LARGEST_SEED = 2**32
_TRIALS_AT_ONCE = 8  # over all workers; the sampler knows nothing of those that have not ended


@dataclass(frozen=True)
class StudySpec:
    """What a command line asks for."""

    name: str  # the study's
    folder: Path  # the study's
    conf: tuple[Path, ...]  # the user's own folders of yaml files, which are searched after `conf/`
    base: TrainConfig  # the configuration that the search begins from
    choices: dict[str, str]  # of CHOSEN
    words: list[str]  # of a command line that gives the base, but for the seed
    settings: TuneConfig  # without null where a default follows from the rest
    space: SearchSpace

    @property
    def objective(self) -> Objective:
        """What is minimised: the base evaluated often enough, on the first seeds."""
        evaluation, settings = self.base.evaluation, self.settings
        every = min(evaluation.every, math.ceil(self.base.total_timesteps / settings.evaluations))
        measured = dataclasses.replace(self.base, evaluation=dataclasses.replace(evaluation, every=every))
        seeds = tuple(range(self.base.seed, self.base.seed + settings.seeds))
        return Objective(measured, seeds, settings.reports, settings.stop_after)

    @property
    def final_seeds(self) -> range:
        """The seeds that the finalists are run on besides."""
        first = self.base.seed + self.settings.seeds
        return range(first, first + self.settings.final_seeds)

    @property
    def held_out(self) -> range:
        """The held-out seeds after those, by which nothing is chosen."""
        return range(self.final_seeds.stop, self.final_seeds.stop + self.settings.confirm_seeds)


def compose_study(words: Sequence[str], conf: tuple[Path, ...] = ()) -> StudySpec:
    """Compose and check everything that a command line asks for; `conf` are folders of the user's own.

    Raises `InputError`.
    """
    register_schemas()
    try:
        of_search, of_run = _divide(with_recipe(words))
        base, chosen, _ = compose_run([*of_run, *search_path(conf)])
        refuse_unused(chosen.hydra, but=("ray", "slurm"))  # it runs here
        choices = {group: getattr(chosen, group) for group in CHOSEN} | {"tuned": chosen.recipe or "none"}
        if not any(re.match(r"[+~]*tune(?!\.)", word) for word in of_search):
            of_search.append(f"tune={choices['agent']}")
        search = compose_whole("tune", [*of_search, *search_path(conf)])
        settings = cast(TuneConfig, OmegaConf.to_object(search.tune))
    except (HydraException, OmegaConfBaseException, YAMLError, OSError, ValueError) as error:
        raise InputError(sentence(error)) from None
    settings = _completed(settings, choices["agent"], base)
    mdp = check_settings(base)
    try:
        space = SearchSpace(settings.space)
        space.check(base, mdp)
    except InputError as error:
        raise InputError(f"tune={search.hydra.runtime.choices.tune}: {error}") from None
    words = [f"{group}={choice}" for group, choice in choices.items()]
    words += [word for word in of_run if word.partition("=")[0] not in (*CHOSEN, "seed", "hydra/launcher")]
    name, folder = str(settings.study), Path(str(settings.folder))
    spec = StudySpec(name, folder, conf, base, choices, words, settings, space)
    if spec.held_out.stop > _LARGEST_SEED:
        raise InputError(f"seed={base.seed}: leaves no room for the seeds after it, below 2**32")
    return spec


def _divide(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """Overrides of the search and of the run."""
    of_search, of_run = list[str](), list[str]()
    for override in OverridesParser.create().parse_overrides(list(words)):
        if override.is_sweep_override():
            raise InputError(
                f"{override.input_line}: a study has one baseline configuration; give one value, and put "
                "the search space into a file in conf/tune"
            )
        if override.key_or_group.startswith("hydra."):
            raise InputError(
                f"{override.input_line}: {program('tune')} makes its own folder; use tune.folder"
            )
        is_of_search = override.key_or_group.split(".")[0] == "tune"
        (of_search if is_of_search else of_run).append(str(override.input_line))
    return of_search, of_run


def _completed(settings: TuneConfig, agent: str, base: TrainConfig) -> TuneConfig:
    """Check the settings, and fill in what follows from the rest."""
    check_bounds(settings, "tune.")
    if settings.workers == 0:
        raise InputError("tune.workers=0: must be at least 1, or -1 for one on each core")
    for key, known in _KNOWN.items():
        if (value := getattr(settings, key)) not in known:
            raise InputError(f"tune.{key}={value}: must be {', '.join(known[:-1])} or {known[-1]}")
    study = settings.study or f"tune_{slug(agent)}_{slug(base.env.name)}"
    if slug(study) != study:
        raise InputError(
            f"tune.study={study}: must consist of letters, digits and _.,=+-, e.g. {slug(study)}"
        )
    workers = worker_count(settings.workers)
    together = settings.together or (1 if workers == 1 else math.ceil(_TRIALS_AT_ONCE / workers))
    together = together if base.agent.shape is not None else 1
    folder = settings.folder or f"runs/{study}"
    check_inside(Path(folder), "tune.folder")
    return dataclasses.replace(settings, study=study, folder=folder, workers=workers, together=together)


@dataclass(frozen=True)
class SearchSpace:
    """The dimensions, by key. Raises `InputError` for one that is wrong in itself."""

    dimensions: Mapping[str, DimensionConfig]

    def __post_init__(self) -> None:
        if not self.distributions:
            raise InputError(
                "the search space is empty; its file needs '# @package tune.space' as first line, then a "
                "line per key"
            )

    @cached_property
    def distributions(self) -> dict[str, BaseDistribution]:
        """The dimensions as Optuna's."""
        return {key: _distribution(key, each) for key, each in self.dimensions.items()}

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

        extremes: dict[str, list[Any]] = {key: each.choices or [] for key, each in self.dimensions.items()}
        for key, each in self.distributions.items():
            if isinstance(each, FloatDistribution | IntDistribution):
                extremes[key] = [each.low, each.high]
        rng = random.Random(0)
        alone = [{key: value} for key, values in extremes.items() for value in values]
        corners = ({key: rng.choice(values) for key, values in extremes.items()} for _ in range(_CORNERS))
        others = [*alone, *corners]
        for values in alone:
            found = mistake(values)
            if found and all(mistake(other | values) for other in others):
                raise found

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
        raise InputError(f"{key}: is part of the task, so it cannot be searched")
    if effect is not Effect.LEARNING:
        raise InputError(f"{key}: does not affect what is learned, so it cannot be searched")
    if kind == "categorical":
        if not choices or len(set(map(json.dumps, choices))) < len(choices):
            raise InputError(f"{key}: type=categorical needs choices, a list of different values")
        return CategoricalDistribution([_token(choice) for choice in choices])
    if kind not in ("float", "int"):
        raise InputError(f"{key}: type={kind} must be float, int or categorical")
    if low is None or high is None or not -math.inf < low < high < math.inf:
        raise InputError(f"{key}: type={kind} needs two numbers with low < high, not low={low}, high={high}")
    if kind == "int" and not all(float(number).is_integer() for number in (low, high, step or 1.0)):
        raise InputError(f"{key}: type=int needs whole numbers, not low={low}, high={high}, step={step}")
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
