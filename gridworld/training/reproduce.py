"""Training a finished run again, through the lengths that it had, and comparing bit for bit.

A run that was made longer is not the run of that length from the start: what is scheduled over training had
come to its end already. So it is trained to its first length, and then resumed to each longer one. A run
whose numbers depend on those of others, with which its networks were updated at once, is trained again
together with these: its siblings in the sweep's folder, from their own manifests.

Compared are the learning curve, the model's tensors (the optimiser's too), the visit counts, the summary and
TensorBoard's scalars, without the times in them. The runs' files are data, read within bounds.
"""

from __future__ import annotations

import csv
import dataclasses
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from gridworld.base.errors import InputError
from gridworld.base.safe_read import LARGEST_CSV, as_table
from gridworld.base.together import mixing
from gridworld.config.settings import flat
from gridworld.config.train import TrainConfig
from gridworld.run.folder import EVENTS, MANIFEST
from gridworld.run.provenance import settings_hash
from gridworld.run.reader import (
    LARGEST_RESULT,
    NUMBERS_DEPEND_ON,
    RunReader,
    find_run,
    read_run,
    stored_world,
)
from gridworld.run.summary import Summary
from gridworld.training.resume import open_unfinished, unfinished_of
from gridworld.training.saved_run import read_visits, settings_of
from gridworld.training.session import CLOCK
from gridworld.training.setup import without_pictures
from gridworld.training.tensorboard import read_scalars
from gridworld.training.together import Training, run_alone, run_together
from gridworld.training.train import training
from gridworld.world.mdp import Mdp

CLOCK_TAGS = "time/"  # prefix of the TensorBoard tags of SB3's speed
_SPARE_BYTES = 2**20

Entries = Iterable[tuple[str, Any]]  # (where, value)


def lengths(then: RunReader, config: TrainConfig) -> list[int]:
    """The lengths that a run had, in environment steps, one after the other; the last is the settings'."""
    found = []
    for again in then.resumptions:
        if not again.get("total_timesteps"):
            continue
        step, old = again.get("step"), again.get("instead_of")
        if type(old) is not int or type(step) is not int or old < 1:
            raise InputError(
                f"{then.folder}: it was made longer, but its manifest does not say from what length "
                "(resumed.instead_of); was it written by another version?"
            )
        if step < old:
            raise InputError(
                f"{then.folder}: its length was changed after {step:,} of {old:,} steps, before its end; "
                "only a run that was made longer after its end can be repeated"
            )
        found.append(old)
    found.append(config.total_timesteps)
    if found != sorted(set(found)):
        raise InputError(f"{then.manifest_file}: resumed: the lengths {found} must grow")
    return found


def population(then: RunReader) -> list[RunReader]:
    """The runs that a run's numbers depend on, itself among them, in the order in which they were begun.

    None where the run's numbers are those that it has alone.
    """
    depends_on = then.manifest.get(NUMBERS_DEPEND_ON, {})
    if then.resumptions and any(NUMBERS_DEPEND_ON in each for each in (then.manifest, *then.resumptions)):
        again = then.resumptions[-1]
        how = "together with others" if NUMBERS_DEPEND_ON in again else "alone"
        raise InputError(
            f"{then.folder}: its numbers depend on other runs, and it was resumed {how} after step "
            f"{again.get('step')}, which cannot be repeated"
        )
    folder = then.folder.resolve()
    if depends_on and folder.name not in depends_on:
        raise InputError(
            f"{then.folder}: its numbers depend on the {len(depends_on)} runs that its manifest names, "
            "itself included, but its folder was renamed; give it back its name, next to the others"
        )
    return [_member(then, folder.parent / name, digest) for name, digest in depends_on.items()]


def _member(then: RunReader, folder: Path, digest: str) -> RunReader:
    """One of the runs that `then` depends on, if it is still what it was then."""
    why = f"{then.folder}: its numbers depend on the run {folder.name}, which"
    if not (folder / MANIFEST).exists():
        raise InputError(f"{why} is no longer in {folder.parent}; put its folder back")
    run = read_run(folder)
    longer = [again for again in run.resumptions if again.get("total_timesteps")]
    first = longer[0].get("instead_of") if longer else run.manifest["config"].get("total_timesteps")
    settings = run.manifest["config"] | {"total_timesteps": first}
    if settings_hash(settings, "\n".join(run.manifest["layout"])) != digest:
        raise InputError(f"{why} has different settings now; put back the run that was trained with it")
    if any(str(again.get("at")) < str(then.manifest.get("ended")) for again in run.resumptions):
        raise InputError(f"{why} has since been resumed from a checkpoint, which cannot be repeated")
    return run


def repeat(
    then: RunReader,
    folder: Path,
    config: TrainConfig,
    mdp: Mdp,
    trust: bool = False,
    members: Sequence[RunReader] = (),
) -> None:
    """Train a run again in `folder`, which exists, with the members of its `population` elsewhere.

    A run of the same settings in it is continued as far as it lacks something. `trust` imports the classes
    that its settings name, wherever they are from. It is an `InputError` if it cannot be trained here.
    """
    first, *longer = lengths(then, config)
    overrides = then.manifest.get("overrides") or []
    logging = dataclasses.replace(config.logging, wandb=False)
    config = dataclasses.replace(config, total_timesteps=first, logging=logging)
    own = training(config, folder, overrides, lambda env: mdp, is_trusted=False)
    if begun := find_run(folder):
        if members and not begun.is_finished:
            raise InputError(
                f"{folder}: contains an unfinished run, whose numbers depend on other runs, so it cannot be "
                "continued; choose another folder"
            )
        reached = begun.manifest["config"].get("total_timesteps")
        if reached in longer:
            first, longer = reached, longer[longer.index(reached) + 1 :]
        same = dataclasses.replace(config, total_timesteps=first)
        unfinished = unfinished_of(folder, same, lambda env: mdp, trust)
        if not begun.is_finished:
            unfinished.resume()
    elif not members:
        run_alone(own)
    else:
        place = [run.folder.name for run in members].index(then.folder.resolve().name)
        with tempfile.TemporaryDirectory(prefix="gridworld-") as others:
            trainings = [_again(run, Path(others), config, trust) for run in members]
            trainings[place] = own
            with mixing(then.manifest[NUMBERS_DEPEND_ON]):
                result = run_together(trainings)[place]
        if isinstance(result, Exception):
            raise result
    for length in longer:
        open_unfinished(folder, trust).resume(length)


def _again(run: RunReader, place: Path, like: TrainConfig, trust: bool) -> Training[Summary]:
    """A run again, in a folder of its own, on the machine's part that another is trained on."""
    settings = without_pictures(settings_of(run, trust))
    config = dataclasses.replace(
        settings,
        total_timesteps=lengths(run, settings)[0],
        logging=dataclasses.replace(settings.logging, wandb=False),
        device=like.device,
        threads=like.threads,
    )
    mdp, folder = stored_world(run, config.env), place / run.folder.name
    folder.mkdir()
    return training(config, folder, [], lambda env: mdp, is_trusted=False)


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
