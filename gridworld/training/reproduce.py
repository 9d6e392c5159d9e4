"""Training a finished run again, through the lengths that it had, and comparing bit for bit.

A run that was made longer is not the run of that length from the start: what is scheduled over training had
come to its end already. So it is trained to its first length, and then resumed to each longer one. A run
whose last bits depend on the runs beside which it was trained, a population on CUDA, cannot be repeated.

Compared are the learning curve, the model's tensors (the optimiser's too), the visit counts, the summary and
TensorBoard's scalars, without the times in them. The runs' files are data, read within bounds.
"""

from __future__ import annotations

import csv
import dataclasses
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from gridworld.base.errors import InputError
from gridworld.base.safe_read import LARGEST_CSV, as_table
from gridworld.config.settings import flat
from gridworld.config.train import TrainConfig
from gridworld.run.folder import EVENTS
from gridworld.run.reader import LARGEST_RESULT, NUMBERS_DEPEND_ON, RunReader, find_run
from gridworld.training.resume import open_unfinished, unfinished_of
from gridworld.training.saved_run import read_visits
from gridworld.training.session import CLOCK
from gridworld.training.tensorboard import read_scalars
from gridworld.training.train import train
from gridworld.world.mdp import Mdp

CLOCK_TAGS = "time/"  # prefix of the TensorBoard tags of SB3's speed
_SPARE_BYTES = 2**20

Entries = Iterable[tuple[str, Any]]  # (where, value)


def lengths(then: RunReader, config: TrainConfig) -> list[int]:
    """The lengths that a run had, in environment steps, one after the other; the last is the settings'."""
    if any(each.get(NUMBERS_DEPEND_ON) for each in (then.manifest, *then.resumptions)):
        raise InputError(
            f"{then.folder}: was trained on CUDA at once with other runs, on which its last bits depend, "
            "so it cannot be repeated; with hydra.sweeper.population=1 each run of a sweep trains alone"
        )
    longer = [again for again in then.resumptions if again.get("total_timesteps")]
    found: list[Any] = [*(again.get("instead_of") for again in longer), config.total_timesteps]
    for again, old in zip(longer, found, strict=False):
        if type(old) is int and again["step"] < old:
            raise InputError(
                f"{then.folder}: its length was changed after {again['step']:,} of {old:,} steps, before its "
                "end; only a run that was made longer after its end can be repeated"
            )
    if any(type(length) is not int for length in found) or [0, *found] != sorted({0, *found}):
        raise InputError(
            f"{then.manifest_file}: resumed: the lengths {found} (instead_of, then the last) must grow; was "
            "it written by another version?"
        )
    return found


def repeat(then: RunReader, folder: Path, config: TrainConfig, mdp: Mdp, trust: bool = False) -> None:
    """Train a run again in `folder`, which exists.

    A run of the same settings in it is continued as far as it lacks something. `trust` imports the classes
    that its settings name, wherever they are from. It is an `InputError` if it cannot be trained here.
    """
    first, *longer = lengths(then, config)
    overrides = then.manifest.get("overrides") or []
    logging = dataclasses.replace(config.logging, wandb=False)
    config = dataclasses.replace(config, total_timesteps=first, logging=logging)
    if begun := find_run(folder):
        reached = begun.manifest["config"].get("total_timesteps")
        if reached in longer:
            first, longer = reached, longer[longer.index(reached) + 1 :]
        same = dataclasses.replace(config, total_timesteps=first)
        unfinished = unfinished_of(folder, same, lambda env: mdp, trust)
        if not begun.is_finished:
            unfinished.resume()
    else:
        train(config, folder, overrides, lambda env: mdp, is_trusted=False)
    for length in longer:
        open_unfinished(folder, trust).resume(length)


@dataclass(frozen=True)
class Finding:
    """How one part of the result compares."""

    part: str
    detail: str  # how much was compared, or the first difference
    same: bool | None = True  # None: it cannot be compared


def check_whole(then: RunReader, config: TrainConfig) -> None:
    """Check the files of a run that are to be compared."""
    for path in (then.curve_file, then.model_file, then.best_model_file, then.visits_file, then.summary_file):
        then.verify(path)
    if config.logging.tensorboard:
        for _ in _points(then):
            pass


def compare(then: RunReader, now: RunReader, config: TrainConfig, mdp: Mdp) -> Iterator[Finding]:
    """Compare two finished runs of one configuration in one world, part by part of the result."""

    def weights(path: Path, most: int) -> Entries:
        return sorted(config.agent.weights(path, most).items())

    def visits(run: RunReader) -> Entries:
        counts = read_visits(run, mdp.probability.shape[:2])
        for (state, action), count in np.ndenumerate(counts):
            yield f"{mdp.state_name(state)}, {mdp.action_names[action]}", count

    yield _finding("learning curve", _cells(then), _cells(now), "cells")
    for part, old, new in (
        ("final weights", then.model_file, now.model_file),
        ("best weights", then.best_model_file, now.best_model_file),
    ):
        after = weights(new, LARGEST_RESULT)
        before = weights(old, 2 * new.stat().st_size + _SPARE_BYTES)
        yield _finding(part, before, after, "tensors and numbers")
    yield _finding("visits", visits(then), visits(now), "counts")
    yield _finding("summary", _summary(then), _summary(now), "entries, except timings")
    if not config.logging.tensorboard:
        return
    if next(_points(then), None) is None:
        yield Finding("TensorBoard points", "the run's folder no longer has an event file", None)
    else:
        yield _finding("TensorBoard points", _points(then), _points(now), "points")


def _cells(run: RunReader) -> Iterator[tuple[str, str]]:
    """The cells of a curve below the header, by step and column."""
    text = as_table(run.read(run.curve_file, LARGEST_CSV), run.curve_file)
    header, *rows = csv.reader(text.splitlines())
    for row in rows:
        for column, cell in zip_longest(header, row):
            yield f"step {row[0] if row else ''}, {column}", cell


def _summary(run: RunReader) -> Entries:
    return sorted((name, value) for name, value in flat(run.read_summary()) if name not in CLOCK)


def _points(run: RunReader) -> Iterator[tuple[str, float]]:
    """TensorBoard's points, without those of the clock, in the order in which they were written."""
    for path in sorted(run.folder.glob(EVENTS)):
        for tag, step, value in read_scalars(path):
            if not tag.startswith(CLOCK_TAGS):
                yield f"step {step}, {tag}", value


def _finding(part: str, then: Entries, now: Entries, what: str) -> Finding:
    """Compare the entries of one part, which come in the same order; NaN equals NaN."""
    count = 0
    for (where, old), (other, new) in zip_longest(then, now, fillvalue=("", None)):
        if where and other and where != other:
            return _different(part, where, where, other)
        if isinstance(old, np.ndarray) and isinstance(new, np.ndarray):
            if (old.dtype, old.shape) != (new.dtype, new.shape):
                return _different(part, where, f"{old.dtype} {old.shape}", f"{new.dtype} {new.shape}")
            unequal = np.argwhere((old != new) & ((old == old) | (new == new)))
            if len(unequal):
                place = tuple(unequal[0].tolist())
                return _different(part, f"{where}{list(place) or ''}", old[place], new[place])
        elif old != new and (old == old or new == new):
            return _different(part, where or other, old, new)
        count += 1
    return Finding(part, f"{count:,} {what}")


def _different(part: str, where: str, old: object, new: object) -> Finding:
    then, now = ("nothing" if each is None else str(each)[:80] or "empty" for each in (old, new))
    return Finding(part, f"first at {where[:80]}: {then} then, {now} now", False)
