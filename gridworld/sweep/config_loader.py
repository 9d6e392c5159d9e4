"""Hydra's composition for many jobs that differ in values.

Hydra reads every file anew for every job: 50 ms, as long as a short run. Here files are read once per choice
of groups; values are then put into a copy, by Hydra's own function. The outcome is the same. A copy is read
from what `pickle` made of the first: `copy.deepcopy` takes six times as long. This builds on internals of
Hydra, which tests/sweep/test_config_loader.py checks one by one.
"""

from __future__ import annotations

import pickle
import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, cast

from hydra._internal.config_loader_impl import get_overrides_dirname
from hydra.core.config_loader import ConfigLoader
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from omegaconf import DictConfig, OmegaConf, open_dict, read_write

from gridworld.config.composition.compose import to_config
from gridworld.config.composition.loader import Loader
from gridworld.config.composition.words import with_whole_numbers
from gridworld.config.train import TrainConfig
from gridworld.errors import InputError

_MOST_BASES = 64
_SEED = re.compile(r"seed=(0|[1-9][0-9]*)")
_NUMBERED = "${hydra.job.num}"  # hydra.sweep.subdir unless it is set; the sweeper has its own names


class SweepLoader(Loader):
    """Replaces Hydra's loader in a launcher."""

    chooses_presets = False  # the plan does, which makes it a word of the job

    def __init__(self, loader: ConfigLoader) -> None:
        super().__init__(loader)
        self._bases: dict[tuple[str, ...], bytes] = {}
        self._settings: dict[tuple[str, ...], bytes] = {}  # of the last choice only

    def load_sweep_config(self, master_config: DictConfig, sweep_overrides: list[str]) -> DictConfig:
        """Compose a job's whole configuration, as Hydra's loader does.

        Args:
            master_config: the configuration of the sweep itself.
            sweep_overrides: the job's overrides.

        Raises:
            HydraException: overrides that do not fit.
        """
        overrides, choices = self._parse(sweep_overrides)
        config = self._base(master_config, choices)
        self._apply_overrides_to_config([o for o in overrides if o.input_line not in choices], config)
        tasks = [override for override in overrides if not override.is_hydra_override()]
        config.hydra.overrides.task = [override.input_line for override in tasks]
        given = cast("list[str]", OmegaConf.to_container(master_config.hydra.overrides.hydra, resolve=False))
        own = [str(override.input_line) for override in overrides if override.is_hydra_override()]
        config.hydra.overrides.hydra = given + own
        naming = config.hydra.job.config.override_dirname
        config.hydra.job.override_dirname = get_overrides_dirname(
            tasks, naming.exclude_keys, naming.item_sep, naming.kv_sep
        )
        OmegaConf.copy_cache(from_config=master_config, to_config=config)
        return config

    def load_settings(self, master_config: DictConfig, sweep_overrides: list[str]) -> DictConfig:
        """The same without `hydra`, which is most of it and takes most of the time.

        Raises:
            InputError: the command line, or a file that it chooses, sets the jobs' folders, which the sweeper
                does; or a file that one job chooses says which jobs there are.
            HydraException: overrides that do not fit.
        """
        overrides, choices = self._parse(sweep_overrides)
        if choices not in self._settings:
            settings = self._base(master_config, choices)
            _refuse_own_folders(settings, master_config)
            _refuse_own_lists(settings, master_config)
            HydraConfig.instance().set_config(settings)  # settings may refer to it: ${hydra:runtime.cwd}
            with read_write(settings), open_dict(settings):
                del settings["hydra"]
            self._settings = {choices: pickle.dumps(settings)}
        config: DictConfig = pickle.loads(self._settings[choices])
        values = [o for o in overrides if o.input_line not in choices and not o.is_hydra_override()]
        self._apply_overrides_to_config(values, config)
        OmegaConf.copy_cache(from_config=master_config, to_config=config)
        return config

    def _parse(self, lines: list[str]) -> tuple[list[Override], tuple[str, ...]]:
        """The overrides, and the lines of those that choose a group's file."""
        overrides = OverridesParser.create(config_loader=self).parse_overrides(with_whole_numbers(lines))
        return overrides, tuple(str(o.input_line) for o in overrides if self._is_choice(o))

    def _base(self, master: DictConfig, choices: tuple[str, ...]) -> DictConfig:
        """A fresh configuration with the groups chosen and no value changed."""
        if choices not in self._bases:
            if len(self._bases) >= _MOST_BASES:
                self._bases.clear()
            self._bases[choices] = pickle.dumps(super().load_sweep_config(master, list(choices)))
        config: DictConfig = pickle.loads(self._bases[choices])
        return config

    def _is_choice(self, override: Override) -> bool:
        is_group = self.repository.group_exists(override.key_or_group)
        return is_group and not isinstance(override.value(), dict)

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_bases": {}, "_settings": {}}


class Configurations:
    """Composes a sweep's jobs; of those that differ only in the seed, the first, for all of them.

    Args:
        loader: composes settings.
        master: the configuration of the sweep itself.
    """

    def __init__(self, loader: SweepLoader, master: DictConfig) -> None:
        self._loader = loader
        self._master = master
        self._known: dict[tuple[str, ...], bytes] = {}  # pickled, so that no two share a dictionary

    def __call__(self, overrides: Sequence[str]) -> TrainConfig:
        """Compose a job's overrides.

        Raises:
            InputError, HydraException: as `SweepLoader.load_settings` and `to_config`.
        """
        seeds = [int(found[1]) for word in overrides if (found := _SEED.fullmatch(word)) is not None]
        others = tuple(word for word in overrides if _SEED.fullmatch(word) is None)
        if len(seeds) == 1 and others in self._known:
            known: TrainConfig = pickle.loads(self._known[others])
            return replace(known, seed=seeds[0])
        settings = self._loader.load_settings(self._master, list(overrides))
        config = to_config(settings)
        if len(seeds) == 1 and not _depends_on_seed(OmegaConf.to_container(settings, resolve=False)):
            self._known[others] = pickle.dumps(config)
        return config


def _depends_on_seed(node: object) -> bool:
    """Whether an interpolation names what is another for each seed."""
    if isinstance(node, dict | list):
        return any(map(_depends_on_seed, node.values() if isinstance(node, dict) else node))
    return isinstance(node, str) and "${" in node and ("seed" in node or "hydra" in node)


def _refuse_own_lists(settings: DictConfig, master: DictConfig) -> None:
    for key in ("params", "paired"):
        if settings.hydra.sweeper.get(key) != master.hydra.sweeper.get(key):
            raise InputError(
                f"hydra.sweeper.{key}: stands in a file that only some of the jobs choose, and says which "
                "jobs there are; choose that file for all of them"
            )


def _refuse_own_folders(settings: DictConfig, master: DictConfig) -> None:
    own, given = (OmegaConf.to_container(c.hydra.sweep, resolve=False) for c in (settings, master))
    assert isinstance(own, dict)
    assert isinstance(given, dict)
    if own.get("subdir") != _NUMBERED:
        raise InputError(
            f"hydra.sweep.subdir={own.get('subdir')}: a sweep names the folders of its jobs itself, by the "
            "settings in which they differ; leave it out"
        )
    if own["dir"] != given["dir"]:
        raise InputError(
            f"hydra.sweep.dir={own['dir']}: stands in a file that only some of the jobs choose, and a sweep "
            "has one folder; give it on the command line"
        )
