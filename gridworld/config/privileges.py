"""Privileges: what a simulator allows a run, and a learner in the world would not have.

A schema declares at its field that a setting is one; `privileges` finds those that a run used.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator, Mapping
from typing import Any, get_type_hints

from gridworld.config.alternatives import alternatives

_PRIVILEGE = "privilege"  # in a field's metadata


def privilege(name: str, value: Any = None) -> dict[str, Any]:
    """Make the metadata of a setting that is a privilege.

    Args:
        name: what results call it.
        value: the value with which it is one; None: any that is not empty or 0.
    """
    return {_PRIVILEGE: (name, value)}


def privileges(schema: type, settings: Mapping[str, Any]) -> list[str]:
    """Find the privileges that a run used.

    Args:
        schema: of a run's settings, `config.train.TrainConfig`.
        settings: a run's, as plain values; they may come from a manifest, and be anything.

    Returns:
        Their names.
    """
    found = []
    for path, name, value in _declared(schema):
        given: Any = settings
        for key in path:
            given = given.get(key) if isinstance(given, Mapping) else None
        if given == value if value is not None else given:
            found.append(name)
    return list(dict.fromkeys(found))


@functools.cache
def _declared(schema: type) -> tuple[tuple[tuple[str, ...], str, Any], ...]:
    """(path, name, value) of every setting that is declared a privilege."""
    return tuple(_declarations(schema, ()))


def _declarations(schema: type, section: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], str, Any]]:
    for field in dataclasses.fields(schema):
        if _PRIVILEGE in field.metadata:
            yield (*section, field.name), *field.metadata[_PRIVILEGE]
    for name, kind in get_type_hints(schema).items():
        if isinstance(kind, type) and dataclasses.is_dataclass(kind):
            for each in alternatives(kind):
                yield from _declarations(each, (*section, name))
