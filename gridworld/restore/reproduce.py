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
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gridworld.agents import family
from gridworld.config.settings import flat
from gridworld.config.train import TrainConfig
from gridworld.errors import InputError
from gridworld.process.together import mixing
from gridworld.restore.resume import open_unfinished
from gridworld.restore.saved_run import read_visits, settings_of
from gridworld.run.folder import BEST_MODEL, EVENTS, MANIFEST, MODEL
from gridworld.run.provenance import settings_hash
from gridworld.run.reader import LARGEST_RESULT, NUMBERS_DEPEND_ON, RunReader, read_run, stored_world
from gridworld.run.summary import Summary
from gridworld.storage.safe_read import LARGEST_CSV, as_table
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
                f"{then.folder}: it was made longer, and its manifest does not say from what length "
                "(resumed.instead_of), so that it cannot be repeated; was the run written by another version?"
            )
        if step < old:
            raise InputError(
                f"{then.folder}: it got another length after {step:,} of {old:,} steps, before its end, "
                "which cannot be repeated; only what was made longer after all of its steps can"
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
            f"{then.folder}: its numbers depend on other runs, and it was resumed after step "
            f"{again.get('step')} {how}, which cannot be repeated"
        )
    folder = then.folder.resolve()
    if depends_on and folder.name not in depends_on:
        raise InputError(
            f"{then.folder}: its numbers depend on {len(depends_on)} runs that its manifest names, and its "
            "folder has the name of none of them; give it its own name again, beside the others"
        )
    return [_member(then, folder.parent / name, digest) for name, digest in depends_on.items()]


def _member(then: RunReader, folder: Path, digest: str) -> RunReader:
    """One of the runs that `then` depends on, if it is still what it was then."""
    why = f"{then.folder}: its numbers depend on the run {folder.name}, which"
    if not (folder / MANIFEST).exists():
        raise InputError(f"{why} is not in {folder.parent} any more; put its folder back")
    run = read_run(folder)
    longer = [again for again in run.resumptions if again.get("total_timesteps")]
    first = longer[0].get("instead_of") if longer else run.manifest["config"].get("total_timesteps")
    settings = run.manifest["config"] | {"total_timesteps": first}
    if settings_hash(settings, "\n".join(run.manifest["layout"])) != digest:
        raise InputError(f"{why} has other settings now; put back the one that was trained with it")
    if any(str(again.get("at")) < str(then.manifest.get("ended")) for again in run.resumptions):
        raise InputError(f"{why} was resumed from a checkpoint meanwhile; that cannot be repeated")
    return run


def repeat(
    then: RunReader,
    folder: Path,
    config: TrainConfig,
    mdp: Mdp,
    trust: bool = False,
    members: Sequence[RunReader] = (),
) -> None:
    """Train a run again.

    Args:
        then: the run.
        folder: where the new run is written; it exists.
        config: the settings to train with.
        mdp: the world.
        trust: import the classes that the settings name, wherever they are from.
        members: of `population`; they are trained with it, in a temporary folder.

    Raises:
        InputError: it cannot be trained here.
        Interrupted: training was asked to stop.
    """
    first, *longer = lengths(then, config)
    overrides = then.manifest.get("overrides") or []
    config = dataclasses.replace(config, total_timesteps=first)
    own = partial(training, config, folder, overrides, lambda env: mdp)
    if not members:
        run_alone(own())
    else:
        place = [run.folder.name for run in members].index(then.folder.resolve().name)
        with tempfile.TemporaryDirectory(prefix="gridworld-") as others:
            tasks = [_again(run, Path(others), config, trust) for run in members]
            tasks[place] = own
            with mixing(then.manifest[NUMBERS_DEPEND_ON]):
                result = run_together(tasks)[place]
        if isinstance(result, Exception):
            raise result
    for length in longer:
        open_unfinished(folder, trust).resume(length)


def _again(run: RunReader, place: Path, like: TrainConfig, trust: bool) -> Callable[[], Training[Summary]]:
    """What trains a run again in a folder of its own, on the machine's part that another is trained on."""
    settings = settings_of(run, trust)
    config = dataclasses.replace(
        without_pictures(settings),
        total_timesteps=lengths(run, settings)[0],
        device=like.device,
        threads=like.threads,
    )
    mdp, folder = stored_world(run, config.env), place / run.folder.name
    folder.mkdir()
    return partial(training, config, folder, [], lambda env: mdp)


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
        for _ in _points(then.folder):
            pass


