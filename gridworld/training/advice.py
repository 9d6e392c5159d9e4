"""What to do next where a run's policy is not optimal: the commands that help, with why."""

from __future__ import annotations

import dataclasses
import shlex
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import yaml

from gridworld.config.composition.conf_folder import conf_folder
from gridworld.config.composition.presets import fitting_preset
from gridworld.config.plain_settings import read_config
from gridworld.config.train import AUTO, TrainConfig
from gridworld.config.worlds import EnvConfig
from gridworld.errors import InputError
from gridworld.process.console.columns import aligned
from gridworld.process.console.command_line import command
from gridworld.run.folder import shown
from gridworld.run.reader import RunReader, read_run

_FALLS = 0.95  # the regret of the last quarter of a curve beside the quarter before it
_FEWEST = 8  # evaluations
_NO_PRESET = (AUTO, "none")
_REPLACED = ("total_timesteps", "n_envs", "preset", "tuned")


def advice(folder: Path) -> list[str]:
    """Lines to print below the verdict on a finished run that is not certified."""
    try:
        run = read_run(folder)
        config = read_config(run.manifest["config"], str(run.manifest_file))
        rows = list(_commands(run, config))
    except (InputError, OSError, ValueError):  # the run was just made, but anybody may have touched it since
        return []
    return ["try:", *(f"  {line}" for line in aligned(rows, ("<0", "<0")))]


def _commands(run: RunReader, config: TrainConfig) -> Iterator[list[str]]:
    place = shlex.quote(shown(run.folder))
    words: list[str] = run.manifest["overrides"]
    if config.recipe is None and (env := _world_with_recipe(config)) is not None:
        yield [_train([f"agent={config.agent.name}", f"env={env}"]), "the recipe for this agent in this world"]
    elif config.preset in _NO_PRESET and (preset := fitting_preset(config)) is not None:
        yield [_train([*_without(words), f"preset={preset}"]), f"settings for {preset} worlds"]
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
    conf, ending = conf_folder(), f"_{config.agent.name}.yaml"
    for recipe in sorted((conf / "tuned").glob(f"*{ending}")):
        env = recipe.name.removesuffix(ending)
        if (file := conf / "env" / f"{env}.yaml").exists() and _is_of(config.env, file):
            return env
    return None


def _is_of(env: EnvConfig, file: Path) -> bool:
    """Whether a world is the one that a file chooses, whatever the step limit."""
    chosen = yaml.safe_load(file.read_text("utf-8"))
    own = dataclasses.asdict(env) | {"max_episode_steps": None}
    plain = dataclasses.asdict(type(env)()) | chosen | {"max_episode_steps": None}
    return own == {key: value for key, value in plain.items() if key != "defaults"}


def _still_falls(run: RunReader) -> bool:
    regret = np.genfromtxt(run.curve_file, delimiter=",", names=True, ndmin=1)["regret"]
    if len(regret) < _FEWEST or not np.isfinite(regret).all():
        return False
    _, _, before, last = (float(part.mean()) for part in np.array_split(regret, 4))
    return last < _FALLS * before
