"""One training run: from its settings to its folder."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import os
import shlex
import traceback
from collections.abc import Callable
from functools import partial
from pathlib import Path

from gridworld.base.atomic_write import write_text
from gridworld.base.console import recorded_command_line, tell
from gridworld.base.errors import FolderLostError, InputError, MachineError, reason
from gridworld.base.serialization import State, StateError
from gridworld.base.signals import Interrupted
from gridworld.config.train import TrainConfig
from gridworld.config.worlds import World, compiled
from gridworld.run.console import Summary, interruption_text
from gridworld.run.folder import MANIFEST, RunFolder, shown
from gridworld.run.reader import is_started
from gridworld.run.writer import RunWriter, TrainLog
from gridworld.training.session import OnBuilt, Session, ignore
from gridworld.training.setup import check_settings, notes
from gridworld.training.together import Training, alone
from gridworld.world.mdp import Mdp


def training(
    config: TrainConfig,
    folder: Path,
    overrides: list[str],
    world: World = compiled,
    on_built: OnBuilt = ignore,
    is_trusted: bool = True,
) -> Training[Summary]:
    """Train, evaluate and record as configured; the manifest says that the command line changed `overrides`.

    `world` makes the configured world, or returns an existing one; `on_built` takes the agent before it
    learns; `is_trusted` is whether the environment that the settings name may be made. A mistake in the
    settings is an `InputError` before anything is written; so is a divergence. Raises `MachineError` where
    files cannot be written, and `Interrupted` after a signal and a checkpoint.
    """
    with TrainLog() as log:
        mdp = check_settings(config, world)
        for note in notes(config, mdp) if config.logging.progress else ():
            tell(note)
        manifest = folder / MANIFEST
        is_empty = os.path.lexists(manifest) and not is_started(folder)
        if is_empty:
            tell(f"{manifest}: is empty, so nothing of the run was saved; it starts over")
        begin = partial(RunWriter.start, folder, dataclasses.asdict(config), mdp, overrides, replace=is_empty)
        return (yield from carry_out(config, folder, mdp, begin, log, is_trusted, on_built=on_built))


train = alone(training)


def carry_out(
    config: TrainConfig,
    folder: Path,
    mdp: Mdp,
    begin: Callable[[], RunWriter],
    log: TrainLog,
    is_trusted: bool,
    state: State | None = None,
    on_built: OnBuilt = ignore,
) -> Training[Summary]:
    """Train from the start or continue from a state, see `Session`; `begin` writes the manifest."""
    run = session = None
    try:
        session = Session(config, folder, mdp, is_trusted, state, on_built)
        run = begin()
        log.open(run.log_file)
        if state is None:
            log.add(f"starts: {shlex.join(recorded_command_line())}")
        summary = yield from session.run(run)
    except BaseException as error:
        if run is not None and session is not None and not isinstance(error, FolderLostError):
            with contextlib.suppress(OSError):  # nothing can be written perhaps
                _note_end(run, log, error, session.progress())
        if isinstance(error, StateError):
            raise InputError(f"{folder}: its checkpoint does not fit this run: {error}") from None
        if isinstance(error, OSError):
            resume = RunFolder(folder).resume_command(dataclasses.asdict(config))
            how = f"resume with {resume}" if (folder / MANIFEST).exists() else "run the command again"
            raise MachineError(f"{shown(folder)}: {reason(error)}; fix that, then {how}") from None
        raise
    session.checkpoints.keep(1)
    run.end("finished", None, **session.progress())
    log.add(f"finished after {session.reached:,} steps")
    return summary


def _note_end(run: RunWriter, log: TrainLog, error: BaseException, progress: dict[str, int | None]) -> None:
    """Record why a run ended before its end, and the traceback of what nobody has foreseen."""
    if isinstance(error, Interrupted):
        run.end("interrupted", str(error), **progress)
        log.add(interruption_text(error, run, run.manifest))
        return
    # What is not an `Exception` is a signal's that came before the session takes them itself.
    failed = isinstance(error, Exception) and not isinstance(error, OSError)
    status = "failed" if failed else "interrupted"
    log.add(f"{status}: {reason(error)}", logging.ERROR)
    if failed and not isinstance(error, InputError | StateError):
        write_text(run.error_file, traceback.format_exc())
    run.end(status, reason(error), **progress)