def compare(then: RunReader, now: RunReader, config: TrainConfig, mdp: Mdp) -> Iterator[Finding]:
    """Compare two finished runs of one configuration in one world, part by part of the result."""
    curves = _curve(then), _curve(now)
    _, difference = _first(_cells(curves[0]), _cells(curves[1]))
    yield Finding("learning curve", difference or f"{len(curves[0]) - 1:,} rows", not difference)
    yield _weights("final weights", then.folder / MODEL, now.folder / MODEL, config)
    yield _weights("best weights", then.folder / BEST_MODEL, now.folder / BEST_MODEL, config)
    before, after = (read_visits(run, mdp.probability.shape[:2]) for run in (then, now))
    if (place := _first_unequal(before, after)) is None:
        yield Finding("visits", f"{before.sum():,} steps")
    else:
        where = f"{mdp.state_name(int(place[0]))}, {mdp.action_names[int(place[1])]}"
        yield Finding("visits", _difference(where, before[place], after[place]), False)
    entries = [
        sorted((name, value) for name, value in flat(run.read_summary()) if name not in CLOCK)
        for run in (then, now)
    ]
    count, difference = _first(*entries)
    yield Finding("summary", difference or f"{count} entries, those of the clock aside", not difference)
    if config.logging.tensorboard:
        if next(_points(then.folder), None) is None:
            yield Finding("TensorBoard points", "the run's folder has no event file any more", None)
            return
        count, difference = _first(_points(then.folder), _points(now.folder))
        yield Finding("TensorBoard points", difference or f"{count:,} points", not difference)


def _curve(run: RunReader) -> list[list[str]]:
    return [*csv.reader(as_table(run.read(run.curve_file, LARGEST_CSV), run.curve_file).splitlines())]


def _cells(curve: Sequence[Sequence[str]]) -> Iterator[tuple[str, str]]:
    """The cells of a curve below the header, by step and column."""
    header, *rows = curve
    for row in rows:
        for column, text in zip_longest(header, row):
            yield f"step {row[0] if row else ''}, {column}", text


def _points(folder: Path) -> Iterator[tuple[str, float]]:
    """TensorBoard's points, without those of the clock, in the order in which they were written."""
    for path in sorted(folder.glob(EVENTS)):
        for tag, step, value in read_scalars(path):
            if not tag.startswith(CLOCK_TAGS):
                yield f"step {step}, {tag}", value


def _weights(part: str, then: Path, now: Path, config: TrainConfig) -> Finding:
    read = family(config.agent).weights
    after = read(now, LARGEST_RESULT)
    before = read(then, 2 * now.stat().st_size + _SPARE_BYTES)
    for name in sorted(before.keys() ^ after.keys()):
        return Finding(part, f"{name[:80]} is in one of the models only", False)
    for name, old in before.items():
        new = after[name]
        if (old.dtype, old.shape) != (new.dtype, new.shape):
            found = _difference(name, f"{old.dtype} {old.shape}", f"{new.dtype} {new.shape}")
            return Finding(part, found, False)
        if (place := _first_unequal(old, new)) is not None:
            where = f"{name}{list(map(int, place)) if place else ''}"
            return Finding(part, _difference(where, old[place], new[place]), False)
    return Finding(part, f"{len(before):,} tensors and numbers")


def _first(then: Entries, now: Entries) -> tuple[int, str]:
    """How many entries were compared, and the first difference; "" where there is none."""
    count = 0
    for (where, old), (other, new) in zip_longest(then, now, fillvalue=("", None)):
        if where and other and where != other:
            return count, _difference(where, where, other)
        if old != new and (old == old or new == new):  # NaN equals NaN
            return count, _difference(where or other, old, new)
        count += 1
    return count, ""


def _first_unequal(old: NDArray[Any], new: NDArray[Any]) -> tuple[Any, ...] | None:
    """The index of the first element that differs in arrays of one type and shape; NaN equals NaN."""
    same = old == new
    if old.dtype.kind in "fc":
        same |= np.isnan(old) & np.isnan(new)
    return None if same.all() else tuple(np.argwhere(np.atleast_1d(~same))[0][: old.ndim])


def _difference(where: str, old: object, new: object) -> str:
    then, now = ("nothing" if each is None else str(each)[:80] or "empty" for each in (old, new))
    return f"first at {where[:80]}: {then} then, {now} now"
