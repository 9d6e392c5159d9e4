"""Settings by what the schemas declare: their names, types and effects, and which are a stranger's to set.

What a stranger may have written is plain values, checked against the schema. Nothing is resolved,
instantiated or imported. An interpolation is a text like any other.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib
import itertools
import os
import pkgutil
import re
import types
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin, get_type_hints

from gridworld.base.console import printable
from gridworld.base.errors import InputError
from gridworld.base.user_input import LIBRARIES, users_folder
from gridworld.config.fields import Effect, Privilege, Text, Use, WholeNumbers, declared
from gridworld.config.sweep import LAUNCHER_SCHEMAS, SweepConfig, TuneConfig
from gridworld.config.train import AgentConfig, TrainConfig
from gridworld.config.worlds import SOURCES, EnvConfig, schema_of

# Where one of these is missing or empty, a run is as those that were made before there was such a setting.
NEWER = frozenset(
    {
        *("callbacks", "exploration_bonus", "exploring_starts", "stratified_draws"),
        *("agent.reward_scale", "env.rewards", "observation.features"),
    }
)
_GONE = frozenset({"preset"})  # settings of earlier versions, which say nothing that a run needs
ON_RESULT = frozenset(Effect) - {Effect.FILES, Effect.NOTHING}
_LARGEST_KWARG = 1000  # of an environment: sizes, and what it pays

T = TypeVar("T")
Hints = tuple[Any, ...]  # types of a setting: several where the schemas of agents or worlds differ


@functools.cache
def agent_schemas() -> dict[str, type[AgentConfig]]:
    """The schemas of all agents, from a room above this one, by their names in the group `agent/schema`."""
    found: dict[str, type[AgentConfig]] = {}
    agents = importlib.import_module("gridworld.agents")
    for family in pkgutil.iter_modules(agents.__path__):
        found |= importlib.import_module(f"{agents.__name__}.{family.name}").SCHEMAS
    return found


def flat(content: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Flatten nested settings, as {"agent": {"gamma": 0.9}} to ("agent.gamma", 0.9); {} is a value."""
    for key, value in content.items():
        if isinstance(value, dict) and value:
            yield from flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _walk(schema: type, section: str = "") -> Iterator[tuple[str, Any, dict[type, Any]]]:
    """(dotted name, type, what it declares) of every field of a schema and its sections, all alternatives."""
    hints = get_type_hints(schema, include_extras=True)
    for name, found in declared(schema).items():
        hint = hints[name]
        yield section + name, hint, found
        if isinstance(hint, type) and dataclasses.is_dataclass(hint):
            others: Mapping[type, Mapping[str, type]] = {AgentConfig: agent_schemas(), EnvConfig: SOURCES}
            for each in (hint, *others.get(hint, {}).values()):
                yield from _walk(each, f"{section}{name}.")


def _types(*schemas: tuple[type, str]) -> dict[str, Hints]:
    found: dict[str, Hints] = {}
    for name, hint, _ in itertools.chain.from_iterable(itertools.starmap(_walk, schemas)):
        if not (dataclasses.is_dataclass(hint) or hint in found.get(name, ())):
            found[name] = (*found.get(name, ()), hint)
    return found


@functools.cache
def settings_of_a_run() -> dict[str, Hints]:
    """The types of every setting of a run, of all agents and sources of worlds, by dotted names."""
    return _types((TrainConfig, ""))


@functools.cache
def all_settings() -> dict[str, Hints]:
    """The same, with those of a sweep, its launchers and a search."""
    launchers = ((schema, "hydra.launcher.") for schema in LAUNCHER_SCHEMAS.values())
    return _types((TrainConfig, ""), (TuneConfig, "tune."), (SweepConfig, "hydra.sweeper."), *launchers)


def takes_whole_numbers(name: str) -> bool:
    """Whether a setting of a run, a sweep or a search, or what contains it, consists of whole numbers."""

    def is_whole(hint: Any) -> bool:
        kinds = get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)
        return float not in kinds and (int in kinds or hint == WholeNumbers)

    hints = _at(name, all_settings(), ())
    return bool(hints) and all(map(is_whole, hints))


@functools.cache
def _declared(kind: type[T]) -> dict[str, T]:
    """What is declared of this kind in the schemas of a run, by the dotted name of the field or section."""
    return {name: found[kind] for name, _, found in _walk(TrainConfig) if kind in found}


@functools.cache
def _effects() -> dict[str, Effect]:
    entries = _declared(dict).items()
    return _declared(Effect) | {f"{name}.{key}": effect for name, of in entries for key, effect in of.items()}


def effect_of(name: str) -> Effect:
    """The effect of a setting or section by its dotted name, which need not be known to the schema."""
    return _at(name, _effects(), Effect.LEARNING)


def _at(name: str, declared: Mapping[str, T], otherwise: T) -> T:
    """What is declared of a setting, or of the smallest section around it."""
    while name and name not in declared:
        name = name.rpartition(".")[0]
    return declared.get(name, otherwise)


