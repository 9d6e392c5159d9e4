"""The dotted names of all settings, as they stand on a command line, and which of them are whole numbers."""

from __future__ import annotations

import dataclasses
import functools
import types
from collections.abc import Iterator
from typing import Any, Union, get_args, get_origin, get_type_hints

from gridworld.config.agents import WholeNumbers
from gridworld.config.settings import alternatives
from gridworld.config.sweep import LAUNCHER_SCHEMAS, SweepConfig
from gridworld.config.train import TrainConfig
from gridworld.config.tune import TuneConfig


@functools.cache
def settings_of_a_run() -> dict[str, tuple[Any, ...]]:
    """Every setting of a run, those of all agents and of all sources of worlds included.

    Returns:
        The type hints by dotted names. A name that several of them have may have several.
    """
    found: dict[str, tuple[Any, ...]] = {}
    for name, hints in _settings(TrainConfig, ""):
        found[name] = tuple(dict.fromkeys([*found.get(name, ()), *hints]))
    return found


def takes_whole_numbers(name: str) -> bool:
    """Whether a setting, or the one that it is an entry of, must be a whole number or consist of such.

    Args:
        name: its dotted name; settings of sweeps and of tuning are known too.
    """
    return name in _whole_numbers() or ("." in name and takes_whole_numbers(name.rpartition(".")[0]))


@functools.cache
def _whole_numbers() -> frozenset[str]:
    found = dict(settings_of_a_run()) | dict(_settings(TuneConfig, "tune."))
    found |= dict(_settings(SweepConfig, "hydra.sweeper."))
    for launcher in LAUNCHER_SCHEMAS.values():
        found |= dict(_settings(launcher, "hydra.launcher."))
    return frozenset(name for name, hints in found.items() if all(map(_is_whole, hints)))


def _settings(schema: type, section: str) -> Iterator[tuple[str, tuple[Any, ...]]]:
    for name, hint in get_type_hints(schema, include_extras=True).items():
        if dataclasses.is_dataclass(hint):
            assert isinstance(hint, type)
            for each in alternatives(hint):
                yield from _settings(each, f"{section}{name}.")
        else:
            yield f"{section}{name}", (hint,)


def _is_whole(hint: Any) -> bool:
    if get_origin(hint) in (Union, types.UnionType):
        return int in get_args(hint) and float not in get_args(hint)
    return hint in (int, WholeNumbers)
