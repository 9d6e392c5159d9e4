"""Reading a run's settings by what the schemas declare: those of an effect, and privileges."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Collection, Iterator, Mapping
from typing import Any, get_type_hints

from gridworld.config.agents import AgentConfig, agent_schemas
from gridworld.config.fields import EFFECTS, PRIVILEGE, Effect, declared
from gridworld.config.train import TrainConfig
from gridworld.config.worlds import SOURCES, EnvConfig

# Where one of these is missing or empty, a run is as those that were made before there was such a setting.
NEWER = frozenset(
    {
        *("callbacks", "exploration_bonus", "exploring_starts", "stratified_draws"),
        *("agent.reward_scale", "observation.features"),
    }
)
ON_RESULT = frozenset(Effect) - {Effect.FILES, Effect.NOTHING}


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
