"""Hydra's error messages about a command line, each in one sentence.

Hydra says what went wrong over several lines and advises to append an unknown key with `+`, which the
schema would refuse as well. The fact is kept; what would have been right is added.
"""

from __future__ import annotations

import dataclasses
import difflib
import re
from collections.abc import Iterable
from pathlib import Path

from hydra.errors import OverrideParseException
from omegaconf import DictConfig, OmegaConf
from yaml import MarkedYAMLError, YAMLError

from gridworld.config.composition.words import OF_THE_COMMAND, pairs, settings_of_a_run
from gridworld.config.sweep import SweepConfig
from gridworld.config.tune import TuneConfig
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
    if "Config group override must be a string" in message or "'int' is not iterable" in message:
        return "a choice is a name, and null is none: write preset=none, tuned=none, or ~experiment"
    if lacking := re.search(r"Interpolation key '([^']*)' not found", message):
        return f"{lacking.group(1)}: is missing, and other settings refer to it; give it a value"
    if "Error resolving interpolation '${env}_${agent}'" in message:
        return "agent and env: every run needs both; give agent=... and env=..., not ~agent or ~env"
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
    return ": ".join(fact.strip().rstrip(".:") for fact in facts) + _suggestion(" ".join(facts), message)


def unreadable_file(error: Exception, folders: Iterable[Path]) -> str | None:
    """A sentence on the first yaml file for which reading raises an error like this one; None: there is none.

    Args:
        error: a `UnicodeDecodeError` or a `RecursionError`, for which Hydra does not name the file.
        folders: of the yaml files.
    """
    for file in sorted(file for folder in folders for file in folder.rglob("*.yaml")):
        try:
            OmegaConf.load(file)
        except UnicodeDecodeError as found:
            if isinstance(error, UnicodeDecodeError):
                return f"{file}: byte {found.start + 1} is no UTF-8"
        except RecursionError:
            if isinstance(error, RecursionError):
                return f"{file}: is nested too deeply, or contains itself"
        except (OSError, YAMLError):
            continue  # these name their file themselves
    return None


def refuse_added_keys(settings: DictConfig, prefix: str = "") -> None:
    """Refuse keys that `+key=value` added, which gets past the schema while Hydra composes."""
    schema = OmegaConf.get_type(settings)
    known = {field.name for field in dataclasses.fields(schema)} if dataclasses.is_dataclass(schema) else None
    for key in map(str, settings):
        if known is not None and key not in known:
            raise InputError(f"{prefix}{key}: there is no such key{_meant(key, sorted(known))}")
        if OmegaConf.is_missing(settings, key) or OmegaConf.is_interpolation(settings, key):
            continue
        if isinstance(child := settings[key], DictConfig):
            refuse_added_keys(child, f"{prefix}{key}.")


def _unknown_choice(message: str) -> str:
    missing = re.search(r"Could not find '([^']*)'", message)
    group = re.search(r"Available options in '([^']*)':((?:\n\t\S+)*)", message)
    assert missing is not None
    choices = group.group(2).split() if group else []
    where, _, name = missing.group(1).rpartition("/")
    if where == "experiment":
        choices = sorted({*choices, *pairs()})
    fact = f"{where}={name}: there is no such choice"
    if len(choices) <= _LISTED:
        return f"{fact}; there are {', '.join(choices)}{_meant(name, choices)}"
    near = [choice for choice in choices if choice.startswith(name)]
    near = near or difflib.get_close_matches(name, choices)
    hint = f"; close to it are {', '.join(near)}" if near else ""
    return f"{fact}{hint}; --help lists them all"


def _suggestion(facts: str, message: str) -> str:
    if "Ambiguous value" in facts:
        return "; to run one job for each of the values, add -m"
    if added := re.search(r"Could not override '([^']*)'.*Key '([^']*)' is not in struct", facts, re.DOTALL):
        place, name = added.groups()
        entry = place if place.endswith(f".{name}") else f"{place}.{name}"
        return f"; a new entry of a dictionary needs a plus: +{entry}=..."
    if "Could not append to config" in facts:
        return "; leave out the plus"
    if re.search(r"'\d+\.0' of type 'float' could not be converted to Integer", facts):
        return "; in a yaml, write a whole number without point and exponent"
    if unknown := re.search(r"Key '([^']*)' not in '\w+'", facts):
        place = re.search(r"full_key: (\S+)", message + str(facts)) or re.search(r"override '([^']*)'", facts)
        return _alike(place.group(1) if place else unknown.group(1), unknown.group(1))
    return ""


def _alike(name: str, key: str) -> str:
    """The settings in the section of `name` that look like `key`, or else those in other sections."""
    sections = {"hydra.sweeper": SweepConfig, "tune": TuneConfig}
    others = [f"{of}.{each.name}" for of, schema in sections.items() for each in dataclasses.fields(schema)]
    known = {*settings_of_a_run(), *others, *OF_THE_COMMAND} - {name}
    section = name.rpartition(".")[0]
    own = [each[len(section) + bool(section) :] for each in known if each.startswith(section)]
    if near := _meant(key, sorted({each.partition(".")[0] for each in own} - {key})):
        return near
    last = {each: each.rpartition(".")[2] for each in known if each.partition(".")[0] != section}
    alike = difflib.get_close_matches(key, set(last.values()), n=1, cutoff=0.8)
    return _or(sorted(each for each, part in last.items() if [part] == alike)) or "; --cfg job shows all keys"


def _meant(key: str, known: list[str]) -> str:
    """The names that `key` looks like, or is the initials of, as a question; "" if there is none."""
    initials = [name for name in known if "_" in name and "".join(w[:1] for w in name.split("_")) == key]
    return _or(initials or difflib.get_close_matches(key, known, n=3))


def _or(names: list[str]) -> str:
    return f"; did you mean {' or '.join(names)}?" if names else ""
