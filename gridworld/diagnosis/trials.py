"""Offers put to the test: each trains as an ordinary run, until one is certified.

The settings are composed from the offer's words. The world is the one that the run's folder holds, whatever
file or environment the words name.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from pathlib import Path

from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException

from gridworld.config.composition.compose import compose
from gridworld.config.composition.conf_folder import conf_folder
from gridworld.config.composition.hydra_errors import sentence
from gridworld.config.plain_settings import check_foreign
from gridworld.config.train import TrainConfig
from gridworld.diagnosis.verdict import Diagnosis, Trial
from gridworld.errors import InputError
from gridworld.restore.saved_run import SavedRun
from gridworld.run.claim import claimed
from gridworld.training.train import train


def try_offers(saved: SavedRun, found: Diagnosis, folder: Path, trust: bool = False) -> Iterator[Trial]:
    """Train the offers of a diagnosis in turn, until one is certified.

    Args:
        saved: the run.
        found: its diagnosis.
        folder: the runs are in it, each in a new one.
        trust: whether settings may name classes and callbacks from anywhere, and interpolations.

    Yields:
        Each trial as it ends.

    Raises:
        InputError: the run's settings are not trusted, or the folder cannot be written.
        Interrupted: training was asked to stop.
    """
    for words, line in zip(found.offers, found.commands, strict=True):
        place = next(each for n in range(1, 10**6) if not (each := folder / str(n)).exists())
        config = _settings(saved, words, trust)
        try:
            with claimed(place.absolute()):
                summary = train(config, place.absolute(), list(words), lambda env: saved.mdp)
            trial = Trial(line, place, summary["regret"], summary["certified"])
        except InputError as error:  # training diverged, say
            trial = Trial(line, place, math.inf, False, str(error))
        yield trial
        if trial.certified:
            return


def beside(folder: Path) -> Path:
    """Where the offers of a run in `folder` are trained."""
    return folder.resolve().parent / f"{folder.resolve().name}-tried"


def check_trusted(saved: SavedRun, found: Diagnosis, trust: bool) -> None:
    """Check that to compose and train the offers runs no code of a stranger's choice."""
    if found.offers and not trust:
        _check(saved.config, saved)


def _settings(saved: SavedRun, words: tuple[str, ...], trust: bool) -> TrainConfig:
    """Compose an offer as it is printed, for the stored world, whatever its settings describe by now."""
    try:
        composed = compose(conf_folder(), list(words))
    except (HydraException, OmegaConfBaseException) as error:
        raise InputError(sentence(error)) from None
    config = dataclasses.replace(composed, env=saved.config.env)
    if not trust:
        _check(config, saved)
    return config


def _check(config: TrainConfig, saved: SavedRun) -> None:
    built = {"agent": dataclasses.asdict(config.agent), "callbacks": config.callbacks}
    check_foreign(built, str(saved.run.manifest_file), "--trust")
