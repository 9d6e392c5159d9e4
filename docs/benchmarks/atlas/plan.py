"""What is run: worlds, libraries with their pins, settings matched one by one, and what has no counterpart."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import os
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np

import gridworld
from gridworld.base.errors import InputError
from gridworld.config.compose import named_world
from gridworld.envs.observations import make_observation
from gridworld.world.evaluation import Evaluator
from gridworld.world.mdp import Mdp

ROOT = Path(__file__).parents[3]
ROOM = Path(os.environ.get("ATLAS_ROOM", ROOT / "runs" / "atlas"))  # virtual environments and maps
GAMMA = 0.99

# Two implementations are called equal where the ratio of their geometric mean steps is within 4/5 to 5/4: the
# bounds by which generic medicines are judged (FDA, 2001), and less than what another evaluation grid changes.
MARGIN = 1.25


@dataclass(frozen=True)
class World:
    """A world by `env=NAME`, with settings of it."""

    name: str
    env: str
    settings: tuple[tuple[str, Any], ...] = ()

    @cached_property
    def mdp(self) -> Mdp:
        return named_world(self.env, **dict(self.settings))

    @cached_property
    def evaluator(self) -> Evaluator:
        return Evaluator(self.mdp, GAMMA, self.mdp.max_episode_steps)

    @property
    def words(self) -> list[str]:
        return [f"env={self.env}", *(f"env.{name}={value}" for name, value in self.settings)]

    @cached_property
    def tables(self) -> dict[str, Any]:
        """What a worker makes its environment of."""
        mdp = self.mdp
        arrays = {name: getattr(mdp, name) for name in ("next_state", "probability", "reward", "terminal")}
        arrays |= {"start": mdp.start, "observation": make_observation(mdp, "one_hot").table()}
        return {name: array.tolist() for name, array in arrays.items()} | {"limit": mdp.max_episode_steps}


def _world(name: str, env: str | None = None, **settings: Any) -> World:
    return World(name, env or name, tuple(settings.items()))


SIX = (
    _world("classic"),
    _world("frozen_lake", "frozen_lake_v1"),
    _world("cliff"),
    _world("deep_sea_6", "deep_sea", size=6),
    _world("river_swim"),
    _world("cliff_20", "cliff", max_episode_steps=20),  # a penalty for every step, and few of them
)


def random_maps() -> Iterator[World]:
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
            if dry.evaluator.optimal_value > 0:  # the goal can be reached
                yield dry
                yield _world(f"{dry.name}_slip", "classic", layout=str(path), slip=0.1)
                number += 1


def forty() -> tuple[World, ...]:
    """All shipped worlds that fit, and random maps."""
    shipped = "aima_4x3 cliff_walking combination_lock four_rooms frozen_lake_4x4 frozen_lake_8x8 maze"
    more = [_world(name) for name in [*shipped.split(), "random_walk", "taxi_v4"]]
    return (*SIX, *more, _world("deep_sea_10", "deep_sea", size=10), *random_maps())


@dataclass(frozen=True)
class Library:
    """A library in an environment of its own, or here.

    Attributes:
        named: the distributions whose versions a row has.
        algorithms: that it has.
        pins: what `install` installs; () is what is here.
        source: a repository and commit that are fetched next to it, if any.
    """

    named: tuple[str, ...]
    algorithms: tuple[str, ...]
    pins: tuple[str, ...] = ()
    source: tuple[str, str] | None = None


_TORCH = "torch==2.13.0"
LIBRARIES = {
    "sb3": Library(("stable_baselines3", "torch", "gymnasium", "numpy"), ("dqn", "ppo", "a2c")),
    "engine": Library(("gridworld", "torch", "numpy"), ("dqn", "ppo", "a2c", "q_learning")),
    "plain": Library(("gymnasium", "numpy"), ("q_learning",)),
    "sbx": Library(("sbx-rl", "jax", "flax", "gymnasium"), ("dqn", "ppo"), ("sbx-rl==0.28.0", _TORCH)),
    "cleanrl": Library(
        ("torch", "gymnasium", "numpy"),
        ("dqn", "ppo"),
        ("gymnasium==0.29.1", "numpy<2", "tyro==0.9.35", "tensorboard==2.20.0", _TORCH),
        ("https://github.com/vwxyzjn/cleanrl", "fe8d8a03c41a7ef5b523e2e354bd01c363e786bb"),
    ),
}
NOT_HERE = {
    "Tianshou": "not tried yet",
    "RLlib": "not tried yet",
    "TorchRL": "not tried yet",
    "Rejax": "not tried yet; its environments are written in JAX, so it needs another reader of policies",
}

# page -> steps and N by algorithm. N does not divide a rollout of PPO: the engine reads before the update.
LENGTHS = {"dqn": (30_000, 1000), "ppo": (51_200, 1000), "a2c": (50_000, 1000), "q_learning": (10_000, 250)}
DEFAULTS_LENGTH = (100_000, 5000)

_DQN = {"learning_rate": 1e-3, "buffer_size": 10_000, "batch_size": 64, "gamma": GAMMA, "tau": 1.0}
_DQN |= {"learning_starts": 1000, "train_freq": 4, "target_update_interval": 500, "hidden": [120, 84]}
_EPSILON = {"exploration_initial_eps": 1.0, "exploration_final_eps": 0.05}
_ON_POLICY = {"gamma": GAMMA, "ent_coef": 0.01, "vf_coef": 0.5, "max_grad_norm": 0.5, "n_envs": 4}
MATCHED: dict[str, dict[str, Any]] = {
    "dqn": {**_DQN, **_EPSILON, "exploration_fraction": 0.5},
    "ppo": {
        **{"learning_rate": 1e-3, "n_steps": 128, "batch_size": 128, "n_epochs": 4, "gae_lambda": 0.95},
        **{"clip_range": 0.2, **_ON_POLICY, "hidden": [64, 64]},
    },
    "a2c": {"learning_rate": 7e-4, "n_steps": 5, "gae_lambda": 1.0, **_ON_POLICY, "hidden": [64, 64]},
    "q_learning": {
        **{"learning_rate": 0.1, "gamma": GAMMA, "initial_value": 0.0, "exploration_fraction": 1.0},
        **_EPSILON,
    },
}
_CLEANRL = {
    **{"train_freq": "train_frequency", "target_update_interval": "target_network_frequency"},
    **{"exploration_initial_eps": "start_e", "exploration_final_eps": "end_e", "n_envs": "num_envs"},
    **{"n_steps": "num_steps", "n_epochs": "update_epochs", "clip_range": "clip_coef"},
}
# What a library does whatever its settings are: (algorithm, subject) -> by library.
FIXED = {
    ("dqn", "loss"): {"sb3": "smooth L1", "engine": "smooth L1", "sbx": "smooth L1", "cleanrl": "squares"},
    ("dqn", "gradient norm"): {"sb3": "at most 10", "engine": "at most 10", "sbx": "any", "cleanrl": "any"},
    ("dqn", "layers of 120, 84"): {"sb3": "set", "engine": "set", "sbx": "set", "cleanrl": "fixed"},
    ("ppo", "value at a time limit"): {"sb3": "added", "engine": "added", "sbx": "added", "cleanrl": "0"},
    ("q_learning", "of equal actions"): {"engine": "any", "plain": "any"},
}


def settings_of(library: str, algorithm: str) -> dict[str, Any]:
    """The matched settings by the library's own names."""
    matched = dict(MATCHED[algorithm])
    hidden = matched.pop("hidden", None)
    if library == "plain":
        return {**matched, "ties": "random"}
    if library == "cleanrl":
        own = {_CLEANRL.get(name, name): value for name, value in matched.items()}
        if algorithm == "ppo":
            steps = own["num_envs"] * own["num_steps"]
            own["num_minibatches"] = steps // own.pop("batch_size")
            own |= {"anneal_lr": False, "clip_vloss": False, "norm_adv": True}
        return own
    return matched if hidden is None else {**matched, "policy_kwargs": {"net_arch": hidden}}


