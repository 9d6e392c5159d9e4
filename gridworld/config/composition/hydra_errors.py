"""Hydra's error messages about a command line, each in one sentence.

Hydra says what went wrong over several lines and advises to append an unknown key with `+`, which the
schema would refuse as well. What is kept is the fact; what is added is what would have been right.
"""

from __future__ import annotations

import dataclasses
import difflib
import re
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from hydra.errors import OverrideParseException
from omegaconf import DictConfig, OmegaConf
from yaml import MarkedYAMLError, YAMLError

from gridworld.config import sweep, train, tune, worlds
from gridworld.config.agents import AgentConfig, agent_schemas
from gridworld.config.composition.setting_names import settings_of_a_run
from gridworld.config.composition.words import OF_THE_COMMAND
from gridworld.config.worlds import EnvConfig
from gridworld.errors import InputError, failure

_LISTED = 24  # choices of a group that are listed at most; of more, those with a similar name


def sentence(error: BaseException) -> str:
    """Put the facts of an exception, Hydra's or any other, into one line."""
    message = str(error)
    if isinstance(error, InputError):
        return message
    if isinstance(error, OSError) and error.strerror:
        return failure(error)
    if isinstance(error, MarkedYAMLError) and error.problem_mark is not None:
        mark = error.problem_mark
        return (
            f"{mark.name}: line {mark.line + 1}, column {mark.column + 1}: is not valid YAML: {error.problem}"
        )
    if missing := re.search(r"[Mm]issing mandatory value: (\S+)", message):
        key = missing.group(1)
        key = key if "." in key else getattr(error, "full_key", None) or key
        return f"{key}: has no value; give {key}=..., or have the yaml that is chosen for it do so"
    if "Config group override must be a string" in message:
        return "a choice is a name, and null is none: write preset=none, tuned=none, or ~experiment"
    if "Could not find" in message and "Available options in" in message:
        return _unknown_choice(message)
    if added := re.search(
        r"Multiple values for (\S+)\. To override a value use 'override \S+: (.*)'", message
    ):
        group, choice = added.groups()
        fact = f"+{group}={choice}: {group} has a place for its choice already, which a plus would add"
        return f"{fact}; write {group}={choice}"
    lines = message.splitlines() or [type(error).__name__]
    facts = lines[: 2 if lines[0].endswith(":") or lines[0].startswith("Error parsing") else 1]
    facts[0] = facts[0].removeprefix("Error merging override ").removeprefix("Error parsing override ")
    facts += str(error.__cause__ or "").splitlines()[:1]
    override = getattr(error, "override", None)
    if isinstance(error, OverrideParseException) and override and override not in facts[0]:
        facts.insert(0, override)
    return ": ".join(fact.strip().rstrip(".:") for fact in facts) + _suggestion(" ".join(facts))


def unreadable_file(error: Exception, folders: Iterable[Path]) -> str | None:
    """Find the yaml file that an exception is about, which Hydra does not name.

    Args:
        error: a `UnicodeDecodeError` or a `RecursionError`.
        folders: of the yaml files.

    Returns:
        A sentence on the first file that raises such an error; None: there is none.
    """
    for file in sorted(file for folder in folders for file in folder.rglob("*.yaml")):
        try:
            OmegaConf.load(file)
        except (UnicodeDecodeError, RecursionError) as found:
            if isinstance(found, UnicodeDecodeError) and isinstance(error, UnicodeDecodeError):
                return f"{file}: byte {found.start + 1} is no UTF-8"
            if isinstance(found, RecursionError) and isinstance(error, RecursionError):
                return f"{file}: is nested too deeply, or contains itself"
        except (OSError, YAMLError):
            continue  # these name their file themselves
    return None


def refuse_added_keys(settings: DictConfig) -> None:
    """Refuse keys that `+key=value` added, which gets past the schema while Hydra composes."""
    _refuse(settings, "")


def _refuse(node: DictConfig, prefix: str) -> None:
    schema = OmegaConf.get_type(node)
    known = {field.name for field in dataclasses.fields(schema)} if dataclasses.is_dataclass(schema) else None
    for key in map(str, node):
        if known is not None and key not in known:
            hint = _closest(key, sorted(known))
            raise InputError(f"{prefix}{key}: there is no such key{hint}")
        child = node._get_node(key)
        if isinstance(child, DictConfig) and not child._is_none() and not child._is_missing():
            _refuse(child, f"{prefix}{key}.")


def _unknown_choice(message: str) -> str:
    missing = re.search(r"Could not find '([^']*)'", message)
    group = re.search(r"Available options in '([^']*)':((?:\n\t\S+)*)", message)
    assert missing is not None
    choices = group.group(2).split() if group else []
    where, _, name = missing.group(1).rpartition("/")
    fact = f"{where}={name}: there is no such choice"
    if len(choices) <= _LISTED:
        return f"{fact}; there are {', '.join(choices)}{_meant(name, choices)}"
    near = [choice for choice in choices if choice.startswith(name)]
    near = near or difflib.get_close_matches(name, choices)
    hint = f"; close to it are {', '.join(near)}" if near else ""
    return f"{fact}{hint}; --help lists them all"


def _suggestion(facts: str) -> str:
    if "Ambiguous value" in facts:
        return "; to run one job for each of the values, add -m"
    if added := re.search(r"Could not override '([^']*)'.*Key '([^']*)' is not in struct", facts, re.DOTALL):
        place, name = added.groups()
        entry = place if place.endswith(f".{name}") else f"{place}.{name}"
        return f"; a new entry of a dictionary needs a plus: +{entry}=..."
    if "Could not append to config" in facts:
        return "; leave out the plus"
    unknown = re.search(r"Key '([^']*)' not in '([^']*)'", facts)
    schema = _schemas().get(unknown.group(2)) if unknown else None
    if unknown is None or not isinstance(schema, type) or not dataclasses.is_dataclass(schema):
        return ""
    known = [field.name for field in dataclasses.fields(schema)]
    return _closest(unknown.group(1), known, _elsewhere(unknown.group(1), schema))


def _schemas() -> dict[str, Any]:
    """All schemas by the names of their classes, beside what else their modules hold."""
    modules = [
        train,
        worlds,
        sweep,
        tune,
        *(sys.modules[schema.__module__] for schema in agent_schemas().values()),
    ]
    return {name: value for module in modules for name, value in vars(module).items()}


def _elsewhere(key: str, schema: type) -> list[str]:
    """What `key` may be instead: a word that is no setting, or the dotted name of one in another section."""
    words = difflib.get_close_matches(key, OF_THE_COMMAND, n=1) if schema is train.TrainConfig else []
    # Another agent's or source's settings are of no use.
    own = "agent." if issubclass(schema, AgentConfig) else "env." if issubclass(schema, EnvConfig) else "."
    last = {name: name.rpartition(".")[2] for name in settings_of_a_run() if not name.startswith(own)}
    alike = difflib.get_close_matches(key, set(last.values()), n=1, cutoff=0.8)
    return words or sorted(name for name, part in last.items() if [part] == alike)


def _closest(key: str, known: list[str], elsewhere: Sequence[str] = ()) -> str:
    return _meant(key, known) or _or(elsewhere) or f"; there are {', '.join(known)}"


def _meant(key: str, known: Sequence[str]) -> str:
    """The names that `key` looks like, or is the initials of, as a question; "" if there is none."""
    initials = [name for name in known if "_" in name and "".join(w[:1] for w in name.split("_")) == key]
    return _or(initials or difflib.get_close_matches(key, known, n=3))


def _or(names: Sequence[str]) -> str:
    return f"; did you mean {' or '.join(names)}?" if names else ""
