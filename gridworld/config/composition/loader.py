"""Hydra with three changes: whole numbers such as 1e5 for integers, presets for the world, composing once.

This builds on internals of Hydra, which tests/sweep/test_config_loader.py checks one by one.
"""

from __future__ import annotations

import contextlib
import difflib
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import hydra
from hydra._internal import hydra as internals
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra.core.config_loader import ConfigLoader
from hydra.core.default_element import ResultDefault
from hydra.core.global_hydra import GlobalHydra
from hydra.plugins.config_source import ConfigResult
from hydra.types import RunMode, TaskFunction
from omegaconf import DictConfig

from gridworld.config.composition.presets import with_preset
from gridworld.config.composition.words import make_whole, with_whole_numbers
from gridworld.errors import InputError

_VERSION_BASE = "1.3"
_WITHOUT_MODE = ("pkg://hydra.conf", "structured://")  # Hydra's own files, and the schemas
# A file of these may set hydra.mode, or add files that do. A backslash may write the one or the other.
_MAY_SET_MODE = re.compile(rb"\bmode\b|\bsearchpath\b|\\")
_WORD_MAY_SET_MODE = re.compile(r"^\W*hydra\s*(=|@)|\bmode\b|\bsearchpath\b|@")


class Loader(ConfigLoaderImpl):
    """Hydra's loader, which also takes a float that is a whole number where a setting is an integer."""

    chooses_presets = True  # where it composes all of a command line

    def __init__(self, loader: ConfigLoader) -> None:
        super().__init__(loader.get_search_path())

    def load_configuration(
        self,
        config_name: str | None,
        overrides: list[str],
        run_mode: RunMode,
        from_shell: bool = True,
        validate_sweep_overrides: bool = True,
    ) -> DictConfig:
        """Compose, as Hydra's loader does, and again with the preset that a run's world asks for."""
        words = with_whole_numbers(overrides)
        self._check_recipe(words)
        rest = run_mode, from_shell, validate_sweep_overrides
        load = super().load_configuration
        found = load(config_name, words, *rest)
        if config_name == "train" and run_mode is RunMode.RUN and self.chooses_presets:
            found, _ = with_preset(found, words, lambda more: load(config_name, [*words, *more], *rest))
        return found

    def _check_recipe(self, words: list[str]) -> None:
        """Refuse a recipe that there is not, which the defaults list would leave out without a word."""
        for name in (word.removeprefix("tuned=") for word in words if word.startswith("tuned=")):
            if re.fullmatch(r"\w+", name) and not self.repository.config_exists(f"tuned/{name}"):
                known = self.get_group_options("tuned")
                near = difflib.get_close_matches(name, known)
                hint = f"; close to it are {', '.join(near)}" if near else ""
                raise InputError(f"tuned={name}: there is no such recipe{hint}; --help lists them all")

    def _load_single_config(self, default: ResultDefault, repo: Any) -> ConfigResult:
        found = super()._load_single_config(default, repo)
        if not found.is_schema_source and isinstance(found.config, DictConfig):
            make_whole(found.config)
        return found


class _Hydra(internals.Hydra):
    """Hydra's application, which composes only once where nothing can have set `hydra.mode`."""

    def __init__(self, task_name: str, config_loader: ConfigLoader) -> None:
        super().__init__(task_name, Loader(config_loader))

    def get_mode(self, config_name: str | None, overrides: list[str]) -> Any:
        """What is set as `hydra.mode`; None: nothing. Hydra composes everything to find that out."""
        sources = [str(element.path) for element in self.config_loader.get_search_path().get_path()]
        if any(map(_WORD_MAY_SET_MODE.search, overrides)) or any(map(_source_may_set_mode, sources)):
            return super().get_mode(config_name, overrides)
        return None


def _source_may_set_mode(source: str) -> bool:
    scheme, _, folder = source.rpartition("://")
    if scheme not in ("", "file"):
        return source not in _WITHOUT_MODE
    return any(map(_MAY_SET_MODE.search, _yaml_texts(folder)))


def _yaml_texts(folder: str) -> Iterator[bytes]:
    for place, _, names in os.walk(folder, followlinks=True):
        for name in names:
            if name.endswith(".yaml"):
                with contextlib.suppress(OSError):  # Hydra says so where it needs the file
                    yield Path(place, name).read_bytes()


def run_hydra(job: TaskFunction, conf: Path) -> None:
    """Run the command line in `sys.argv` as `hydra.main` does.

    Args:
        job: called with the settings of each run.
        conf: the folder of the yaml files.
    """
    theirs = internals.Hydra
    internals.Hydra = _Hydra  # type: ignore[misc]
    try:
        hydra.main(version_base=_VERSION_BASE, config_path=str(conf), config_name="train")(job)()
    finally:
        internals.Hydra = theirs  # type: ignore[misc]


@contextlib.contextmanager
def composing_from(conf: Path) -> Iterator[None]:
    """`hydra.compose` in this block composes from the folder `conf`."""
    with hydra.initialize_config_dir(version_base=_VERSION_BASE, config_dir=str(conf)):
        own = GlobalHydra.instance().hydra
        assert own is not None
        own.config_loader = Loader(own.config_loader)
        yield