def engine_words(algorithm: str, settings: dict[str, Any], engine: str) -> list[str]:
    """The same settings on a command line."""
    if algorithm == "q_learning":
        named = {"agent": "q_learning", "n_envs": 1, "tuned": "none"}
        return [f"{name}={value}" for name, value in named.items()] + [
            f"agent.{name}={value}" for name, value in settings.items()
        ]
    envs = settings.pop("n_envs", 1)
    kwargs = settings.pop("policy_kwargs", {})
    start = "+agent.arguments." if algorithm == "a2c" else "agent."
    own = [f"{start}{name}={value}" for name, value in settings.items()]
    own += [f"{start}policy_kwargs.{name}={value}".replace(" ", "") for name, value in kwargs.items()]
    return [f"agent={algorithm}_sb3_defaults", "tuned=none", f"agent.engine={engine}", f"n_envs={envs}", *own]


@dataclass(frozen=True)
class Job:
    """A row that is to be: what is trained, where, with which seed."""

    page: str
    library: str
    algorithm: str
    world: World
    seed: int

    @cached_property
    def content(self) -> dict[str, Any]:
        """What the worker reads, but for the world and the seed."""
        steps, every = DEFAULTS_LENGTH if self.page == "defaults" else LENGTHS[self.algorithm]
        is_default = self.page == "defaults"
        settings = {} if is_default else settings_of(self.library, self.algorithm)
        found = {"library": self.library, "algorithm": self.algorithm, "steps": steps, "every": every}
        if self.library == "engine" or (is_default and self.library == "sb3"):
            # Defaults of Stable-Baselines3 run in its own loop, through this package, for `diagnose`.
            loop = "stock" if self.library == "sb3" else "tabulated"
            words = engine_words(self.algorithm, dict(settings), loop)
            found |= {"library": "engine", "words": words + self.world.words, "diagnose": is_default}
        elif (source := LIBRARIES[self.library].source) is not None:
            found |= {"settings": settings, "source": str(ROOM / self.library / "source"), "commit": source[1]}
        else:
            found["settings"] = settings
        return found

    @cached_property
    def digest(self) -> str:
        """Of all that decides a row but for the seed and the versions."""
        told = {name: value for name, value in self.content.items() if name != "source"}
        text = json.dumps([told, self.world.tables], sort_keys=True).replace(str(ROOM), "")
        return hashlib.sha256(text.encode()).hexdigest()[:12]

    @property
    def key(self) -> tuple[str, ...]:
        """What a row is known by."""
        named = (self.page, self.library, self.algorithm, self.world.name, str(self.seed))
        return (*named, self.digest, versions(self.library))


