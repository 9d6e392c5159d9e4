"""Opening a finished run: its settings, its world and its trained agent.

A run's folder is data. Its settings are JSON, checked field by field against the schema; an interpolation in
them is a text like any other. Its map is the text in the manifest, not the file that the settings name. Its
weights are read as tensors and only if their checksum is the manifest's. Nothing is unpickled, imported by
name without a check, or run. A checksum finds damage, not forgery: who changes a file can change it too.
"""

from __future__ import annotations

import dataclasses
import io
import math
import os
import re
from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gridworld.agents import Agent
from gridworld.base.errors import InputError
from gridworld.base.user_input import DAMAGED, limited, users_folder
from gridworld.config.fields import MISSING, Text, Use
from gridworld.config.recipes import CHOSEN
from gridworld.config.settings import check_foreign, foreign, read_config, texts
from gridworld.config.train import TrainConfig, check
from gridworld.config.words import own_conf_folders
from gridworld.config.worlds import MapConfig
from gridworld.run.folder import shown
from gridworld.run.reader import RunReader, open_run, stored_world
from gridworld.training.setup import make_context
from gridworld.world.evaluation import Evaluator, PolicySnapshot
from gridworld.world.grid import GridMdp
from gridworld.world.layout import CLASSIC, load, shipped_layouts
from gridworld.world.mdp import FloatArray, Mdp

_LARGEST_HEADER = 2**12  # bytes before the numbers in NumPy's format
_LONGEST_NAME = 1000  # characters; a map's name may be a path
_OVERRIDE = re.compile(r"(?:(~)|(\+{0,2}))(\w+(?:\.\w+)*)(?(1)(?:=.*)?|=(.*))", re.ASCII | re.DOTALL)
_UNDECODED = frozenset(map(chr, range(0xDC80, 0xDD00)))  # bytes of a path that the locale cannot decode


class SavedRun:
    """A finished run with its settings, its world and its agent, at the end or at its `best` on the way.

    With `trust`, the classes that the settings name are imported, wherever they are from.
    """

    @limited()
    def __init__(self, folder: Path, trust: bool = False, best: bool = False) -> None:
        self.run: RunReader = open_run(folder)
        self._model_file = self.run.best_model_file if best else self.run.model_file
        self._steps = "best_step" if best else "timesteps"
        # The device that it was trained on need not exist here.
        self.config = dataclasses.replace(settings_of(self.run, trust, Use.OPEN), device="cpu")
        self.mdp: Mdp = stored_world(self.run, self.config.env)
        self._trust = trust

    @property
    def overrides(self) -> list[str]:
        """The words of its command line, as they may be given again from here, with its `--config-dir`.

        Of a run that is not trusted they are made of its settings, and what may run code is left out.
        """
        return self._words[0]

    @property
    def omission(self) -> str:
        """A sentence on what `overrides` leaves out; "" for nothing."""
        what = f"{shown(self.run.folder)}: its command line may run code, read other files or contact servers"
        return f"{what}; diagnose it with --trust (trust=True) to see what to try" if self._words[1] else ""

    @cached_property
    def _words(self) -> tuple[list[str], bool]:
        """The `overrides`, and whether any are left out."""
        manifest, trust = self.run.manifest, self._trust
        place = manifest.get("called_from")
        called_from = None if place is None else Path(os.path.realpath(self.run.folder), place)
        line, given = manifest.get("command", []), manifest.get("overrides") or []
        words = [word for word in given if not word.startswith("--")]
        words += [word for word in line if word.startswith("hydra.searchpath=") and word not in given]
        folders = dict.fromkeys(own_conf_folders([*line, *given]))
        own = [f"--config-dir={path_from_here(str(each), called_from)}" for each in folders if trust]
        kept = [*own, *words_again(words, self.config, called_from, trust)]
        return kept, not trust and len(kept) < len(words) + len(folders)

    @limited()
    def evaluator(self, layout: str | None = None) -> Evaluator:
        """An evaluator of the run's world, or of another map of the same size by its name or file."""
        mdp, env = self.mdp, self.config.env
        if layout is not None:
            if not isinstance(env, MapConfig) or not isinstance(mdp, GridMdp):
                raise InputError(f"layout {layout!r}: {self.run.folder} was trained on {env.name}, not a map")
            rows, columns = mdp.layout.num_rows, mdp.layout.num_cols
            world = load(layout, rows, columns) if layout == CLASSIC else load(layout, rewards=env.rewards)
            if (world.num_rows, world.num_cols) != (rows, columns):
                raise InputError(
                    f"layout {world.name}: is {world.num_rows}x{world.num_cols}, the agent was trained on "
                    f"{rows}x{columns}; use a map of that size"
                )
            mdp = env.compile(world)
        return Evaluator(mdp, self.config.evaluation.gamma, env.step_limit(mdp))

    @limited()
    def snapshot(self) -> PolicySnapshot:
        """The trained agent's values and policy in every state."""
        return self.agent().snapshot()

    @limited()
    def agent(self) -> Agent:
        """The trained agent, a new object at every call."""
        self.run.verify(self._model_file)
        few = dataclasses.replace(self.config, n_envs=min(self.config.n_envs, 2), callbacks=[])
        context = dataclasses.replace(make_context(few, self.mdp), only_asked=True)
        agent: Agent = self.config.agent.build(context)
        agent.load(self._model_file)
        return agent

    def steps(self) -> int:
        """The environment steps that the agent has learned for."""
        return int(self.run.read_summary()[self._steps])


