"""The folder that Hydra is about to write a run or a sweep to: whether the user may have it."""

from __future__ import annotations

import contextlib
import copy
import os
from contextlib import AbstractContextManager
from pathlib import Path

from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from gridworld.config.composition.compose import without_hydra
from gridworld.errors import InputError
from gridworld.run.folder import MANIFEST, check_inside, claimed
from gridworld.run.reader import check_free
from gridworld.storage.atomic_write import check_no_links


def run_folder(config: DictConfig) -> AbstractContextManager[None]:
    """Check the folder of a single run, and return the block in which this process holds it."""
    folder = Path(config.hydra.run.dir)
    check_inside(folder, "hydra.run.dir")
    _check_names(config)
    check_free(folder)
    if config.hydra.output_subdir is not None:
        check_no_links(folder, config.hydra.output_subdir)  # Hydra writes through them
    return claimed(folder.absolute())  # a job may change the current folder


def check_settings_of(config: DictConfig) -> None:
    """Check that an unfinished run in the folder has the settings of `config`."""
    folder = Path(config.hydra.run.dir).absolute()
    if not (folder / MANIFEST).exists():
        return
    from gridworld.restore.resume import unfinished_of  # here, since it takes a second to import
    from gridworld.run.reader import is_started

    # An interpolation may need what Hydra knows only in the job, where the settings are compared again.
    with contextlib.suppress(OmegaConfBaseException):
        if is_started(folder):
            unfinished_of(folder, without_hydra(copy.deepcopy(config)))


def check_sweep_folder(config: DictConfig) -> None:
    """Check the folder of a sweep, as far as it can be done without its jobs."""
    check_inside(Path(config.hydra.sweep.dir), "hydra.sweep.dir")
    _check_names(config)


def _check_names(config: DictConfig) -> None:
    """Refuse names by which Hydra would write outside the output folder."""
    for key, name in (
        ("hydra.output_subdir", config.hydra.output_subdir),
        ("hydra.job.name", config.hydra.job.name),  # of its log file
    ):
        if name is not None and (os.sep in name or name in ("", os.curdir, os.pardir)):
            raise InputError(f"{key}={name}: must be a plain name, without {os.sep}")
