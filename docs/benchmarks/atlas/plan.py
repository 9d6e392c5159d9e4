"""What is run: worlds, libraries with their pins, settings matched one by one."""

import hashlib
import importlib.metadata
import json
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import gridworld
from gridworld.base.errors import InputError
from gridworld.config.compose import named_world
from gridworld.envs.observations import make_observation
from gridworld.world.evaluation import Evaluator
from gridworld.world.mdp import Mdp

ROOT = Path(__file__).parents[3]
ROOM = Path(os.environ.get("ATLAS_ROOM", ROOT / "runs" / "atlas"))  # virtual environments and maps
DISCOUNT = 0.99  # by which published defaults are scored; matched runs, by the one that they train with
KEY = 7  # fields by which a row is known: `Job.key`
MARGIN = 1.25  # of a ratio of steps, as for generic medicines (FDA, 2001); set before any row was run


@dataclass(frozen=True)
class World:
    """A world by `env=NAME`, with settings of it."""

    name: str
    env: str
    settings: tuple[tuple[str, Any], ...]

    @cached_property
    def mdp(self) -> Mdp:
        return named_world(self.env, **dict(self.settings))

    @cached_property
    def tables(self) -> str:
        """What a worker makes its environment of, as JSON."""
        names = ("next_state", "probability", "reward", "terminal", "start")
        arrays = {name: getattr(self.mdp, name) for name in names}
        arrays["observation"] = make_observation(self.mdp, "one_hot").table()
        limit = {"limit": self.mdp.max_episode_steps}
        return json.dumps(limit | {name: array.tolist() for name, array in arrays.items()})


@cache
def evaluator(world: World, gamma: float) -> Evaluator:
    """Scores policies of a world."""
    return Evaluator(world.mdp, gamma, world.mdp.max_episode_steps or 0)  # of which each world has one


def _world(name: str, env: str | None = None, **settings: Any) -> World:
    return World(name, env or name, tuple(settings.items()))


_SIX = (
    *map(_world, ("classic", "cliff", "river_swim")),
    _world("frozen_lake", "frozen_lake_v1"),
    _world("deep_sea_6", "deep_sea", size=6),
    _world("cliff_40", "cliff", max_episode_steps=40),  # a penalty for every step, and few of them
)
_MORE = "aima_4x3 cliff_walking combination_lock deep_sea four_rooms frozen_lake_4x4 frozen_lake_8x8 maze"


