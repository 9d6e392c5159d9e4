"""The configurations of a sweep's jobs: composed by Hydra once per choice of files, values put into copies.

Hydra reads every file anew for every job, which takes as long as a short run.
"""

from __future__ import annotations

import functools
import pickle
import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, cast

from hydra.core.config_loader import ConfigLoader
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, OverrideType
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gridworld.config.compose import drop_hydra, to_config
from gridworld.config.train import TrainConfig
from gridworld.config.words import prepared
from gridworld.errors import InputError

_MOST_BASES = 64
_SEED = re.compile(r"seed=(0|[1-9][0-9]*)")
_NUMBERED = "${hydra.job.num}"  # hydra.sweep.subdir unless it is set; the sweeper has its own names
# Of Hydra's own part: what all jobs of a sweep have in common.
_SHARED = ("sweep", "sweeper", "launcher", "callbacks", "job.chdir", "job.env_set", "output_subdir")


class Configurations:
    """Composes jobs; of those that differ only in the seed, the first, for all of them."""

    def __init__(self, loader: ConfigLoader, master: DictConfig) -> None:
        subdir = _plain(master, "sweep")["subdir"]
        if subdir != _NUMBERED:
            raise InputError(
                f"hydra.sweep.subdir={subdir}: a sweep names the folders of its jobs itself, by the settings "
                "in which they differ; leave it out"
            )
        HydraConfig.instance().set_config(master)  # settings may refer to it: ${hydra:runtime.cwd}
        self._loader = loader
        self._master = master
        self._bases: dict[tuple[str, ...], bytes] = {}  # pickled, which copies faster
        self._known: dict[tuple[str, ...], bytes] = {}
        self._is_group = functools.cache(self._find_group)

    def __call__(self, words: Sequence[str]) -> TrainConfig:
        """Compose a job's overrides."""
        seeds = [int(found[1]) for word in words if (found := _SEED.fullmatch(word)) is not None]
        others = tuple(word for word in words if _SEED.fullmatch(word) is None)
        if len(seeds) == 1 and others in self._known:
            known: TrainConfig = pickle.loads(self._known[others])
            return replace(known, seed=seeds[0])
        settings = self._compose(prepared(words))
        config = to_config(settings)
        text = OmegaConf.to_yaml(settings) if len(seeds) == 1 else "${seed}"
        if not re.search(r"\$\{[^}]*(seed|hydra)", text):
            self._known[others] = pickle.dumps(config)
        return config

    def _compose(self, words: list[str]) -> DictConfig:
        overrides = OverridesParser.create(config_loader=self._loader).parse_overrides(words)
        choices = [override for override in overrides if self._is_choice(override)]
        rest = [override for override in overrides if override not in choices]
        own = [place for place, override in enumerate(rest, 1) if not _is_value(override)]
        ours = rest[max(own, default=0) :]  # Hydra applies values in their order, after all choices
        lines = tuple(str(each.input_line) for each in overrides if each not in ours)
        if lines not in self._bases:
            if len(self._bases) >= _MOST_BASES:
                self._bases.clear()
            self._bases[lines] = pickle.dumps(self._by_hydra(list(lines)))
        settings: DictConfig = pickle.loads(self._bases[lines])
        try:
            for override in ours:
                OmegaConf.update(settings, override.key_or_group, override.value())
        except OmegaConfBaseException:
            return self._by_hydra(words)  # which says what is wrong
        return settings

    def _by_hydra(self, words: list[str]) -> DictConfig:
        whole = self._loader.load_sweep_config(self._master, words)
        for key in _SHARED:
            if _plain(whole, key) != _plain(self._master, key):
                raise InputError(
                    f"hydra.{key}: is set in a file that only some of the jobs choose, and all jobs of a "
                    "sweep have it in common; choose that file for all, or give it on the command line"
                )
        return drop_hydra(whole)

    def _is_choice(self, override: Override) -> bool:
        return self._is_group(override.key_or_group) and not isinstance(override.value(), dict)

    def _find_group(self, key: str) -> bool:
        return bool(self._loader.get_group_options(key))


def _is_value(override: Override) -> bool:
    """Whether an override changes a plain value, and nothing else."""
    is_change = override.type is OverrideType.CHANGE and override.package is None
    return is_change and not isinstance(override.value(), dict | list)


def _plain(whole: DictConfig, key: str) -> Any:
    """A part of Hydra's own, unresolved."""
    *path, last = key.split(".")
    node = functools.reduce(lambda part, name: part[name], path, whole.hydra)
    return cast("dict[str, Any]", OmegaConf.to_container(node, resolve=False)).get(last)
