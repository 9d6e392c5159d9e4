"""Callbacks of one's own, made of the setting `callbacks`: import paths of classes, with their arguments."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback

from gridworld.agents.sb3.factory import said
from gridworld.agents.sb3.settings.constructor_arguments import import_class
from gridworld.errors import InputError

_TARGET = "_target_"


def make_callbacks(entries: Sequence[Any]) -> list[BaseCallback]:
    """Import the classes and build an object of each.

    Args:
        entries: a mapping each, of `_target_` and the class's arguments; such mappings among these, and in
            lists, are built first, as the callback of SB3's `EveryNTimesteps`.
    """
    return [_make(f"callbacks[{index}]", entry, BaseCallback) for index, entry in enumerate(entries)]


def _make(where: str, entry: dict[str, Any], kind: type) -> Any:
    path = entry[_TARGET]
    found = import_class(f"{where}.{_TARGET}", path, kind)
    arguments = {name: _value(f"{where}.{name}", value) for name, value in entry.items() if name != _TARGET}
    try:
        inspect.signature(found).bind(**arguments)
    except TypeError as error:
        known = ", ".join(inspect.signature(found).parameters)
        raise InputError(f"{where}: {path} {error}; its arguments are {known}") from None
    except ValueError:  # it has no signature that could be read
        pass
    try:
        return found(**arguments)
    except Exception as error:  # the class may be anybody's
        raise InputError(f"{where}: {path} cannot be built: {said(error)}") from error


def _value(where: str, value: Any) -> Any:
    if isinstance(value, list):
        return [_value(f"{where}[{index}]", item) for index, item in enumerate(value)]
    return _make(where, value, object) if isinstance(value, dict) and _TARGET in value else value
