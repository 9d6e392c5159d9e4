"""Where a world comes from: a schema for each source, which compiles its world.

A schema is the section `env` of a run's settings. To add a source, add a schema to `SOURCES`, a yaml to
`conf/env`, and a module to `gridworld.world.sources`.
"""

from __future__ import annotations

import functools
import re
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from operator import methodcaller
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gridworld.base.bounds import MOST_STEPS, STEP_LIMIT, Bounds
from gridworld.base.errors import InputError
from gridworld.config.fields import (
    MISSING,
    BuilderPath,
    ChoiceName,
    Effect,
    EnvId,
    FilePath,
    Kwargs,
    Rewards,
    Word,
    setting,
)
from gridworld.world.door.budget import MOST_SECONDS, MOST_STATES

if TYPE_CHECKING:  # importing numpy takes longer than `--help` does
    from gridworld.world.grid import GridMdp
    from gridworld.world.layout import Layout
    from gridworld.world.mdp import Mdp


@dataclass
class EnvConfig:
    """A world of any source."""

    # the step limit; null: the world's own, or 100
    max_episode_steps: int | None = setting(None, Bounds(1, MOST_STEPS))
    # worlds of conf/env whose recipes are used where an agent has none of its own for this one
    recipes_of: list[ChoiceName] = setting(list, Effect.NOTHING)

    @property
    def name(self) -> str:
        """What folders and messages call the world."""
        raise NotImplementedError

    def compile(self) -> Mdp:
        """Compile the world."""
        raise NotImplementedError

    def step_limit(self, mdp: Mdp) -> int:
        """The step limit of an episode in the compiled world."""
        own = mdp.max_episode_steps
        limit = self.max_episode_steps or own or STEP_LIMIT
        if limit > MOST_STEPS:
            raise InputError(
                f"env.max_episode_steps: {mdp.name} has its own step limit of {limit:,}; give one of at "
                f"most {MOST_STEPS:,}"
            )
        if own is not None and limit > own and mdp.is_enumerated:
            # the environment itself ends its episodes at its own limit
            raise InputError(
                f"env.max_episode_steps={limit}: {mdp.name} truncates its episodes after {own} steps; "
                f"give at most {own}"
            )
        return limit


@dataclass
class MapConfig(EnvConfig):
    """A map and its rewards; the arguments of `GridWorldEnv`."""

    layout: FilePath = "classic"  # the name of a shipped map, or a file
    num_rows: int | None = None  # of the layout `classic`; null: 5
    num_cols: int | None = None  # the same; null: 6
    slip: float = 0.0  # probability of moving at a right angle instead
    step_reward: float = 0.0  # paid for every step, beside the reward of the cell entered
    goal_reward: float = 1.0  # paid for entering a goal, which ends the episode
    trap_reward: float = -1.0  # for entering a trap, which ends it too, or a cliff, which does not
    max_episode_steps: int | None = 100  # the step limit: then the episode is cut
    # of ends with letters of their own, as {A: 10, B: -1}, in place of those in the map
    rewards: Rewards = setting(dict)

    @property
    def name(self) -> str:
        return self.layout

    def compile(self, layout: Layout | None = None) -> GridMdp:
        """Compile the world, or that of another map with these rewards."""
        from gridworld.world.layout import load

        layout = layout or load(self.layout, self.num_rows, self.num_cols, self.rewards)
        return _compiled(layout, self.slip, self.step_reward, self.goal_reward, self.trap_reward)


@dataclass
class GymnasiumConfig(EnvConfig):
    """An environment of Gymnasium, by its transition table if it has one, else enumerated.

    Its step limit is that of its id.
    """

    source: Word = "gymnasium"
    # that it is registered under, e.g. FrozenLake-v1; or module:NAME of a class or a function that makes one
    id: EnvId = MISSING
    kwargs: Kwargs = setting(dict)  # of gymnasium.make, the class or the function
    ignore: list[Word] = setting(list)  # attributes that are not part of its state, by your word
    # a search that finds more states is refused
    most_states: int = setting(MOST_STATES, Effect.NOTHING, Bounds(1, 1024 * 1024))
    # a search that takes longer is refused
    most_seconds: float = setting(MOST_SECONDS, Effect.NOTHING, Bounds(0, 86_400, above=True))

    @property
    def name(self) -> str:
        place, colon, name = self.id.rpartition(":")
        return f"{Path(place).stem if place.endswith('.py') else place}{colon}{name}"

    def compile(self) -> Mdp:
        from gridworld.world.sources.elsewhere import same_elsewhere
        from gridworld.world.sources.environment import compile_id

        by_table = not (isinstance(self, EnumeratedConfig) or self.ignore)
        limits = {"most_states": self.most_states, "most_seconds": self.most_seconds}
        how: dict[str, Any] = {"by_table": by_table, "ignore": list(self.ignore), **limits}
        began = time.monotonic()
        mdp = compile_id(self.id, self.kwargs, **how)
        return same_elsewhere(mdp, self.id, self.kwargs, time.monotonic() - began, **how)


