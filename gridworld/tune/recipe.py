"""The winner as a recipe: a yaml in the study's folder that train.py takes.

    python scripts/train.py recipe=runs/STUDY

It names the agent, the world and the observation, and every value in which the winner differs from these.
Where one of them is in a folder of the user's own, train.py needs that too. `config.recipe_file` reads it as
data. In a study of one's own, Hydra takes it as well: --config-dir runs/STUDY experiment=winner.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from gridworld.config.compose import to_config
from gridworld.config.fields import Effect
from gridworld.config.recipe_file import IN_A_STUDY, overrides
from gridworld.config.settings import ON_RESULT, with_effects
from gridworld.config.train import TrainConfig
from gridworld.storage.atomic_write import inside, write_text
from gridworld.tune.study_spec import ConfFolders, compose_in

EXPERIMENT, _FILE = IN_A_STUDY
RECIPE = Path(_FILE).stem
_OF_A_RECIPE = ON_RESULT - {Effect.SEED, Effect.MACHINE}


def write_recipe(
    folder: Path, folders: ConfFolders, choices: Mapping[str, str], config: TrainConfig, about: str
) -> Path:
    """Write the recipe, and check that it composes to `config` again."""
    chosen = [f"{group}={choice}" for group, choice in choices.items()]
    bare = to_config(compose_in(folders, "train", chosen))
    values = OmegaConf.create(_difference(_relevant(bare), _relevant(config)))
    lines = ["# @package _global_", f"# {about}", "defaults:"]
    lines += [f"  - override /{group}: {choice}" for group, choice in choices.items()]
    lines += ["  - _self_", ""]
    path = inside(folder, EXPERIMENT) / _FILE
    path.parent.mkdir(exist_ok=True)
    own = dataclasses.replace(folders, own=(*folders.own, folder))
    text = OmegaConf.to_yaml(values) if values else ""
    write_text(path, "\n".join([*lines, text]), durable=True)
    again = to_config(compose_in(own, "train", [f"experiment={RECIPE}"]))
    for found in (again, to_config(compose_in(own, "train", overrides(path, trust=True)))):
        assert _relevant(found) == _relevant(config), f"{path} does not say what the winner is"
    return path


def _relevant(config: TrainConfig) -> dict[str, Any]:
    return with_effects(_OF_A_RECIPE, dataclasses.asdict(config))


def _difference(before: Mapping[str, Any], after: Mapping[str, Any]) -> dict[str, Any]:
    found = {}
    for key, value in after.items():
        was = before.get(key)
        if isinstance(value, dict) and isinstance(was, dict):
            if inner := _difference(was, value):
                found[key] = inner
        elif key not in before or value != was:
            found[key] = value
    return found
