"""One training run: from its settings to its folder."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import shlex
import traceback
from collections.abc import Callable
from pathlib import Path

from gridworld.agents import Agent, family
from gridworld.config.train import TrainConfig
from gridworld.config.worlds import EnvConfig, compiled
from gridworld.envs.observations import make_observation
from gridworld.errors import InputError, MachineError, reason
from gridworld.process.console.command_line import recorded_command_line
from gridworld.process.console.terminal import tell
from gridworld.process.signals import Interrupted
from gridworld.run.folder import RunFolder, shown
from gridworld.run.summary import Summary, interruption_text
from gridworld.run.train_log import TrainLog
from gridworld.run.writer import RunWriter
from gridworld.storage.atomic_write import write_text
from gridworld.storage.serialization import State, StateError
from gridworld.training.session import Session
from gridworld.training.setup import check_settings, make_context, notes
from gridworld.training.tensorboard import EventWriter
from gridworld.training.together import Training, run_alone
from gridworld.world.exact.evaluation import Evaluator
from gridworld.world.mdp import Mdp

OnBuilt = Callable[[Agent], None]


def ignore(agent: Agent) -> None:
    """No-op `OnBuilt`."""


def train(
    config: TrainConfig,
    folder: Path,
    overrides: list[str],
    world: Callable[[EnvConfig], Mdp] = compiled,
    replace: bool = False,
    on_built: OnBuilt = ignore,
) -> Summary:
    """Train, evaluate and record as configured; everything it writes goes to the run's folder.

    Args:
        config: the run's settings.
        folder: the run's, which everything is written to.
        overrides: what the command line changed, for the manifest.
        world: makes the configured world, or returns one that there is.
        replace: whether what the folder has of an earlier run is cleared away.
        on_built: takes the agent before it learns.

    Returns:
        The summary.

    Raises:
        InputError: for a mistake in the settings, before anything is written, or where training diverges.
        MachineError: where files cannot be written.
        Interrupted: by a signal, after a checkpoint.
    """
    return run_alone(training(config, folder, overrides, world, replace, on_built))


def training(
    config: TrainConfig,
    folder: Path,
    overrides: list[str],
    world: Callable[[EnvConfig], Mdp] = compiled,
    replace: bool = False,
    on_built: OnBuilt = ignore,
) -> Training[Summary]:
    """The same as a generator, for `run_together`."""
    with TrainLog() as log:
        mdp = check_settings(config, world)
        for note in notes(config, mdp) if config.logging.progress else ():
            tell(note)

        def begin() -> RunWriter:
            return RunWriter.start(folder, dataclasses.asdict(config), mdp, overrides, replace)

        return (yield from carry_out(config, folder, mdp, begin, log, world is compiled, on_built=on_built))


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
    """Train from the start or continue from a state, with settings that were checked.

    Args:
        config: the run's settings.
        folder: the run's, which everything is written to.
        mdp: the run's world.
        begin: writes the manifest, once the agent is built.
        log: takes what is warned about; its file is opened here.
        is_trusted: whether the environment that the settings name may be made.
        state: the content of a checkpoint; None: from the start.
        on_built: as for `train`.

    Returns:
        The summary.

    Raises:
        InputError, MachineError, Interrupted: as `train` does.
    """
    observation = make_observation(mdp, config.observation.kind, config.observation.cell_size)
    evaluator = Evaluator(mdp, config.evaluation.gamma, config.env.step_limit(mdp))
    events = None
    if config.logging.tensorboard:
        events = EventWriter(folder, None if state is None else state["marks"]["events"])
    context = make_context(config, mdp, observation, None if events is None else events.scalars)
    agent = family(config.agent).build(config.agent, context)
    on_built(agent)

    try:
        run = begin()
    except OSError as error:  # the manifest is the old one, or none: files are replaced whole
        raise _unwritable(folder, config, error) from None
    log.open(run.log_file)
    if state is None:
        log.add(f"begins: {shlex.join(recorded_command_line())}")
    session = None
    try:
        session = Session(config, run, evaluator, agent, context, events, state, is_trusted)
        summary = yield from session.run()
    except Interrupted as interruption:
        run.end("interrupted", str(interruption), **_progress(session))
        log.add(interruption_text(interruption, run, run.manifest))
        raise
    except BaseException as error:
        with contextlib.suppress(OSError):  # nothing can be written perhaps
            _note_failure(run, log, error, _progress(session))
        if isinstance(error, StateError):
            raise InputError(f"{folder}: its checkpoint does not fit this run: {error}") from None
        if isinstance(error, OSError):
            raise _unwritable(folder, config, error) from None
        raise
    session.checkpoints.keep(1)
    run.end("finished", None, **_progress(session))
    log.add(f"finished after {session.reached:,} steps")
    return summary


def _is_failure(error: BaseException) -> bool:
    # What is no `Exception` is a signal's that came before the session takes them itself.
    return isinstance(error, Exception) and not isinstance(error, OSError)


def _note_failure(
    run: RunWriter, log: TrainLog, error: BaseException, progress: dict[str, int | None]
) -> None:
    """Write to the manifest and the log why a run ended, and the traceback of what nobody has foreseen."""
    failed = _is_failure(error)
    status = "failed" if failed else "interrupted"
    log.add(f"{status}: {reason(error)}", logging.ERROR)
    if failed and not isinstance(error, InputError | StateError):
        write_text(run.error_file, traceback.format_exc())
    run.end(status, reason(error), **progress)


def _unwritable(folder: Path, config: TrainConfig, error: OSError) -> MachineError:
    run = RunFolder(folder)
    resume = run.resume_command(dataclasses.asdict(config))
    how = f"go on with {resume}" if run.manifest_file.exists() else "give the command again"
    return MachineError(f"{shown(folder)}: {reason(error)}; put that right, then {how}")


def _progress(session: Session | None) -> dict[str, int | None]:
    """How many steps were made, and how many of them are saved."""
    if session is None:
        return {}
    return {"reached": session.reached, "checkpoint": session.checkpoints.newest}
