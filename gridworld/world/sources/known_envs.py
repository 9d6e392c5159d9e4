"""What is known of Gymnasium's environments beside their tables: names of actions, places in pictures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gridworld.world.mdp import grid_places


@dataclass(frozen=True)
class KnownEnv:
    """What is known of a class of environments beside its table."""

    action_names: tuple[str, ...]
    places: Callable[[Any], NDArray[np.int64]]  # (N, 3), see `Mdp`
    panel_names: tuple[str, ...] = ()  # see `Mdp`
    refused: Callable[[Any], str] = lambda env: ""  # why its table is not true, if that can be seen


def _taxi_places(env: Any) -> NDArray[np.int64]:
    """One panel for each passenger and destination: passenger * 4 + destination."""
    cell, panel = np.divmod(np.arange(500), 20)
    return np.stack([panel, cell // 5, cell % 5], axis=1).astype(np.int64)


def _is_fickle(env: Any) -> str:
    if not (getattr(env, "fickle_passenger", False) and getattr(env, "fickle_probability", 1) > 0):
        return ""
    return (
        "fickle_passenger=True changes the destination in a way that its table P does not have, so no exact "
        "truth is known; leave it out"
    )


_KNOWN = {
    "FrozenLakeEnv": KnownEnv(("left", "down", "right", "up"), lambda env: grid_places(*env.desc.shape)),
    "CliffWalkingEnv": KnownEnv(("up", "right", "down", "left"), lambda env: grid_places(*env.shape)),
    "TaxiEnv": KnownEnv(
        ("south", "north", "east", "west", "pickup", "dropoff"),
        _taxi_places,
        tuple(f"{passenger} to {destination}" for passenger in (*"RGYB", "taxi") for destination in "RGYB"),
        refused=_is_fickle,
    ),
}


def known_env(real: Any) -> KnownEnv | None:
    """What is known of an environment, if anything is."""
    for each in type(real).__mro__:
        if each.__module__.startswith("gymnasium.envs.toy_text."):
            return _KNOWN.get(each.__name__)
    return None
