"""The words of a command line as Hydra takes them, and the dotted names of all settings."""

from __future__ import annotations

import dataclasses
import difflib
import functools
import re
import types
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, Union, get_args, get_origin, get_type_hints

from gridworld.config.agents import MISSING, WholeNumbers
from gridworld.config.composition.conf_folder import conf_folder
from gridworld.config.settings import alternatives
from gridworld.config.sweep import LAUNCHER_SCHEMAS, SweepConfig
from gridworld.config.train import TrainConfig
from gridworld.config.tune import TuneConfig
from gridworld.errors import InputError

OF_THE_COMMAND = ("experiment", "recipe", "resume", "trust", "anyway")  # words that look like settings
_FLOAT = re.compile(r"(?<![\w.$'\"])[-+]?(?:\d[\d_]*\.?\d*|\.\d+)(?:[eE][-+]?\d+)?(?![\w.'\"])")
_LARGEST_EXACT = 2.0**53


def prepared(words: Sequence[str], own: Sequence[Path] = ()) -> list[str]:
    """A command line as Hydra takes it: 1e5 as 100000, experiment=ENV_AGENT as the choice of the two.

    Args:
        words: the command line, lists of values for a sweep included.
        own: the folders of `--config-dir`, which may have recipes too.
    """
    found: list[str] = []
    chosen = {word.lstrip("+").partition("=")[0] for word in words if "=" in word}
    for word in words:
        key, _, value = word.partition("=")
        if key == "tuned" and "hydra.searchpath" not in chosen:
            _check_recipe(value, [conf_folder(), *own])
        if key == "experiment" and value in pairs():
            pair = zip(("env", "agent"), pairs()[value], strict=True)
            found += [f"{group}={name}" for group, name in pair if group not in chosen]
        elif takes_whole_numbers(key.lstrip("+")) and re.search(r"[.eE]", value):
            found.append(f"{key}={_FLOAT.sub(lambda number: digits(number.group()), value)}")
        else:
            found.append(word)
    return found


def _check_recipe(name: str, folders: Sequence[Path]) -> None:
    """Refuse a missing recipe, which the defaults list would leave out without a word."""
    known = sorted(file.stem for folder in folders for file in (folder / "tuned").glob("*.yaml"))
    if re.fullmatch(r"\w+", name) and name not in known:
        near = difflib.get_close_matches(name, known)
        hint = f"; close to it are {', '.join(near)}" if near else ""
        raise InputError(f"tuned={name}: there is no such recipe{hint}; --help lists them all")


@functools.cache
def pairs() -> dict[str, tuple[str, str]]:
    """Every shipped world with every shipped agent, by the names that experiments for them have."""
    conf = conf_folder()
    envs = [file for file in sorted((conf / "env").glob("*.yaml")) if MISSING not in file.read_text("utf-8")]
    found = {
        f"{env.stem}_{agent.stem}": (env.stem, agent.stem)
        for env in envs
        for agent in sorted((conf / "agent").glob("*.yaml"))
    }
    return {name: pair for name, pair in found.items() if not (conf / "experiment" / f"{name}.yaml").exists()}


def refuse_dashes(words: Sequence[str]) -> None:
    """Refuse settings that are written as the options of other programs are: `--seed 3`."""
    known = {*OF_THE_COMMAND, *settings_of_a_run()}
    for word, following in pairwise([*words, ""]):
        option, equals, value = word.partition("=")
        name = option[2:].replace("-", "_")
        if option.startswith("--") and (name in known or any(each.startswith(f"{name}.") for each in known)):
            takes_next = not equals and following and not following.startswith("-") and "=" not in following
            given = f"{word} {following}" if takes_next else word
            value = (following if takes_next else value) or "VALUE"
            raise InputError(f"{given}: a setting is written without dashes; write {name}={value}")


def digits(text: str) -> str:
    """A number as people write it; a whole one without point and exponent: 1e5 as 100000.

    Raises:
        ValueError: it is not a number.
    """
    whole = as_whole(float(text))
    return text if text.lstrip("+-").isdecimal() or isinstance(whole, float) else str(whole)


def as_whole(value: Any) -> Any:
    """A float that is a whole number as an int, in lists too; anything else as it is."""
    if isinstance(value, list):
        return [as_whole(each) for each in value]
    is_whole = isinstance(value, float) and value.is_integer() and abs(value) <= _LARGEST_EXACT
    return int(value) if is_whole else value


@functools.cache
def settings_of_a_run() -> dict[str, tuple[Any, ...]]:
    """The type hints of every setting of a run, of all agents and sources of worlds, by dotted names."""
    found: dict[str, tuple[Any, ...]] = {}
    for name, hint in _settings(TrainConfig, ""):
        found[name] = tuple(dict.fromkeys([*found.get(name, ()), hint]))
    return found


def takes_whole_numbers(name: str) -> bool:
    """Whether a setting of a run, a sweep or a search, or what contains it, consists of whole numbers."""
    return name in _whole_numbers() or ("." in name and takes_whole_numbers(name.rpartition(".")[0]))


@functools.cache
def _whole_numbers() -> frozenset[str]:
    found = settings_of_a_run() | {name: (hint,) for name, hint in _settings(TuneConfig, "tune.")}
    for schema in (SweepConfig, *LAUNCHER_SCHEMAS.values()):
        section = "hydra.sweeper." if schema is SweepConfig else "hydra.launcher."
        found |= {name: (hint,) for name, hint in _settings(schema, section)}
    return frozenset(name for name, hints in found.items() if all(map(_is_whole, hints)))


def _settings(schema: type, section: str) -> Iterator[tuple[str, Any]]:
    for name, hint in get_type_hints(schema, include_extras=True).items():
        if isinstance(hint, type) and dataclasses.is_dataclass(hint):
            for each in alternatives(hint):
                yield from _settings(each, f"{section}{name}.")
        else:
            yield f"{section}{name}", hint


def _is_whole(hint: Any) -> bool:
    if get_origin(hint) in (Union, types.UnionType):
        return int in get_args(hint) and float not in get_args(hint)
    return hint in (int, WholeNumbers)
