"""The words of a command line: habits from other programs, and numbers such as 1e5, as settings take them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

from omegaconf import DictConfig, ListConfig, OmegaConf

from gridworld.config.composition.setting_names import settings_of_a_run, takes_whole_numbers
from gridworld.errors import InputError

OF_THE_COMMAND = (
    "experiment",
    "recipe",
    "resume",
    "trust",
    "anyway",
)  # what is no setting and stands like one
_FLOAT = re.compile(r"(?<![\w.$'\"])[-+]?(?:\d[\d_]*\.?\d*|\.\d+)(?:[eE][-+]?\d+)?(?![\w.'\"])")
_LARGEST_EXACT = 2.0**53


def refuse_dashes(words: Sequence[str]) -> None:
    """Refuse settings that are written as the options of other programs are: `--seed 3`."""
    for word, following in pairwise([*words, ""]):
        option, equals, value = word.partition("=")
        name = option[2:].replace("-", "_")
        if not option.startswith("--") or not _is_known(name):
            continue
        takes_next = not equals and following and not following.startswith("-") and "=" not in following
        given = f"{word} {following}" if takes_next else word
        value = (following if takes_next else value) or "VALUE"
        raise InputError(f"{given}: a setting is written without dashes; write {name}={value}")


def _is_known(name: str) -> bool:
    known = {*OF_THE_COMMAND, *settings_of_a_run()}
    return name in known or any(each.startswith(f"{name}.") for each in known)


def with_whole_numbers(words: Sequence[str]) -> list[str]:
    """Write whole numbers as such where a setting must be one: `total_timesteps=1e5` as 100000.

    Args:
        words: overrides, lists of values for a sweep included.
    """
    return [_with_whole_number(word) for word in words]


def _with_whole_number(word: str) -> str:
    key, equals, value = word.partition("=")
    if not equals or not re.search(r"[.eE]", value) or not takes_whole_numbers(key.lstrip("+")):
        return word
    return f"{key}={_FLOAT.sub(lambda found: digits(found.group()), value)}"


def digits(text: str) -> str:
    """A number as people write it; a whole one without point and exponent: 1e5 as 100000.

    Raises:
        ValueError: it is no number.
    """
    number = float(text)
    return text if text.lstrip("+-").isdecimal() or not _is_whole(number) else str(int(number))


def _is_whole(number: float) -> bool:
    return number.is_integer() and abs(number) <= _LARGEST_EXACT


def as_whole(value: Any) -> Any:
    """A float that is a whole number as an int, in lists too; anything else as it is."""
    if isinstance(value, list):
        return [as_whole(each) for each in value]
    return int(value) if isinstance(value, float) and _is_whole(value) else value


def make_whole(settings: DictConfig, section: str = "") -> None:
    """Convert, in place, what a yaml file has for settings that must be whole numbers."""
    if settings._is_none() or settings._is_missing() or settings._is_interpolation():
        return
    for key, value in settings.items_ex(resolve=False):
        name = f"{section}{key!s}"
        if isinstance(value, DictConfig):
            make_whole(value, f"{name}.")
        elif isinstance(value, float | ListConfig) and takes_whole_numbers(name):
            plain = OmegaConf.to_container(value) if isinstance(value, ListConfig) else value
            settings[key] = as_whole(plain)