def _random_maps() -> Iterator[World]:
    """Three maps of each of four sizes, with and without slip; a tenth of their cells are walls."""
    for size in (4, 6, 8, 12):
        rng, number = np.random.default_rng(size), 0
        while number < 3:
            cells = np.where(rng.random((size, size)) < 0.1, "#", ".")
            signs = "SG" + "T" * (size // 2)
            cells.flat[rng.permutation(cells.size)[: len(signs)]] = list(signs)
            path = ROOM / "maps" / f"{size}_{number}.txt"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text("\n".join(map("".join, cells)) + "\n")
            dry = _world(f"map_{size}_{number}", "classic", layout=str(path))
            if evaluator(dry, DISCOUNT).optimal_value > 0:  # the goal can be reached
                yield from (dry, _world(f"{dry.name}_slip", "classic", layout=str(path), slip=0.1))
                number += 1


@cache
def worlds_of(page: str) -> tuple[World, ...]:
    """The six worlds of `implementations`, or the forty of `defaults`."""
    more = map(_world, [*_MORE.split(), "random_walk", "taxi_v4"])
    return _SIX if page == "implementations" else (*_SIX, *more, *_random_maps())


class Library(NamedTuple):
    """A library: here, or where it has pins, in a virtual environment of its own. Texts are words."""

    named: str  # distributions whose versions a row has
    algorithms: str
    pins: str = ""
    source: tuple[str, str] = ("", "")  # a repository and the commit that is fetched next to it
    more: Any = None  # settings that are added


_OLD = "gymnasium==0.29.1 numpy==1.26.4 tyro==1.0.17 tensorboard==2.21.0 torch==2.13.0"
_CLEANRL = ("https://github.com/vwxyzjn/cleanrl", "fe8d8a03c41a7ef5b523e2e354bd01c363e786bb")
_NEW, _TORCH = "numpy==2.4.6 torch==2.13.0", "torch gymnasium numpy"
_TENSORS = "tensordict==0.14.3 gymnasium==1.4.0"
_WEIGHTS = {"policy_kwargs": {"net_arch": [64, 64], "ortho_init": False}}  # torch's own first ones
LIBRARIES = {
    "sb3": Library(f"stable_baselines3 {_TORCH}", "dqn ppo a2c"),
    "engine": Library("gridworld torch numpy", "dqn ppo a2c q_learning"),
    "plain": Library("gymnasium numpy", "q_learning"),
    "sbx": Library("sbx_rl jax flax", "dqn ppo", "sbx-rl==0.28.0 jax==0.10.2 flax==0.12.8 torch==2.13.0"),
    "cleanrl": Library(f"{_TORCH} commit", "dqn ppo", _OLD, _CLEANRL),
    # with one thing changed, to see what a difference comes from
    "sb3+weights": Library(f"stable_baselines3 {_TORCH}", "ppo", more=_WEIGHTS),
    "cleanrl+l1": Library(f"{_TORCH} commit", "dqn", _OLD, _CLEANRL, {"change": ("F.mse", "F.smooth_l1")}),
    "tianshou": Library(f"tianshou {_TORCH}", "dqn ppo", f"tianshou==2.0.1 gymnasium==1.4.0 {_NEW}"),
    "torchrl": Library(f"torchrl tensordict {_TORCH}", "dqn ppo", f"torchrl==0.14.1 {_TENSORS} {_NEW}"),
    "rllib": Library(f"ray {_TORCH}", "dqn ppo", f"ray[rllib]==2.60.0 gymnasium==1.2.2 {_NEW}"),
}

# Steps, and N, of which the number of environments is a divisor.
LENGTHS = {"dqn": (50_000, 1000), "ppo": (204_800, 4096), "a2c": (204_800, 4096), "q_learning": (20_000, 250)}
DEFAULTS = (100_000, 5000)
_EPSILON = {"exploration_initial_eps": 1.0, "exploration_final_eps": 0.05, "exploration_fraction": 1.0}
_SHARED: dict[str, Any] = {"n_envs": 32, "net_arch": [64, 64], "vf_coef": 0.5, "max_grad_norm": 0.5}
_ON_POLICY = {"learning_rate": 5e-3, "gamma": 0.95, "gae_lambda": 0.95, "ent_coef": 0.2, **_SHARED}
# fmt: off
MATCHED: dict[str, dict[str, Any]] = {  # by Stable-Baselines3's names
    "dqn": {
        "learning_rate": 5e-4, "batch_size": 128, "learning_starts": 1000, "target_update_interval": 500,
        "buffer_size": 50_000, "train_freq": 4, "gamma": 0.9, "tau": 1.0, "net_arch": [120, 84], **_EPSILON,
    },
    "ppo": {"n_steps": 128, "batch_size": 1024, "n_epochs": 4, "clip_range": 0.2, **_ON_POLICY},
    "a2c": {"n_steps": 8, **_ON_POLICY},
    "q_learning": {"learning_rate": 0.1, "gamma": 0.9, "initial_value": 0.0, **_EPSILON},
}
CLEANRL = {
    "train_freq": "train_frequency", "target_update_interval": "target_network_frequency",
    "exploration_initial_eps": "start_e", "exploration_final_eps": "end_e", "n_envs": "num_envs",
    "n_steps": "num_steps", "n_epochs": "update_epochs", "clip_range": "clip_coef",
}
# fmt: on


def settings_of(library: str, algorithm: str) -> dict[str, Any]:
    """The matched settings by the library's own names."""
    own, base = dict(MATCHED[algorithm]), library.partition("+")[0]
    if base == "cleanrl":
        del own["net_arch"]  # which is in its scripts
        own = {CLEANRL.get(name, name): value for name, value in own.items()}
        if algorithm == "ppo":
            own["num_minibatches"] = own["num_envs"] * own["num_steps"] // own.pop("batch_size")
            own["vf_coef"] *= 2  # of half a square
            own |= {"anneal_lr": False, "clip_vloss": False}
    elif base in ("sb3", "engine", "sbx") and "net_arch" in own:
        more = {"ortho_init": True} if (base, algorithm) == ("sbx", "ppo") else {}
        own["policy_kwargs"] = {"net_arch": own.pop("net_arch"), **more}
    return own | (LIBRARIES[library].more or {})


def _words(algorithm: str, settings: dict[str, Any], world: World) -> list[str]:
    """The same on this package's command line."""
    start = "+agent.arguments." if algorithm == "a2c" else "agent."
    envs, kwargs = settings.pop("n_envs", 1), settings.pop("policy_kwargs", {})
    own = [f"{start}{name}={value}" for name, value in settings.items()]
    own += [f"{start}policy_kwargs.{name}={value}".replace(" ", "") for name, value in kwargs.items()]
    agent = algorithm if algorithm == "q_learning" else f"{algorithm}_sb3_defaults"
    of_world = [f"env.{name}={value}" for name, value in world.settings]
    return [f"agent={agent}", "tuned=none", f"n_envs={envs}", *own, f"env={world.env}", *of_world]


@dataclass(frozen=True)
class Job:
    """A row that is to be."""

    page: str
    library: str
    algorithm: str
    world: World
    seed: int

    @cached_property
    def content(self) -> dict[str, Any]:
        """What the worker reads, but for the world and the seed."""
        is_default = self.page == "defaults"
        steps, every = DEFAULTS if is_default else LENGTHS[self.algorithm]
        settings = {} if is_default else settings_of(self.library, self.algorithm)
        found = {"algorithm": self.algorithm, "steps": steps, "every": every}
        found |= {"library": self.library.partition("+")[0]}
        if self.library == "engine" or (is_default and self.library == "sb3"):  # in its own loop
            words = ["agent.engine=stock"] if self.library == "sb3" else []
            words += [*_words(self.algorithm, settings, self.world), f"evaluation.gamma={self.gamma}"]
            return found | {"library": "engine", "words": words} | ({"diagnose": True} if is_default else {})
        return found | {"settings": settings, "commit": LIBRARIES[self.library].source[1]}

    @property
    def gamma(self) -> float:
        return DISCOUNT if self.page == "defaults" else MATCHED[self.algorithm]["gamma"]

    @cached_property
    def digest(self) -> str:
        """Of settings, steps and the world's tables."""
        text = json.dumps(self.content, sort_keys=True).replace(str(ROOM), "") + self.world.tables
        return hashlib.sha256(text.encode()).hexdigest()[:12]

    @property
    def key(self) -> tuple[str, ...]:
        """What a row is known by: all that decides it."""
        named = (self.page, self.library, self.algorithm, self.world.name, str(self.seed))
        return (*named, self.digest, versions(self.library))


def python_of(library: str) -> Path:
    """The Python that has a library."""
    room = ROOM / library.partition("+")[0]
    python = room / "bin" / "python" if LIBRARIES[library].pins else Path(sys.executable)
    if not python.exists():
        raise InputError(f"{library}: is not installed; run python docs/benchmarks/atlas install {room.name}")
    return python


@cache
def versions(library: str) -> str:
    """The versions of a library and of what decides its numbers."""
    named, _, pins, source, _ = LIBRARIES[library]
    places = [str(path) for path in python_of(library).parents[1].glob("lib/python*/site-packages")]
    found = {"gridworld": gridworld.__version__}  # which runs in a checkout
    for each in importlib.metadata.distributions(path=places if pins else sys.path):
        found.setdefault(each.metadata["Name"].replace("-", "_").lower(), each.version)
    found["commit"] = source[1][:8]
    return ", ".join(f"{name} {found.get(name, 'missing')}" for name in named.split())


def jobs(page: str, libraries: list[str], algorithms: list[str], worlds: list[str], seeds: int) -> list[Job]:
    """The rows of a page, seed by seed, so that an early stop leaves whole seeds."""
    known = {world.name: world for world in worlds_of(page)}
    if unknown := [name for name in worlds if name not in known]:
        raise InputError(f"--worlds {unknown[0]}: must be among {', '.join(known)}")
    return [
        Job(page, library, algorithm, known[name], seed)
        for seed in range(seeds)
        for name in worlds or known
        for algorithm in algorithms
        for library in libraries
        if algorithm in LIBRARIES[library].algorithms.split()
        if page == "implementations" or library in ("sb3", "engine", "sbx", "cleanrl")
    ]
