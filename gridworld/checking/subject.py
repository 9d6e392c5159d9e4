"""What is checked: a class by its import path, or an agent that this project ships."""

from __future__ import annotations

import ast
import inspect
from collections.abc import Sequence
from typing import Any

from gridworld.agents.sb3.settings.schemas import SB3ClassConfig
from gridworld.config.agents import AgentConfig
from gridworld.errors import InputError


def subject(algorithm: Any) -> AgentConfig:
    """Name an implementation by its settings.

    Args:
        algorithm: a class with SB3's interface, its import path, or the name of a file in `conf/agent`. A
            class trains in its own loop; a shipped agent in the one that it ships with.
    """
    if inspect.isclass(algorithm):
        algorithm = f"{algorithm.__module__}.{algorithm.__qualname__}"
    name = str(algorithm)
    if "." in name:
        return SB3ClassConfig(name=name, algorithm=name, engine="stock")
    return _shipped(name)


def _shipped(name: str) -> AgentConfig:
    from gridworld.config.composition.compose import compose
    from gridworld.config.composition.conf_folder import conf_folder

    known = sorted(file.stem for file in (conf_folder() / "agent").glob("*.yaml"))
    if name not in known:
        raise InputError(
            f"check {name}: must be the import path of a class, e.g. my_package.MyPPO, or a shipped agent, "
            f"which are {', '.join(known)}"
        )
    return compose(conf_folder(), [f"agent={name}"]).agent


def arguments(words: Sequence[str]) -> dict[str, Any]:
    """The arguments of `--set NAME=VALUE`; values are Python's, or text."""
    found: dict[str, Any] = {}
    for word in words:
        name, equals, value = word.partition("=")
        if not (name.isidentifier() and equals and value):
            raise InputError(f"--set {word}: must be NAME=VALUE, e.g. learning_rate=0.001")
        found[name] = _value(value)
    return found


def _value(text: str) -> Any:
    plain = {"true": True, "false": False, "null": None}
    if text in plain:
        return plain[text]
    try:
        return ast.literal_eval(text)
    except (ValueError, SyntaxError):
        return text