def python_of(library: str) -> Path:
    """The Python that has a library."""
    if not LIBRARIES[library].pins:
        return Path(sys.executable)
    python = ROOM / library / "bin" / "python"
    if not python.exists():
        raise InputError(f"{library}: is not installed; python docs/benchmarks/atlas install {library}")
    return python


@cache
def versions(library: str) -> str:
    """The versions of a library and of what decides its numbers, as a row has them."""
    places = None
    if LIBRARIES[library].pins:
        places = [str(path) for path in (python_of(library).parents[1] / "lib").glob("python*/site-packages")]
    found = {"gridworld": gridworld.__version__}  # which runs in a checkout
    for each in importlib.metadata.distributions(**({} if places is None else {"path": places})):
        found.setdefault(re.sub(r"[-_.]+", "_", each.metadata["Name"]).lower(), each.version)
    texts = [f"{name} {found[name.replace('-', '_')]}" for name in LIBRARIES[library].named]
    source = LIBRARIES[library].source
    return ", ".join([*texts, *([f"commit {source[1][:8]}"] if source else [])])


def jobs(page: str, libraries: list[str], algorithms: list[str], worlds: list[str], seeds: int) -> list[Job]:
    """All rows of a page, seed by seed, so that an early stop leaves whole seeds."""
    known = {world.name: world for world in (forty() if page == "defaults" else SIX)}
    if unknown := [name for name in worlds if name not in known]:
        raise InputError(f"--worlds {unknown[0]}: must be among {', '.join(known)}")
    return [
        Job(page, library, algorithm, known[name], seed)
        for seed in range(seeds)
        for name in worlds or known
        for algorithm in algorithms
        for library in libraries
        if algorithm in LIBRARIES[library].algorithms
        and not (page == "defaults" and library in ("engine", "plain"))
    ]
