"""Settings from a file that anybody may have written: plain values, checked against the schema.

Nothing is resolved, instantiated or imported. An interpolation is a text like any other.
"""

from __future__ import annotations

import dataclasses
import types
from collections.abc import Iterator, Mapping
from typing import Any, Union, get_args, get_origin, get_type_hints

from gridworld.config.agents import MISSING, AgentConfig, agent_schemas
from gridworld.config.effects import Effect
from gridworld.config.settings_by_effect import effect_of, is_newer
from gridworld.config.train import TrainConfig
from gridworld.config.worlds import EnvConfig, schema_of
from gridworld.errors import InputError

_LIBRARIES = (
    *("torch.nn.", "torch.optim.", "stable_baselines3.", "sb3_contrib."),
    "gridworld.agents.sb3.features.",
    "gridworld.agents.sb3.replay_counts.",
)

# A run that was made before there was such a setting is read with the setting's default.
_WITHOUT_RESULT = (Effect.FILES, Effect.NOTHING)


def needs_trust(config: Mapping[str, Any]) -> bool:
    """Whether a run's settings, as its manifest has them, name what `check_imports` refuses."""
    try:
        check_imports([config.get("agent"), config.get("callbacks")], "", "")
    except InputError:
        return True
    return False


def check_imports(settings: Any, where: str, allow: str) -> None:
    """Refuse what runs code of a stranger's choice, however deep it stands in the settings.

    That is an import path that leads out of the libraries an agent is made of, and a `_target_` of any: it is
    called with arguments of the stranger's, and callbacks of SB3 write files where they are told to.

    Args:
        settings: plain values.
        where: they stand, for the message.
        allow: the word that would allow it, for the message.

    Raises:
        InputError: there is such a path.
    """
    for key, path in foreign_imports(settings):
        raise InputError(
            f"{where}: {key}={path[:80]} is from none of {', '.join(_LIBRARIES)}; add {allow} to import "
            "it all the same, if you trust whoever made this"
        )
    for path in _targets(settings):
        raise InputError(
            f"{where}: _target_={shown(path)} is called with the arguments beside it, and may write files; "
            f"add {allow} if you trust whoever made this"
        )


def foreign_imports(settings: Any, key: str = "") -> Iterator[tuple[str, str]]:
    """Find such paths in plain values.

    Args:
        settings: the values.
        key: of `settings`, if they are a value.

    Yields:
        The key and the path.
    """
    if isinstance(settings, dict):
        for name, value in settings.items():
            yield from foreign_imports(value, str(name))
    elif isinstance(settings, list):
        for value in settings:
            yield from foreign_imports(value, key)
    elif _is_foreign(key, settings):
        yield key, settings


def _targets(settings: Any) -> Iterator[Any]:
    if isinstance(settings, dict):
        yield from [settings["_target_"]] if "_target_" in settings else []
        settings = list(settings.values())
    for value in settings if isinstance(settings, list) else []:
        yield from _targets(value)


def _is_foreign(key: str, value: Any) -> bool:
    names_a_class = key.endswith(("_class", "_fn")) or key in ("algorithm", "policy", "_target_")
    return names_a_class and isinstance(value, str) and "." in value and not value.startswith(_LIBRARIES)


def read_config(content: Any, where: str) -> TrainConfig:
    """Read the settings of a run from a manifest.

    Args:
        content: the manifest's JSON.
        where: it stands, for the message.

    Raises:
        InputError: anything that the schema does not have.
    """
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
    newer = {n for n in hints if effect_of(section + n) in _WITHOUT_RESULT or is_newer(section + n)}
    if odd := sorted((content.keys() ^ hints.keys()) - newer):
        fault = "lacks" if odd[0] in hints else "has an unknown key"
        raise InputError(f"{where}: {fault} {odd[0][:80]}; was the run written by another version?")
    values = {}
    for name in hints.keys() & content.keys():
        kind, value = stand_in.get(hints[name], hints[name]), content[name]
        if dataclasses.is_dataclass(kind):
            assert isinstance(kind, type)
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
