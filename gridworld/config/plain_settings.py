"""Settings from a file that anybody may have written: plain values, checked against the schema.

Nothing is resolved, instantiated or imported. An interpolation is a text like any other.
"""

from __future__ import annotations

import dataclasses
import functools
import os
import re
import types
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Union, get_args, get_origin, get_type_hints

from gridworld.config.agents import MISSING, AgentConfig, agent_schemas
from gridworld.config.composition.words import settings_of_a_run
from gridworld.config.fields import LIBRARIES, Effect, Text
from gridworld.config.settings import NEWER, effect_of
from gridworld.config.train import TrainConfig
from gridworld.config.worlds import EnvConfig, schema_of
from gridworld.errors import InputError
from gridworld.process.console import printable, users_folder

_LARGEST_KWARG = 1000  # of an environment: sizes, and what it pays


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
