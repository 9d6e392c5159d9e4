"""Settings by what the schemas declare: their names, their effects, and those of a stranger.

What a stranger may have written is plain values, checked against the schema. Nothing is resolved,
instantiated or imported. An interpolation is a text like any other.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib
import os
import pkgutil
import re
import types
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, Union, get_args, get_origin, get_type_hints

from gridworld.config.fields import (
    EFFECTS,
    LIBRARIES,
    MISSING,
    PRIVILEGE,
    Effect,
    Text,
    WholeNumbers,
    declared,
)
from gridworld.config.sweep import LAUNCHER_SCHEMAS, SweepConfig, TuneConfig
from gridworld.config.train import AgentConfig, TrainConfig
from gridworld.config.worlds import SOURCES, EnvConfig, schema_of
from gridworld.errors import InputError
from gridworld.process.console import printable, users_folder

# Where one of these is missing or empty, a run is as those that were made before there was such a setting.
NEWER = frozenset(
    {
        *("callbacks", "exploration_bonus", "exploring_starts", "stratified_draws"),
        *("agent.reward_scale", "observation.features"),
    }
)
ON_RESULT = frozenset(Effect) - {Effect.FILES, Effect.NOTHING}
_LARGEST_KWARG = 1000  # of an environment: sizes, and what it pays


@functools.cache
def agent_schemas() -> dict[str, type[AgentConfig]]:
    """The schemas of all agents by their names in Hydra's group `agent/schema`.

    The only place where this room reaches a room above it, by a package's name, not by an import statement.
    """
    agents = importlib.import_module("gridworld.agents")
    found: dict[str, type[AgentConfig]] = {}
    for family in pkgutil.iter_modules(agents.__path__):
        found |= importlib.import_module(f"{agents.__name__}.{family.name}").schemas()
    return found


def alternatives(schema: type) -> tuple[type, ...]:
    """The schemas that may take the place of a field annotated with `schema`, itself first."""
    if schema is AgentConfig:
        return (schema, *agent_schemas().values())
    return (schema, *SOURCES.values()) if schema is EnvConfig else (schema,)


def flat(content: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Flatten nested settings, as {"agent": {"gamma": 0.9}} to ("agent.gamma", 0.9); {} is a value."""
    for key, value in content.items():
        if isinstance(value, dict) and value:
            yield from flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


@functools.cache
def _effects() -> dict[str, Effect]:
    """Every effect that is declared, by the dotted name of its field, entry or section."""
    return {
        name + entry: effect
        for name, metadata in _declarations(TrainConfig)
        for entry, effect in metadata.get(EFFECTS, {}).items()
    }


