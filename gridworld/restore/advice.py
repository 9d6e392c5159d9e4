"""What to do next where a run's policy is not optimal: the commands that help, with why."""

from __future__ import annotations

import io
import shlex
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from gridworld.config.composition.conf_folder import conf_folder
from gridworld.config.composition.presets import fitting_preset, is_world
from gridworld.config.train import AUTO, TrainConfig
from gridworld.errors import InputError
from gridworld.process.console.columns import aligned
from gridworld.process.console.command_line import command
from gridworld.restore.saved_run import SavedRun
from gridworld.run.folder import shown
from gridworld.run.reader import LARGEST_RESULT, RunReader

_FALLS = 0.95  # the regret of the last quarter of a curve beside the quarter before it
_FEWEST = 8  # evaluations
_NO_PRESET = (AUTO, "none")
_REPLACED = ("total_timesteps", "n_envs", "preset", "tuned")


def advice(folder: Path) -> list[str]:
    """Lines to print below the verdict on a finished run that is not certified."""
    try:
        saved = SavedRun(folder)
        rows = list(_commands(saved))
    except (InputError, OSError, ValueError):  # the run was just made, but anybody may have touched it since
        return []
    return ["try:", *(f"  {line}" for line in aligned(rows, ("<0", "<0")))]


def _commands(saved: SavedRun) -> Iterator[list[str]]:
    run, config = saved.run, saved.config
    place = shlex.quote(shown(run.folder))
    if config.recipe is None and (env := _world_with_recipe(config)) is not None:
        yield [_train([f"agent={config.agent.name}", f"env={env}"]), "its recipe"]
    elif config.preset in _NO_PRESET and (preset := fitting_preset(config, lambda: saved.mdp)) is not None:
        yield [_train([*_without(saved.overrides), f"preset={preset}"]), f"settings for {preset} worlds"]
    yield [f"{command('diagnose')} {place}", "what costs how much, and why"]
    if _still_falls(run):
        longer = f"total_timesteps={2 * config.total_timesteps}"
        yield [f"{command('train')} resume={place} {longer}", "its regret still falls"]


def _train(words: Sequence[str]) -> str:
    return f"{command('train')} {shlex.join(words)}"


def _without(words: Sequence[str]) -> list[str]:
    return [word for word in words if word.lstrip("+~").partition("=")[0] not in _REPLACED]


def _world_with_recipe(config: TrainConfig) -> str | None:
    """The name in `conf/env` of the run's world, if the agent has a recipe for it."""
    ending = f"_{config.agent.name}.yaml"
    for recipe in sorted((conf_folder() / "tuned").glob(f"*{ending}")):
        if is_world(config.env, env := recipe.name.removesuffix(ending)):
            return env
    return None


def _still_falls(run: RunReader) -> bool:
    content = io.BytesIO(run.read(run.curve_file, LARGEST_RESULT))
    regret = np.genfromtxt(content, delimiter=",", names=True, ndmin=1)["regret"]
    if len(regret) < _FEWEST or not np.isfinite(regret).all():
        return False
    _, _, before, last = (float(part.mean()) for part in np.array_split(regret, 4))
    return last < _FALLS * before
