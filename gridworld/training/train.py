"""One training run: from its settings to its folder. `training` has the whole story, from top to bottom."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import math
import os
import shlex
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

from gridworld.agents import Agent
from gridworld.base.atomic_write import write_bytes, write_json, write_text
from gridworld.base.console import recorded_command_line, tell
from gridworld.base.errors import FolderLostError, InputError, MachineError, reason
from gridworld.base.serialization import State, StateError, npy_bytes
from gridworld.base.signals import Interrupted
from gridworld.config.recipes import agent_and_recipe
from gridworld.config.settings import privileges
from gridworld.config.train import TrainConfig
from gridworld.config.worlds import World, compiled
from gridworld.run.console import MOST_NAMED, Summary, interruption_text
from gridworld.run.folder import MANIFEST, RunFolder, shown
from gridworld.run.reader import is_started
from gridworld.run.writer import RunWriter, TrainLog
from gridworld.training.learning_curve import Evaluation, LearningCurve
from gridworld.training.pictures import Pictures
from gridworld.training.session import Session, Trackers
from gridworld.training.setup import check_settings, make_context, notes
from gridworld.training.together import Training, alone
from gridworld.world.evaluation import Evaluator
from gridworld.world.mdp import EXACT, Mdp
from gridworld.world.metrics import numbers, optimal_numbers

OnBuilt = Callable[[Agent], None] | None
Beginning = tuple[State | None, Callable[[], RunWriter]]  # a checkpoint's state, and what writes the manifest


def training(
    config: TrainConfig,
    folder: Path,
    overrides: list[str],
    world: World = compiled,
    on_built: OnBuilt = None,
    is_trusted: bool = True,
    continued: Callable[[TrainConfig, Mdp], Beginning] | None = None,
) -> Training[Summary]:
    """Train, evaluate and record as configured; the manifest says that the command line changed `overrides`.

    `world` makes the configured world, or returns an existing one; `on_built` takes the agent before it
    learns; `is_trusted` is whether the environment that the settings name may be made; `continued` says how
    a run begins that has begun before. A mistake in the settings is an `InputError` before anything is
    written; so is a divergence. Raises `MachineError` where files cannot be written, and `Interrupted` after
    a signal and a checkpoint.
    """
    with TrainLog() as log:
        mdp = check_settings(config, world)
        state, begin = continued(config, mdp) if continued else _new_run(config, folder, overrides, mdp)
        with _failures_explained(config, folder):
            # Nothing is written before all that takes part is made, and fits a checkpoint's state.
            evaluator = Evaluator(mdp, config.evaluation.gamma, config.env.step_limit(mdp))
            trackers = Trackers(config, folder, mdp, state)
            context = make_context(config, mdp, trackers.write_scalars)
            agent = config.agent.build(context)
            if on_built is not None:
                on_built(agent)
            curve = LearningCurve(evaluator, agent, config, context.envs)
            pictures = Pictures(config, folder, evaluator, context.envs.visits, trackers.events, is_trusted)
            session = Session(config, folder, curve, pictures, trackers, state)
            run = begin()  # which writes the manifest
            try:
                log.open(run.log_file)
                if state is None:
                    log.add(f"starts: {shlex.join(recorded_command_line())}")
                with session.files(run), session.stop.listening():
                    if state is None:
                        trackers.begin(config, run.manifest["command"])
                        curve.evaluate(0)
                    else:
                        curve.write_held_of_shorter_run()
                    yield session.learning()  # alone, or with other runs at once
                    session.stop.obey()
                    seconds = session.seconds()
                    last = curve.evaluate(session.reached)
                    summary = summarise(config, curve, last, seconds)
                    write_bytes(run.model_file, agent.model_file())
                    write_bytes(run.best_model_file, curve.best.content)
                    session.write_evaluations()
                    write_bytes(run.visits_file, npy_bytes(context.envs.visits))
                    write_json(run.summary_file, _as_json(summary))
                    trackers.show(summary)
                    with ThreadPoolExecutor(1) as disk:  # pictures are drawn while it is waited for
                        settling = disk.submit(session.settle)
                        pictures.finish(last)
                    settling.result()
            except BaseException as error:
                _note_end(run, log, error, session.progress())
                raise
        session.checkpoints.keep(1)
        run.end("finished", None, **session.progress())
        log.add(f"finished after {session.reached:,} steps")
    return summary


train = alone(training)


def _new_run(config: TrainConfig, folder: Path, overrides: list[str], mdp: Mdp) -> Beginning:
    """Print what a user should know of the settings; the run begins without a state."""
    for note in notes(config, mdp) if config.logging.progress else ():
        tell(note)
    manifest = folder / MANIFEST
    is_empty = os.path.lexists(manifest) and not is_started(folder)
    if is_empty:
        tell(f"{manifest}: is empty, so nothing of the run was saved; it starts over")
    return None, partial(RunWriter.start, folder, dataclasses.asdict(config), mdp, overrides, is_empty)


@contextlib.contextmanager
def _failures_explained(config: TrainConfig, folder: Path) -> Iterator[None]:
    """Raise what is wrong with a checkpoint or a disk as a sentence that says what to do."""
    try:
        yield
    except StateError as error:
        raise InputError(f"{folder}: its checkpoint does not fit this run: {error}") from None
    except OSError as error:
        resume = RunFolder(folder).resume_command(dataclasses.asdict(config))
        how = f"resume with {resume}" if (folder / MANIFEST).exists() else "run the command again"
        raise MachineError(f"{shown(folder)}: {reason(error)}; fix that, then {how}") from None


def _note_end(run: RunWriter, log: TrainLog, error: BaseException, progress: dict[str, int | None]) -> None:
    """Record why a run ended before its end, and the traceback of what nobody has foreseen."""
    if isinstance(error, FolderLostError):  # what is there by now is another's
        return
    # What is not an `Exception` is a signal's that came before the session takes them itself.
    failed = isinstance(error, Exception) and not isinstance(error, OSError)
    status = "failed" if failed else "interrupted"
    with contextlib.suppress(OSError):  # nothing can be written perhaps
        if isinstance(error, Interrupted):
            run.end(status, str(error), **progress)
            log.add(interruption_text(error, run, run.manifest))
            return
        log.add(f"{status}: {reason(error)}", logging.ERROR)
        if failed and not isinstance(error, InputError | StateError):
            write_text(run.error_file, traceback.format_exc())
        run.end(status, reason(error), **progress)


def summarise(config: TrainConfig, curve: LearningCurve, last: Evaluation, seconds: float) -> Summary:
    """The fields of `summary.json`, where numbers may be infinite; `seconds` are those of training."""
    evaluator, certificate, acts_by = curve.evaluator, curve.certificate, curve.agent.acts_by()
    mdp = evaluator.mdp
    endless = evaluator.endless_states(last.snapshot.greedy_policy())
    greedy, sampled = (
        {name: number for name, number in numbers(score).items() if name != "certified"}
        for score in (last.greedy, last.sampled)
    )
    return {
        "agent": config.agent.name,
        "env": mdp.name,
        **({} if mdp.truth == EXACT else {"truth": mdp.truth}),
        "scope": mdp.scope + ("" if acts_by is None else f"; actions are what {acts_by}.predict answers"),
        "observation": config.observation.kind,
        "seed": config.seed,
        "recipe": agent_and_recipe(config)[1],
        "privileges": privileges(dataclasses.asdict(config)),
        "total_timesteps": config.total_timesteps,
        "timesteps": last.step,
        "gamma": config.evaluation.gamma,
        "max_episode_steps": evaluator.max_episode_steps,
        "certified": last.greedy.certified,
        "proven_regret": last.greedy.proven_regret,
        "first_certified_step": certificate.first_certified_step,
        "certified_since_step": certificate.certified_since_step,
        "best_step": curve.best.step,
        "best_regret": curve.best.regret,
        **optimal_numbers(evaluator),
        **greedy,
        "endless_cells": [mdp.coordinates(state) for state in endless],
        "endless_states": [mdp.state_name(state) for state in endless[:MOST_NAMED]],
        "sampled": sampled,
        "train_seconds": round(seconds, 3),
        "evaluation_seconds": round(curve.seconds, 3),
    }


def _as_json(content: Any) -> Any:
    """The same with null for what JSON has no number for: an endless walk at γ = 1 is worth -inf."""
    if isinstance(content, dict):
        return {key: _as_json(value) for key, value in content.items()}
    return None if isinstance(content, float) and not math.isfinite(content) else content