def with_effects(
    effects: Collection[Effect], settings: Mapping[str, Any], section: str = ""
) -> dict[str, Any]:
    """Select the settings that have one of these effects, and are not among `NEWER` and empty.

    They are plain values of a run, or of a `section` ("agent."); of a manifest, they may be anything. A
    section of which nothing is selected is left out.
    """
    found = {}
    for key, value in settings.items():
        name = f"{section}{key}"
        if isinstance(value, dict) and value:
            if part := with_effects(effects, value, f"{name}."):
                found[key] = part
        elif effect_of(name) in effects and (value or name not in NEWER):
            found[key] = value
    return found


def privileges(settings: Mapping[str, Any]) -> list[str]:
    """The names of what a simulator allowed a run with these plain values, and a learner would not have."""
    given, found = dict(flat(settings)), dict[str, None]()
    for name, privilege in _declared(Privilege).items():
        value = given.get(name)
        if value if privilege.value is None else value == privilege.value:
            found[privilege.name] = None
    return list(found)


def check_foreign(settings: Mapping[str, Any], where: str, allow: str, use: Use = Use.COMPOSE) -> None:
    """Refuse plain values by which a stranger would run code, or have a file read, on the reader's machine.

    `use` is made of them. `where` they were read, and the word that would `allow` them, are for the message.
    """
    for name, value, harm in foreign(settings, use):
        setting = printable(f"{name[:200]}={str(value)[:80]}")
        raise InputError(f"{where}: {setting} {harm}; add {allow} if you trust its author")


def foreign(settings: Mapping[str, Any], use: Use = Use.COMPOSE) -> Iterator[tuple[str, Any, str]]:
    """Find what does harm if a stranger wrote it, however deep: (dotted name, value, what it does)."""
    for name, value in _leaves(settings, ""):
        for kind in sorted(texts(name), key=lambda kind: kind.name):
            pattern, harm, begins = kind.value
            if use < begins:
                continue
            if isinstance(value, str) or kind is Text.SERVER:
                if re.fullmatch(pattern, str(value)) is None or (kind is Text.FILE and not _is_inside(value)):
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


@functools.lru_cache(maxsize=1000)  # a stranger's names may be any
def texts(name: str) -> frozenset[Text]:
    """What the text of a setting of a run is; nothing for a number, code where no schema knows."""
    hints = _at(name, settings_of_a_run(), (Annotated[Any, Text.UNKNOWN],))
    return frozenset(text for hint in hints for text in _texts_in(hint))


def _texts_in(hint: Any) -> Iterator[Text]:
    yield from (each for each in getattr(hint, "__metadata__", ()) if isinstance(each, Text))
    for inner in get_args(hint):
        if not isinstance(inner, Text | str):
            yield from _texts_in(inner)


def read_config(content: Any, where: str) -> TrainConfig:
    """Read the settings of a run from a manifest's JSON; `where` names it in the message."""
    agent = content.get("agent") if isinstance(content, dict) else None
    agent = agent if isinstance(agent, dict) else {}
    algorithm, schemas = agent.get("algorithm"), agent_schemas().values()
    own = [schema for schema in schemas if schema.algorithm == algorithm]
    if not own:  # a class of one's own, whose schema shows in the other keys
        own = [each for each in schemas if each.known_by and each.known_by in agent]
    if not own:
        raise InputError(f"{where}: config.agent.algorithm={_shown(algorithm)} is unknown")
    stand_in = {AgentConfig: own[0], EnvConfig: schema_of(content.get("env"))}
    config = _read(TrainConfig, content, f"{where}: config", stand_in)
    assert isinstance(config, TrainConfig)
    return config


def _read(schema: type, content: Any, where: str, stand_in: dict[type, type], section: str = "") -> object:
    hints = get_type_hints(schema)
    if not isinstance(content, dict):
        raise InputError(f"{where}: must be a mapping, is {_shown(content)}")
    # A run from before there was a setting is read with its default, where the result does not depend on it.
    optional = {
        name
        for name in hints
        if section + name in NEWER or effect_of(section + name) in (Effect.FILES, Effect.NOTHING)
    }
    if odd := sorted((content.keys() ^ hints.keys()) - optional - _GONE):
        fault = "lacks" if odd[0] in hints else "has an unknown key"
        raise InputError(f"{where}: {fault} {odd[0][:80]}; was the run written by another version?")
    values = {}
    for name in hints.keys() & content.keys():
        kind, value = stand_in.get(hints[name], hints[name]), content[name]
        if isinstance(kind, type) and dataclasses.is_dataclass(kind):
            values[name] = _read(kind, value, f"{where}.{name}", stand_in, f"{section}{name}.")
        elif _fits(value, kind):
            values[name] = value
        else:
            raise InputError(f"{where}.{name}={_shown(value)}: must be {getattr(kind, '__name__', kind)}")
    return schema(**values)


def _fits(value: Any, hint: Any) -> bool:
    if hint is Any:
        return True
    origin = get_origin(hint)
    if origin in (Union, types.UnionType):
        return any(_fits(value, choice) for choice in get_args(hint))
    kind = origin or hint
    if isinstance(value, bool):
        return kind is bool
    return isinstance(value, (int, float) if kind is float else kind)


def _shown(value: Any) -> str:
    """A value for a message; of a list or a mapping, which may be large, its type alone."""
    return f"a {type(value).__name__}" if isinstance(value, list | dict) else repr(value)[:80]