@dataclass
class EnumeratedConfig(GymnasiumConfig):
    """An environment of Gymnasium whose states are found by trying all actions and random draws."""

    source: Word = "enumerated"


@dataclass
class ArraysConfig(EnvConfig):
    """Tables or matrices in a file, or a model in Cassandra's format."""

    source: Word = "arrays"
    path: FilePath = MISSING  # of an .npz, .mat, .MDP or .POMDP

    @property
    def name(self) -> str:
        return Path(self.path).stem

    def compile(self) -> Mdp:
        from gridworld.world.sources.arrays import load_world

        return load_world(self.path)


@dataclass
class BuiltConfig(EnvConfig):
    """What a function returns: an `Mdp`, or the tables of one."""

    source: Word = "built"
    builder: BuilderPath = MISSING  # the function's import path
    kwargs: Kwargs = setting(dict)  # of the function

    @property
    def name(self) -> str:
        return self.builder.rpartition(".")[2]

    def compile(self) -> Mdp:
        from gridworld.world.sources.arrays import build

        return build(self.builder, self.kwargs)


@dataclass
class ClassicConfig(EnvConfig):
    """A world of the literature (`gridworld.world.sources.classics`), whose sizes are the other settings."""

    source: Word = MISSING

    @property
    def name(self) -> str:
        return self.source

    def compile(self) -> Mdp:
        from gridworld.world.sources import classics

        sizes = asdict(self)
        del sizes["source"], sizes["max_episode_steps"], sizes["recipes_of"]
        make: Callable[..., Mdp] = getattr(classics, self.source)
        try:
            return make(**sizes)
        except InputError as error:
            raise InputError(f"env.{error}") from None


@dataclass
class RiverSwimConfig(ClassicConfig):
    """Against the current to a large reward, or with it to a small one."""

    source: Word = "river_swim"
    length: int = 6  # states


@dataclass
class DeepSeaConfig(ClassicConfig):
    """One way of 2 ** size leads to the treasure."""

    source: Word = "deep_sea"
    size: int = 10  # rows and columns
    seed: int | None = None  # of what the actions mean in each cell; null: left and right


@dataclass
class CombinationLockConfig(ClassicConfig):
    """A wrong action leads back to the start."""

    source: Word = "combination_lock"
    length: int = 10  # actions that open it
    num_actions: int = 2  # of each state
    seed: int | None = None  # of the combination; null: the last action everywhere


@dataclass
class RandomWalkConfig(ClassicConfig):
    """A chain whose right end pays 1."""

    source: Word = "random_walk"
    length: int = 5  # states without the ends, an odd number


@functools.lru_cache(maxsize=4, typed=True)  # the jobs of a sweep have few worlds
def _compiled(layout: Layout, *rewards: float) -> GridMdp:
    from gridworld.world.grid import compile_mdp

    return compile_mdp(layout, *rewards)


def is_id(text: str) -> bool:
    """Whether a text has the form of an environment's name, as in `GymnasiumConfig.id`, or of its file."""
    return re.search(r"(-v\d+|\.py|[\w.]:[A-Za-z_]\w*)$", text) is not None


World = Callable[[EnvConfig], "Mdp"]  # makes the world of these settings
compiled: World = methodcaller("compile")


def each_once() -> World:
    """`compiled`, for one command: equal settings are compiled once."""
    worlds: dict[str, Mdp] = {}

    def world(env: EnvConfig) -> Mdp:
        if (key := repr(env)) not in worlds:
            worlds[key] = env.compile()
        return worlds[key]

    return world


def schema_of(content: Any) -> type[EnvConfig]:
    """The schema of a world's settings, which may be anything: that of maps, unless they name a source."""
    source = content.get("source") if isinstance(content, dict) else None
    return SOURCES.get(source, MapConfig) if isinstance(source, str) else MapConfig


_SCHEMAS: tuple[type[EnvConfig], ...] = (
    *(MapConfig, GymnasiumConfig, EnumeratedConfig, ArraysConfig, BuiltConfig),
    *(RiverSwimConfig, DeepSeaConfig, CombinationLockConfig, RandomWalkConfig),
)
SOURCES = {str(getattr(schema, "source", "map")): schema for schema in _SCHEMAS}
