"""Training a run again, through the lengths that it had.

A run that was made longer is not the run of that length from the start: what is scheduled over training had
come to its end already. So it is trained to its first length, and then resumed to each longer one.

A run whose numbers depend on those of others, with which its networks were updated at once, is trained again
together with these: its siblings in the sweep's folder, from their own manifests.
"""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from gridworld.config.pictures import RecordingConfig
from gridworld.config.train import TrainConfig
from gridworld.errors import InputError
from gridworld.process.parallel.together import mixing
from gridworld.restore.resume import open_unfinished
from gridworld.restore.saved_run import settings_of
from gridworld.run.folder import MANIFEST
from gridworld.run.manifest import NUMBERS_DEPEND_ON
from gridworld.run.provenance import settings_hash
from gridworld.run.reader import RunReader, read_run, stored_world
from gridworld.run.summary import Summary
from gridworld.training.together import Training, run_alone, run_together
from gridworld.training.train import training
from gridworld.world.mdp import Mdp


def lengths(then: RunReader, config: TrainConfig) -> list[int]:
    """The lengths that a run had, one after the other.

    Args:
        then: The run.
        config: Its settings.

    Returns:
        Environment steps; the last are those of the settings.
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


def population(then: RunReader) -> list[RunReader]:
    """The runs that a run's numbers depend on, itself among them, in the order in which they were begun.

    Returns:
        The runs; none where the run's numbers are those that it has alone.
    """
    depends_on = then.manifest.get(NUMBERS_DEPEND_ON, {})
    if then.resumptions and any(NUMBERS_DEPEND_ON in each for each in (then.manifest, *then.resumptions)):
        again = then.resumptions[-1]
        raise InputError(
            f"{then.folder}: its numbers depend on other runs, and it went on after step {again.get('step')} "
            f"{'together with others' if NUMBERS_DEPEND_ON in again else 'alone'}, which cannot be repeated"
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
        raise InputError(f"{why} went on from a checkpoint meanwhile; that cannot be repeated")
    return run


def without_pictures(config: TrainConfig) -> TrainConfig:
    """Pictures are not compared; drawing them takes time, or an extra that may be missing here."""
    wanted = {field.name: False for field in dataclasses.fields(RecordingConfig) if field.type == "bool"}
    return dataclasses.replace(
        config,
        recording=dataclasses.replace(config.recording, **wanted),
        logging=dataclasses.replace(config.logging, policy_map_every=0),
    )


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
        then: The run.
        folder: Where the new run is written; it exists.
        config: The settings to train with.
        mdp: The world.
        trust: Import the classes that the settings name, wherever they are from.
        members: Of `population`; they are trained with it, in a temporary folder.

    Raises:
        InputError: It cannot be trained here.
        Interrupted: Training was asked to stop.
    """
    first, *longer = lengths(then, config)
    overrides = then.manifest.get("overrides") or []
    config = dataclasses.replace(config, total_timesteps=first)
    own = partial(training, config, folder, overrides, lambda env: mdp)
    if members:
        _together(then, own, config, members, trust)
    else:
        run_alone(own())
    for length in longer:
        open_unfinished(folder, trust).resume(length)


def _together(
    then: RunReader,
    own: Callable[[], Training[Summary]],
    config: TrainConfig,
    members: Sequence[RunReader],
    trust: bool,
) -> None:
    """Train a run by `own`, and its members beside it."""
    names = [run.folder.name for run in members]
    place = names.index(then.folder.resolve().name)
    with tempfile.TemporaryDirectory(prefix="gridworld-") as beside:
        tasks = [_beside(run, Path(beside), config, trust) for run in members]
        tasks[place] = own
        with mixing(then.manifest[NUMBERS_DEPEND_ON]):
            results = run_together(tasks)
    if isinstance(error := results[place], Exception):
        raise error


def _beside(run: RunReader, beside: Path, like: TrainConfig, trust: bool) -> Callable[[], Training[Summary]]:
    """What trains a run again in a folder of its own, on the machine's part that another is trained on."""
    settings = settings_of(run, trust)
    config = dataclasses.replace(
        without_pictures(settings),
        total_timesteps=lengths(run, settings)[0],
        device=like.device,
        threads=like.threads,
    )
    mdp, folder = stored_world(run, config.env), beside / run.folder.name
    folder.mkdir()
    return partial(training, config, folder, [], lambda env: mdp)