def settings_of(
    run: RunReader, trust: bool = False, use: Use = Use.REPEAT, allow: str = "--trust"
) -> TrainConfig:
    """Read the settings in a run's manifest, for this `use` of them.

    `allow` is the word by which the command's user says that the run is trusted.
    """
    config = read_config(run.manifest["config"], str(run.manifest_file))
    for key, name in (("agent.name", config.agent.name), ("env", config.env.name)):
        if len(name) > _LONGEST_NAME or not all(sign.isprintable() or sign in _UNDECODED for sign in name):
            raise InputError(f"{run.manifest_file}: config.{key}={name[:80]!r}: must be a plain name")
    try:
        check(config)
        if not trust:
            check_foreign(dataclasses.asdict(config), str(run.manifest_file), allow, use)
        config.agent.check(config)
    except RecursionError:
        raise InputError(f"{run.manifest_file}: config is nested too deeply") from None
    return config


def read_visits(run: RunReader, shape: tuple[int, ...]) -> NDArray[np.int64]:
    """Read how often training took each action in each state, int64 counts of this shape (S, A)."""
    path = run.visits_file
    content = run.read(path, _LARGEST_HEADER + 8 * math.prod(shape))
    try:
        visits = np.load(io.BytesIO(content), allow_pickle=False)
    except DAMAGED:
        raise InputError(f"{path}: cannot be read as counts of visits") from None
    is_whole = isinstance(visits, np.ndarray) and visits.shape == shape and visits.dtype.kind in "iu"
    counts: NDArray[np.int64] = visits.astype(np.int64) if is_whole else np.array([-1])
    if (counts < 0).any():
        raise InputError(f"{path}: must be counts for every cell and action of this run's world")
    return counts


def choose_policy(snapshot: PolicySnapshot, kind: str) -> FloatArray:
    """The probabilities (S, A) of a snapshot's policy of a `kind`, "greedy" or "sampled"."""
    return snapshot.greedy_policy() if kind == "greedy" else snapshot.sampled


def words_again(
    words: Sequence[str], config: TrainConfig, called_from: Path | None = None, trust: bool = False
) -> Iterator[str]:
    """What a command line changed, to be typed again here; the paths in it are relative to `called_from`.

    Of a stranger's, these are choices, and settings with the values that `config` has. What is not a setting,
    or would run code or read a file elsewhere, is left out unless there is `trust`.
    """
    from gridworld.config.recipe_file import literal  # here, with Hydra, which takes its time

    settings, moved, given = dataclasses.asdict(config), dict[str, str](), set[str]()
    for name, value in settings["env"].items():
        place = path_from_here(value, called_from)
        if Text.FILE in texts(f"env.{name}") and place != value and value not in shipped_layouts():
            moved[f"env.{name}"] = settings["env"][name] = place
    for word in words:
        found = _OVERRIDE.fullmatch(word)
        removed, sign, key, choice = found.groups("") if found else ("", "", "", "")
        given.add(key)
        value = settings
        for name in key.split("."):
            value = value.get(name, MISSING) if isinstance(value, dict) else MISSING
        if trust and key not in moved:
            yield word
        elif removed:
            yield f"~{key}"
        elif key in (*CHOSEN, "experiment"):
            if re.fullmatch(Text.CHOICE.value[0], choice):
                yield f"{key}={choice}"
        elif value != MISSING and key != "recipe" and (trust or not any(foreign({key: value}))):
            yield f"{sign}{key}={literal(value, key)}"
    if trust:
        yield from (f"{key}={literal(place, key)}" for key, place in moved.items() if key not in given)


def path_from_here(path: Any, called_from: Path | None) -> Any:
    """The path of a file or folder that was typed in another folder, as it is typed here, if it is there."""
    if called_from is None or not isinstance(path, str) or not os.path.exists(called_from / path):
        return path
    here, found = os.path.realpath(users_folder()), Path(os.path.normpath(called_from / path))
    return str(found.relative_to(here) if found.is_relative_to(here) else found)
