"""What to do next where a run's policy is not optimal: the commands that help, with why."""

from __future__ import annotations

import contextlib
import dataclasses
import shlex
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from gridworld.base.console import aligned, command
from gridworld.base.errors import InputError
from gridworld.config.recipes import GROUP, agent_and_recipe, is_world, recipe_of_class
from gridworld.config.train import TrainConfig
from gridworld.config.words import conf_folder, key_of
from gridworld.run.folder import SWEEP_JSON, RunFolder, shell_path
from gridworld.run.reader import RunReader, read_columns
from gridworld.training.saved_run import SavedRun

_FALLS = 0.95  # of the regret in the quarter of the curve before the last
_FEWEST = 8  # evaluations
_WHY = "why it is not optimal:"
_REPLACED = ("total_timesteps", "n_envs", GROUP)


def advice(folder: Path, trust: bool = False) -> list[str]:
    """Lines to print below the verdict on a finished run that is not certified; `trust` as for `SavedRun`."""
    if not RunFolder(folder).manifest_file.exists():
        return []
    place = shell_path(folder)
    try:
        rows = list(_commands(SavedRun(folder, trust), f"{place}{_trust(folder)}"))
    except (OSError, ValueError):  # the run was just made, but anybody may have touched it since
        return []
    return ["try:", *(f"  {line}" for line in aligned(rows, ("<0", "<0")))]


def _trust(folder: Path) -> str:
    """The option without which `diagnose` would not open the run, or leave out words of its command line."""
    with contextlib.suppress(InputError):
        saved = SavedRun(folder)
        return " --trust" if saved.overrides and saved.omission else ""
    return " --trust"


def _commands(saved: SavedRun, place: str) -> Iterator[list[str]]:
    """(why, command) of what may help."""
    run, config = saved.run, saved.config
    words = [word for word in saved.overrides if key_of(word) not in _REPLACED]
    agent, recipe = agent_and_recipe(config)
    is_open = recipe is None and not saved.omission  # then words of its command line are missing
    if is_open and (env := _world_with_recipe(agent, config)) is not None:
        own = [word for word in words if key_of(word).partition(".")[0] not in ("env", "experiment", "agent")]
        yield ["its recipe:", _train([f"agent={agent}", f"env={env}", *own])]
    elif is_open and "experiment" not in map(key_of, words):
        fitting = recipe_of_class(agent, config, lambda: saved.mdp)
        if fitting is not None:
            kind = fitting.rpartition("/")[2]
            yield [f"for {kind} worlds:", _train([*words, f"{GROUP}={fitting}"])]
    yield [_WHY, f"{command('diagnose')} {place}"]
    if not (run.folder.parent / SWEEP_JSON).exists() and _still_falls(run):  # a job's length is the sweep's
        resume = run.resume_command(dataclasses.asdict(config))
        yield ["its regret still falls:", f"{resume} total_timesteps={2 * config.total_timesteps}"]


def _train(words: Sequence[str]) -> str:
    return f"{command('train')} {shlex.join(words)}"


def _world_with_recipe(agent: str, config: TrainConfig) -> str | None:
    """The name in `conf/env` of the run's world, if the agent has a recipe for it."""
    files = sorted((conf_folder() / GROUP / agent).glob("*.yaml"))
    return next((file.stem for file in files if is_world(config.env, file.stem)), None)


def _still_falls(run: RunReader) -> bool:
    curve = read_columns(run, ("step", "regret", "certified"))
    regret = curve["regret"]
    if len(regret) < _FEWEST or not np.isfinite(regret).all() or (curve["certified"] == 1).any():
        return False
    _, _, before, last = (float(part.mean()) for part in np.array_split(regret, 4))
    return last < _FALLS * before
