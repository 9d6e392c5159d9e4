"""Worlds that a function of the user's own makes."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

from gridworld.errors import InputError, in_short
from gridworld.process.import_path import imported
from gridworld.world.mdp import Mdp
from gridworld.world.outcomes import Outcomes, mdp_from_outcomes, verified
from gridworld.world.sources.arrays import mdp_from_arrays


def build(builder: str | Callable[..., Any], kwargs: Mapping[str, Any] | None = None) -> Mdp:
    """Call a function that makes a world.

    Args:
        builder: the function, or its import path, `package.module.function`. It returns an `Mdp`, `Outcomes`,
            or arrays by their names, as `gridworld.world.sources.arrays` has them.
        kwargs: its arguments.

    Returns:
        The world, named after the function unless what that returns has a name.
    """
    where = f"env.builder={_name_of(builder) if callable(builder) else str(builder)[:200]}"
    function = imported("env.builder", builder) if isinstance(builder, str) else builder
    if not callable(function):
        raise InputError(f"{where}: must be the import path of a function, e.g. my_package.worlds.make")
    mdp, again = (_called(where, function, dict(kwargs or {})) for _ in range(2))
    if mdp.text() != again.text():
        raise InputError(
            f"{where}: makes another world each time that it is called, so that no run is about one; what it "
            "draws must follow from env.kwargs, e.g. a seed"
        )
    return mdp


def _called(where: str, function: Callable[..., Any], kwargs: dict[str, Any]) -> Mdp:
    try:
        found = function(**kwargs)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    except (Exception, SystemExit) as error:  # a function of the user's own may raise anything
        raise InputError(f"{where}: raised {in_short(error)}") from error
    return _world(where, _name_of(function), found)


def _name_of(function: Any) -> str:
    return str(getattr(function, "__name__", type(function).__name__))


def _world(where: str, name: str, found: Any) -> Mdp:
    if isinstance(found, Mdp):
        plain = {field.name: getattr(found, field.name) for field in dataclasses.fields(Mdp)}
        return verified(Mdp(**plain), where)
    if isinstance(found, Outcomes):
        return verified(dataclasses.replace(mdp_from_outcomes(where, found), name=name), where)
    if isinstance(found, Mapping):
        return mdp_from_arrays(name, found, where)
    raise InputError(
        f"{where}: returned {type(found).__name__}, must return an Mdp, Outcomes, or a mapping of arrays"
    )
