"""Training a run again, through the lengths that it had.

A run that was made longer is not the run of that length from the start: what is scheduled over training had
come to its end already. So it is trained to its first length, and then resumed to each longer one.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from gridworld.config.train import TrainConfig
from gridworld.errors import InputError
from gridworld.restore.resume import open_unfinished
from gridworld.run.reader import RunReader
from gridworld.training.train import train
from gridworld.world.mdp import Mdp


def lengths(then: RunReader, config: TrainConfig) -> list[int]:
    """The lengths that a run had, one after the other.

    Args:
        then: The run.
        config: Its settings.

    Returns:
        Environment steps; the last are those of the settings.

    Raises:
        InputError: The run was made longer in a way that cannot be repeated.
    """
    found = [_old_length(then, again) for again in then.resumptions if again.get("total_timesteps")]
    found.append(config.total_timesteps)
    if found != sorted(set(found)):
        raise InputError(f"{then.manifest_file}: resumed: the lengths {found} must grow")
    return found


def _old_length(then: RunReader, again: dict[str, Any]) -> int:
    step, old = again.get("step"), again.get("instead_of")
    if type(old) is not int or type(step) is not int or old < 1:
        raise InputError(
            f"{then.folder}: it was made longer, and its manifest does not say from what length "
            "(resumed.instead_of), so that it cannot be repeated; was the run written by another version?"
        )
    if step < old:
        raise InputError(
            f"{then.folder}: it got another length after {step:,} of {old:,} steps, before it had come to "
            "its end, which cannot be repeated; only what was made longer after all of its steps can"
        )
    return old


def repeat(then: RunReader, folder: Path, config: TrainConfig, mdp: Mdp, trust: bool = False) -> None:
    """Train a run again.

    Args:
        then: The run.
        folder: Where the new run is written; it exists.
        config: The settings to train with.
        mdp: The world.
        trust: Import the classes that the settings name, wherever they are from.

    Raises:
        InputError: It cannot be trained here.
        Interrupted: Training was asked to stop.
    """
    first, *longer = lengths(then, config)
    overrides = then.manifest.get("overrides") or []
    train(dataclasses.replace(config, total_timesteps=first), folder, overrides, lambda env: mdp)
    for length in longer:
        open_unfinished(folder, trust).resume(length)
