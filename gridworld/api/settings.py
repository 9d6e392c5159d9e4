"""Settings from a Python call: overrides as on the command line, and keywords."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException

from gridworld.base.errors import InputError
from gridworld.config.compose import compose as compose_words
from gridworld.config.recipe_file import literal, with_recipe
from gridworld.config.settings import flat
from gridworld.config.train import TrainConfig

Override = str | Mapping[str, Any]

_KEY = re.compile(r"[+~]*[A-Za-z_][\w./@]*")
_OF_THE_COMMAND = re.compile(r"[+~]*hydra(?!\.searchpath=)[./@=]|resume=")
_FOLDER = re.compile(r"[+~]*(hydra\.(run|sweep)\.dir|tune\.folder|resume)=")


def compose(*overrides: Override, **settings: Any) -> TrainConfig:
    """Compose the settings of a run as `train` and the command `train.py` do.

    Args:
        overrides: words as on the command line, `"agent=dqn"`, `"env.slip=0.1"`; or dictionaries,
            `{"agent.gamma": 0.9}`, for settings with a dotted name.
        settings: settings whose name has no dot, `seed=3`. They are applied after `overrides`.

    Returns:
        Every setting of the run, as dataclasses.

    Raises:
        InputError: an override that cannot be read, or a choice, a key or a type that there is not.

    Example:
        >>> compose("agent=ppo", "env=four_rooms", {"agent.gamma": 0.9}, seed=3).agent.gamma
        0.9
    """
    return compose_words(words(*overrides, **settings))


def words(*overrides: Override, **settings: Any) -> list[str]:
    """The words of the command line that say the same as these arguments of `compose`."""
    found = with_recipe(command_words(overrides, settings))
    with contextlib.suppress(HydraException):  # which composing raises again
        for parsed in OverridesParser.create().parse_overrides(found):
            if parsed.is_sweep_override():
                raise InputError(f"{parsed.input_line}: has several values; call gridworld.sweep with them")
    return found


def command_words(
    overrides: Sequence[Override], settings: Mapping[str, Any], of_many: bool = False
) -> list[str]:
    """Overrides and settings as words of a command line; `of_many` runs, where a list is several values."""
    found: list[str] = []
    for override in (*overrides, settings):
        if isinstance(override, Mapping):
            for key, value in flat(override):
                if not _KEY.fullmatch(key):
                    raise InputError(f"{key!r:.80}: must be the name of a setting, such as 'agent.gamma'")
                plain = _plain(value)
                several = isinstance(value, range) or (of_many and isinstance(plain, list))
                texts = [literal(each, key) for each in (plain if several else [plain])]
                found.append(f"{key}={','.join(texts)}")
        elif isinstance(override, str):
            found.append(override)
        else:
            raise InputError(
                f"{override!r:.80}: must be an override, such as 'agent=dqn', or a dictionary of settings, "
                "such as {'agent.gamma': 0.9}"
            )
    for word in found:
        if word.startswith("-") or (not word.startswith("~") and "=" not in word):
            raise InputError(
                f"{word}: is not an override; write KEY=VALUE, for instance 'agent=dqn' or 'seed=3'"
            )
        if (_FOLDER if of_many else _OF_THE_COMMAND).match(word):
            raise InputError(f"{word}: belongs to the command line; here the folder is given by folder=...")
    return found


def _plain(value: Any) -> Any:
    """The value without NumPy's types, tuples and paths."""
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    if isinstance(value, tuple | list | range):
        return [_plain(each) for each in value]
    return value
