"""Hydra's side of `scripts/tune.py`: a command line as the configuration to begin from and how to search.

There are two compositions. What does not begin with `tune` is composed as by train.py, so that a search
begins from the very configuration that train.py runs; the rest is composed with conf/tune.yaml.
"""

from __future__ import annotations

import dataclasses
import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from gridworld.config.compose import compose_whole, register_schemas, search_path, slug, to_config
from gridworld.config.recipe_file import CHOSEN, with_recipe
from gridworld.config.sweep import TuneConfig
from gridworld.config.train import AUTO, TrainConfig, check_bounds
from gridworld.config.words import sentence
from gridworld.errors import InputError
from gridworld.process.console import program
from gridworld.process.processes import core_count
from gridworld.training.setup import check_settings
from gridworld.tune.objective import Objective
from gridworld.tune.search_space import SearchSpace

_KNOWN = {"sampler": ("tpe", "random"), "pruner": ("median", "hyperband", "none")}
_LARGEST_SEED = 2**32
_TRIALS_AT_ONCE = 8  # over all workers; the sampler knows nothing of those that have not ended


@dataclass(frozen=True)
class ConfFolders:
    """Where yaml files come from: `conf`, and the user's own folders, which are searched after it."""

    conf: Path
    own: tuple[Path, ...] = ()


@dataclass(frozen=True)
class StudySpec:
    """What a command line asks for."""

    folders: ConfFolders
    base: TrainConfig  # the configuration that the search begins from
    choices: dict[str, str]  # of CHOSEN
    settings: TuneConfig  # without null where a default follows from the rest
    space: SearchSpace

    @property
    def name(self) -> str:
        """The study's name."""
        return str(self.settings.study)

    @property
    def folder(self) -> Path:
        """The study's folder."""
        return Path(str(self.settings.folder))

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


def compose_study(folders: ConfFolders, words: Sequence[str]) -> StudySpec:
    """Compose and check everything that a command line asks for. Raises `InputError`."""
    register_schemas()
    try:
        of_search, of_run = _divide(with_recipe(words))
        whole = compose_in(folders, "train", of_run)
        choices = {group: str(whole.hydra.runtime.choices[group]) for group in CHOSEN}
        if choices["preset"] == AUTO:  # nothing was chosen, and nothing is to be for the winner
            choices["preset"] = "none"
        base = to_config(whole)
        if base.recipe is None:  # the pair has none
            choices["tuned"] = "none"
        if not any(override.key_or_group == "tune" for override in of_search):
            of_search = [*of_search, *_parse([f"tune={choices['agent']}"])]
        search = compose_in(folders, "tune", of_search)
        space_name = str(search.hydra.runtime.choices["tune"])
        settings = cast(TuneConfig, OmegaConf.to_object(search.tune))
    except (YAMLError, HydraException, OmegaConfBaseException) as error:
        raise InputError(sentence(error)) from None
    _check(settings)
    settings = _completed(settings, choices["agent"], base)
    space = SearchSpace(settings.space, space_name)
    space.check(base, check_settings(base))
    spec = StudySpec(folders, base, choices, settings, space)
    if spec.held_out.stop > _LARGEST_SEED:
        raise InputError(f"seed={base.seed}: leaves no room for the other seeds after it, below 2**32")
    return spec


def compose_in(folders: ConfFolders, name: str, overrides: Sequence[Override | str]) -> DictConfig:
    """Compose `name` as Hydra does, with Hydra's own part. Raises Hydra's exceptions."""
    lines = [str(each.input_line) if isinstance(each, Override) else each for each in overrides]
    if folders.own:
        lines.append(search_path(folders.own))
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)  # a folder that is not there
        return compose_whole(folders.conf.absolute(), name, lines)[0]


def _divide(words: Sequence[str]) -> tuple[list[Override], list[Override]]:
    """Overrides of the search and of the run."""
    of_search, of_run = list[Override](), list[Override]()
    for override in _parse(words):
        if override.is_sweep_override():
            raise InputError(
                f"{override.input_line}: a study searches from one configuration; give one value, and put "
                "what is to be searched into a file in conf/tune"
            )
        if override.key_or_group.startswith("hydra."):
            raise InputError(
                f"{override.input_line}: {program('tune')} makes its own folder; see tune.folder"
            )
        (of_search if override.key_or_group.split(".")[0] == "tune" else of_run).append(override)
    return of_search, of_run


def _parse(words: Sequence[str]) -> list[Override]:
    return OverridesParser.create().parse_overrides(list(words))


def _check(settings: TuneConfig) -> None:
    check_bounds(settings, "tune.")
    if settings.workers == 0:
        raise InputError("tune.workers=0: must be at least 1, or -1 for one on each core")
    for key, known in _KNOWN.items():
        if (value := getattr(settings, key)) not in known:
            raise InputError(f"tune.{key}={value}: must be {', '.join(known[:-1])} or {known[-1]}")


def _completed(settings: TuneConfig, agent: str, base: TrainConfig) -> TuneConfig:
    study = settings.study or f"tune_{slug(agent)}_{slug(base.env.name)}"
    if slug(study) != study:
        raise InputError(f"tune.study={study}: must be of letters, digits and _.,=+-, e.g. {slug(study)}")
    workers = core_count() if settings.workers == -1 else settings.workers
    together = settings.together or (1 if workers == 1 else math.ceil(_TRIALS_AT_ONCE / workers))
    together = together if base.agent.shape is not None else 1
    folder = settings.folder or f"runs/{study}"
    return dataclasses.replace(settings, study=study, folder=folder, workers=workers, together=together)