def _declarations(schema: type, section: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    """(dotted name, metadata) of every field of the schema, its sections and their alternatives included."""
    for name, metadata in declared(schema).items():
        yield section + name, metadata
    for name, kind in get_type_hints(schema).items():
        if isinstance(kind, type) and dataclasses.is_dataclass(kind):
            for each in alternatives(kind):
                yield from _declarations(each, f"{section}{name}.")


@functools.cache
def _divided() -> frozenset[str]:
    """The sections whose settings have not all the same effect, or are not all as old."""
    names = {*_effects(), *NEWER}
    return frozenset(name[:at] for name in names for at, sign in enumerate(name) if sign == ".")


def effect_of(name: str) -> Effect:
    """The effect of a setting or section by its dotted name, which need not be known to the schema."""
    while name and name not in _effects():
        name = name.rpartition(".")[0]
    return _effects().get(name, Effect.LEARNING)


def with_effects(
    effects: Collection[Effect], settings: Mapping[str, Any], section: str = ""
) -> dict[str, Any]:
    """Select the settings that have one of these effects, and are not among `NEWER` and empty.

    Args:
        effects: e.g. `ON_RESULT`.
        settings: a run's, as plain values; they may come from a manifest, and be anything.
        section: where they are in a run's settings, with a dot at its end.

    Returns:
        The selected settings, nested as they are; a section without any is left out.
    """
    found = {}
    for key, value in settings.items():
        name = f"{section}{key}"
        if name in _divided() and isinstance(value, dict) and value:
            if part := with_effects(effects, value, f"{name}."):
                found[key] = part
        elif effect_of(name) in effects and (value or name not in NEWER):
            found[key] = value
    return found


def privileges(settings: Mapping[str, Any]) -> list[str]:
    """Find what a simulator allowed a run, and a learner in the world would not have.

    Args:
        settings: a run's, as plain values; they may come from a manifest, and be anything.

    Returns:
        The names of the privileges.
    """
    found = []
    for name, (called, value) in _privileges().items():
        given: Any = settings
        for key in name.split("."):
            given = given.get(key) if isinstance(given, Mapping) else None
        if given == value if value is not None else given:
            found.append(called)
    return list(dict.fromkeys(found))


@functools.cache
def _privileges() -> dict[str, tuple[str, Any]]:
    found = _declarations(TrainConfig)
    return {name: metadata[PRIVILEGE] for name, metadata in found if PRIVILEGE in metadata}


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


def check_foreign(settings: Mapping[str, Any], where: str, allow: str) -> None:
    """Refuse settings by which a stranger would run code, or have a file read, on the reader's machine.

    Args:
        settings: of a run, or a part of them, as plain values.
        where: they were read, for the message.
        allow: the word that would allow it, for the message.
    """
    for name, value, harm in foreign(settings):
        setting = printable(f"{name[:200]}={str(value)[:80]}")
        raise InputError(f"{where}: {setting} {harm}; add {allow} if you trust whoever made this")


def foreign(settings: Mapping[str, Any]) -> Iterator[tuple[str, Any, str]]:
    """Find what does harm if a stranger wrote it, however deep: (dotted name, value, what it does)."""
    for name, value in _leaves(settings, ""):
        for kind in sorted(_kinds(name), key=lambda kind: kind.name):
            pattern, harm = kind.value
            if isinstance(value, str):
                if re.fullmatch(pattern, value) is None or (kind is Text.FILE and not _is_inside(value)):
                    yield name, value, harm
            elif kind is Text.KWARGS and isinstance(value, int | float) and abs(value) > _LARGEST_KWARG:
                yield name, value, f"is beyond {_LARGEST_KWARG:,}, and may make a world of any size"


def _is_inside(path: str) -> bool:
    here = os.path.realpath(users_folder())
    return Path(os.path.realpath(os.path.join(here, path))).is_relative_to(here)


def has_own_code(callbacks: Any) -> bool:
    """Whether a callback among these, plain values, is of a class that is from none of the libraries."""
    return any(
        name.endswith("_target_") and not str(path).startswith(LIBRARIES)
        for name, path in _leaves(callbacks, "")
    )


def _leaves(value: Any, name: str) -> Iterator[tuple[str, Any]]:
    """All values that are no group, by dotted names; those in a list by the list's."""
    if isinstance(value, Mapping):
        for key, inner in value.items():
            yield from _leaves(inner, f"{name}.{key}" if name else str(key))
    elif isinstance(value, list | tuple):
        for inner in value:
            yield from _leaves(inner, name)
    else:
        yield name, value


def _kinds(name: str) -> frozenset[Text]:
    """What the schemas declare a text to be, at this setting or around it; what none knows may be code."""
    while name and name not in _declared_texts():
        name = name.rpartition(".")[0]
    return _declared_texts().get(name) or frozenset([Text.CODE])


@functools.cache
def _declared_texts() -> dict[str, frozenset[Text]]:
    """What a text in each setting of a run is; several where the schemas of agents or worlds differ."""
    found = settings_of_a_run().items()
    return {name: frozenset(text for hint in hints for text in texts_in(hint)) for name, hints in found}


def texts_in(hint: Any) -> Iterator[Text]:
    """What a type hint declares of the texts that it allows."""
    yield from (each for each in getattr(hint, "__metadata__", ()) if isinstance(each, Text))
    for inner in get_args(hint):
        if not isinstance(inner, Text | str):
            yield from texts_in(inner)


def read_config(content: Any, where: str) -> TrainConfig:
    """Read the settings of a run from a manifest's JSON; `where` names it in the message."""
    agent = content.get("agent") if isinstance(content, dict) else None
    agent = agent if isinstance(agent, dict) else {}
    algorithm, schemas = agent.get("algorithm"), agent_schemas().values()
    own = [schema for schema in schemas if schema.algorithm == algorithm]
    if not own and "arguments" in agent:  # of any class, whose schema names no algorithm
        own = [schema for schema in schemas if schema.algorithm == MISSING]
    if not own:
        raise InputError(f"{where}: config.agent.algorithm={shown(algorithm)} is not known here")
    stand_in = {AgentConfig: own[0], EnvConfig: schema_of(content.get("env"))}
    config = _read(TrainConfig, content, f"{where}: config", stand_in)
    assert isinstance(config, TrainConfig)
    return config


def _read(schema: type, content: Any, where: str, stand_in: dict[type, type], section: str = "") -> object:
    hints = get_type_hints(schema)
    if not isinstance(content, dict):
        raise InputError(f"{where}: must be settings, is {shown(content)}")
    # A run from before there was a setting is read with its default, where the result does not depend on it.
    optional = {
        name
        for name in hints
        if section + name in NEWER or effect_of(section + name) in (Effect.FILES, Effect.NOTHING)
    }
    if odd := sorted((content.keys() ^ hints.keys()) - optional):
        fault = "lacks" if odd[0] in hints else "has an unknown key"
        raise InputError(f"{where}: {fault} {odd[0][:80]}; was the run written by another version?")
    values = {}
    for name in hints.keys() & content.keys():
        kind, value = stand_in.get(hints[name], hints[name]), content[name]
        if isinstance(kind, type) and dataclasses.is_dataclass(kind):
            values[name] = _read(kind, value, f"{where}.{name}", stand_in, f"{section}{name}.")
        elif fits(value, kind):
            values[name] = value
        else:
            raise InputError(f"{where}.{name}={shown(value)}: must be {getattr(kind, '__name__', kind)}")
    return schema(**values)


def fits(value: Any, hint: Any) -> bool:
    """Whether a plain value is of the type `hint` that a field of a schema is annotated with."""
    if hint is Any:
        return True
    origin = get_origin(hint)
    if origin in (Union, types.UnionType):
        return any(fits(value, choice) for choice in get_args(hint))
    kind = origin or hint
    if isinstance(value, bool):
        return kind is bool
    return isinstance(value, (int, float) if kind is float else kind)


def shown(value: Any) -> str:
    """A value for a message; of a list or a mapping, which may be large, its type alone."""
    return f"a {type(value).__name__}" if isinstance(value, list | dict) else repr(value)[:80]
