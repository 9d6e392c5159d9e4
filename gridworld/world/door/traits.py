"""Whether two environments are one task, as far as a walk and what never changes show."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec

from gridworld.world.door.attributes import GENERATORS, attributes
from gridworld.world.door.layers import KEPT, Env, Layers
from gridworld.world.door.rejection import Rejecting
from gridworld.world.door.search import Search
from gridworld.world.door.stand_ins import Timed
from gridworld.world.door.walks import walk


def traits(env: Env) -> Any:
    """What two environments that are one task have in common: a walk, and what never changes."""
    search = Search("env", env)
    search.branching = branching = Rejecting("env", bytes, ())
    try:
        search.layers = Layers("env", env, branching, keeps_views=True)
    except Timed:
        search.layers = Layers("env", env, branching, counts_time=True, keeps_views=True)
    with search.layers.restored():
        held = {
            (number, name): value
            for number, layer in enumerate(search.layers.layers)
            for name, value in attributes(layer).items()
        }
        before = search.layers.values()
        shown = walk(search, np.int64)
        after = search.layers.values()
    constant: dict[Any, Any] = {
        key: held[key] if isinstance(held[key], gym.Space | EnvSpec) else value
        for key, value in before.items()
        if after.get(key) == value and held[key] is not branching
    }
    return [type(each) for each in search.layers.layers], search.layers.limit, constant, shown


def contents(env: Env) -> dict[str, bytes]:
    """The content of each attribute of an environment, to compare it with another's."""
    layers = Layers("env", env.unwrapped, object(), keeps_views=True)
    layers.is_adopting = True
    skipped = {
        name for name, value in attributes(layers.base).items() if isinstance(value, (*KEPT, *GENERATORS))
    }
    return {name: value for (_, name), value in layers.values([*skipped, "_np_random_seed"]).items()}
