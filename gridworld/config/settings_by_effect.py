"""Which settings affect what: selecting settings by the effects that the schemas declare.

`gridworld.config.effects` is the declaration, at the fields; this is the only reader of it.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Collection, Iterator, Mapping
from typing import Any, get_type_hints

from gridworld.config.alternatives import alternatives
from gridworld.config.effects import EFFECTS, Effect
from gridworld.config.train import TrainConfig

# Where one of these is empty, a run is as those that were made before there was such a setting.
_NEWER = frozenset(
    {
        *("callbacks", "exploration_bonus", "exploring_starts", "stratified_draws"),
        *("agent.reward_scale", "observation.features"),
    }
)

ON_RESULT = frozenset(Effect) - {Effect.FILES, Effect.NOTHING}


def effect_of(name: str) -> Effect:
    """Look up the effect of a setting or of a section.

    Args:
        name: its dotted name. It may be one that the schema does not know.

    Returns:
        The effect that it declares, or else that of the nearest section around it that declares one.
    """
    declared = _declared()
    while name and name not in declared:
        name = name.rpartition(".")[0]
    return declared.get(name, Effect.LEARNING)


def is_newer(name: str) -> bool:
    """Whether a setting may be missing in a run's settings, where that means that it is empty."""
    return name in _NEWER


def is_of_network(name: str) -> bool:
    """Whether a setting is of an agent's network; such a one may follow from the observation."""
    return ".policy_kwargs." in name


def with_effects(
    effects: Collection[Effect], settings: Mapping[str, Any], section: str = ""
) -> dict[str, Any]:
    """Select the settings that have one of these effects.

    Args:
        effects: e.g. `ON_RESULT`.
        settings: a run's, as plain values; they may come from a manifest, and be anything.
        section: where they stand in a run's settings, with a dot at its end.

    Returns:
        The selected settings, nested as they are; a section without any is left out, and so is what is newer
        (`is_newer`) and empty.
    """
    found = {}
    for key, value in settings.items():
        name = f"{section}{key}"
        if name in _divided() and isinstance(value, dict) and value:
            if part := with_effects(effects, value, f"{name}."):
                found[key] = part
        elif effect_of(name) in effects and (value or not is_newer(name)):
            found[key] = value
    return found


@functools.cache
def _declared() -> dict[str, Effect]:
    """Every effect that is declared, by the dotted name of its field, entry or section."""
    return dict(_declarations(TrainConfig))


@functools.cache
def _divided() -> frozenset[str]:
    """The sections whose settings have not all the same effect, or are not all as old."""
    names = {*_declared(), *_NEWER}
    return frozenset(name[:at] for name in names for at, sign in enumerate(name) if sign == ".")


def _declarations(schema: type, section: str = "") -> Iterator[tuple[str, Effect]]:
    """(dotted name, effect) wherever a field of the schema, or of a section in it, declares one."""
    for kind in reversed(schema.__mro__):  # a subclass last, so that it has the last word
        for field in dataclasses.fields(kind) if dataclasses.is_dataclass(kind) else ():
            for entry, effect in field.metadata.get(EFFECTS, {}).items():
                yield section + field.name + entry, effect
    for name, kind in get_type_hints(schema).items():
        if dataclasses.is_dataclass(kind):
            assert isinstance(kind, type)
            for each in alternatives(kind):
                yield from _declarations(each, f"{section}{name}.")
