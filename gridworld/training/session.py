"""What a run has between its steps: how far it is, when it is saved, and what is saved of it.

What a checkpoint holds is in plain sight here: `Session._state` makes it, `CONTENT` has its keys, `LOGS` the
files that grow while training and are cut back to the checkpoint. The files that are written when training is
over can be written again: a run that is killed there does so.
"""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import shlex
import time
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from gridworld.agents import Learning, WriteScalars
from gridworld.base.atomic_write import AppendLog, sync
from gridworld.base.console import Progress, tell
from gridworld.base.errors import InputError
from gridworld.base.serialization import State, fitting
from gridworld.base.signals import StopRequest
from gridworld.base.together import clock
from gridworld.config.train import TrainConfig
from gridworld.run.checkpoints import Checkpoints, Pace
from gridworld.run.console import Summary
from gridworld.run.folder import CURVE, EVENTS
from gridworld.run.provenance import environment, identity
from gridworld.run.writer import RunWriter, write_evaluations
from gridworld.training.learning_curve import (
    CHARTS,
    LearningCurve,
    read_curve,
    send_scalars,
    show_progress,
    write_row,
)
from gridworld.training.pictures import Pictures
from gridworld.training.tensorboard import HOW_TO_READ, EventWriter, as_markdown, hparams
from gridworld.world.mdp import Mdp
from gridworld.world.metrics import optimal_score

CLOCK = {"train_seconds", "evaluation_seconds"}  # the summary's times
LOGS = {"curve": CURVE, "events": EVENTS}  # that a checkpoint has marks of, and the pattern of their names
FORMAT = 6  # of a checkpoint; a number more where a part's state has other keys or another meaning
CONTENT = {  # the type of each key of a checkpoint
    "format": int,
    "identity": str,
    "environment": dict,
    "steps": int,
    "total_timesteps": int,
    "seconds": float,
    "agent": dict,
    "curve": dict,
    "pictures": dict,
    "marks": dict,
}

_log = logging.getLogger("gridworld")


class Session:
    """A run at work, new or continued from a checkpoint's `state`; `StateError` where that does not fit."""

    def __init__(
        self,
        config: TrainConfig,
        folder: Path,
        curve: LearningCurve,
        pictures: Pictures,
        trackers: Trackers,
        state: State | None,
    ) -> None:
        self._config, self._continued_from = config, state
        self._curve, self._pictures, self._trackers = curve, pictures, trackers
        self.checkpoints, self.stop = Checkpoints(folder), StopRequest()
        self.reached = 0  # environment steps
        self._origin = {
            "identity": identity(config, curve.evaluator.mdp.text()),
            "environment": environment(config.agent),
        }
        self._started = clock()
        if state is not None:
            with fitting():
                curve.set_state(state["curve"])
                pictures.set_state(state["pictures"])
                self.reached = self.checkpoints.newest = int(state["steps"])
                self._started -= float(state["seconds"])
        every = config.checkpoint.every
        if every is not None and (unknown := curve.agent.class_without_state()) is not None:
            tell(f"no checkpoints, since {unknown} does not define get_state and set_state")
            every = None
        self._pace = Pace(every, self.reached)

    def progress(self) -> dict[str, int | None]:
        """How many steps were made, and how many of them are saved."""
        return {"reached": self.reached, "checkpoint": self.checkpoints.newest}

    def seconds(self) -> float:
        """How long the steps took."""
        return clock() - self._started

    @contextlib.contextmanager
    def files(self, run: RunWriter) -> Iterator[None]:
        """Open the curve's file, cut back to the state, and the rest that takes evaluations; close it all.

        After a failure, which is on its way up, without a word of further ones.
        """
        config, curve, state = self._config, self._curve, self._continued_from
        self._run = run
        self._curve_log = AppendLog(run.curve_file, None if state is None else state["marks"]["curve"])
        label = f"{config.agent.name} on {curve.evaluator.mdp.name}"
        progress = Progress(config.total_timesteps, label, config.logging.progress)
        curve.sinks.append(partial(write_row, self._curve_log))
        if (write_scalars := self._trackers.write_scalars) is not None:
            curve.sinks.append(partial(send_scalars, write_scalars, optimal_score(curve.evaluator)))
        curve.sinks += [partial(show_progress, progress), self._pictures.write]
        succeeded = False
        try:
            yield
            succeeded = True
        finally:
            ignored = () if succeeded else (OSError, InputError)
            with contextlib.suppress(*ignored), contextlib.ExitStack() as closing:  # the last one is first
                closing.callback(self._trackers.end, succeeded)
                closing.callback(progress.close)
                closing.callback(self._curve_log.close)
                if not succeeded:
                    closing.callback(self.write_evaluations)

    def learning(self) -> Learning:
        """What the agent has to learn; from here on a signal waits for a safe point, if there are any."""
        state = self._continued_from
        self.stop.patient = not self._pace.never
        return Learning(
            self._curve.agent,
            self._config.total_timesteps,
            self._on_step,
            None if self._pace.never else self._on_safe_point,
            None if state is None else state["agent"],
        )

    def _on_step(self, steps: int) -> int:
        self.reached = steps
        if self._pace.never:  # else a safe point will come
            self.stop.obey()
        return self._curve.on_step(steps)

    def _on_safe_point(self, steps: int) -> None:
        """Save if it is time for it; nothing is half done here."""
        asked = self.stop.number is not None  # a later signal waits for the next safe point
        is_last = steps >= self._config.total_timesteps
        if (asked or is_last or self._pace.is_due(steps)) and steps != self.checkpoints.newest:
            started = time.perf_counter()
            # A short run is over before a disk has anything, and waits for it at its end only (see `settle`).
            durable = not is_last or self.checkpoints.newest is not None
            try:
                if durable:
                    self._curve_log.sync()
                    if self._trackers.events is not None:
                        self._trackers.events.log.sync()
                    self._run.settle()
                self.checkpoints.save(steps, self._state(steps), durable, small=is_last)
            except OSError as error:
                _log.warning("%s: no checkpoint after step %s, %s", self._run.folder, steps, error.strerror)
            self._pace.took(steps, time.perf_counter() - started)
        if asked:
            self.stop.obey()

    def _state(self, steps: int) -> State:
        config, events = self._config, self._trackers.events
        return {
            "format": FORMAT,
            **self._origin,
            "steps": steps,
            "total_timesteps": config.total_timesteps,
            "seconds": self.seconds(),
            "agent": self._curve.agent.get_state(),
            "curve": self._curve.get_state(),
            "pictures": self._pictures.get_state(),
            "marks": {
                "curve": self._curve_log.mark(),
                "events": None if events is None else events.log.mark(),
            },
        }

    def settle(self) -> None:
        """Make the results, and the checkpoint that makes the run longer, survive a power cut."""
        newest = self.checkpoints.files()[:1]
        self._run.settle(*newest, *self._run.results())
        if newest:
            sync([], self.checkpoints.folder)

    def write_evaluations(self) -> None:
        """Write the curve as SB3 does, if there is any."""
        self._curve_log.check()
        if self._curve.newest is not None:
            write_evaluations(self._run.evaluations_file, read_curve(self._curve_log))


class Trackers:
    """TensorBoard's event file and a run of Weights & Biases, where the settings ask for them."""

    def __init__(self, config: TrainConfig, folder: Path, mdp: Mdp, state: State | None) -> None:
        self.events: EventWriter | None = None
        if config.logging.tensorboard:
            self.events = EventWriter(folder, None if state is None else state["marks"]["events"])
        self._wandb: Any = None
        if config.logging.wandb:
            from gridworld.training.wandb_log import begin

            self._wandb = begin(config, [identity(config, mdp.text()), folder.absolute()], state is not None)
        is_any = self.events is not None or self._wandb is not None
        self.write_scalars: WriteScalars | None = self._write_scalars if is_any else None

    def _write_scalars(self, values: Mapping[str, float], step: int) -> None:
        if self.events is not None:
            self.events.scalars(values, step)
        if self._wandb is not None:
            self._wandb.log({**values, "step": step})

    def begin(self, config: TrainConfig, command: Sequence[str]) -> None:
        """Write a new run's settings, and what its charts show."""
        if self.events is not None:
            self.events.hparams(hparams(config))
            self.events.charts("greedy and sampled policy with the optimum", CHARTS)
            self.events.text("run/how_to_read", HOW_TO_READ, 0)
            self.events.text("run/command", f"    {shlex.join(command)}", 0)
            self.events.text("run/settings", as_markdown(dataclasses.asdict(config)), 0)

    def show(self, summary: Summary) -> None:
        """Write the result, without the times."""
        if self.events is not None:
            timeless = {key: value for key, value in summary.items() if key not in CLOCK}
            self.events.text("run/summary", as_markdown(timeless), summary["timesteps"])

    def end(self, succeeded: bool) -> None:
        """Write how the run ended, and close what is open, whatever one of them raises."""
        with contextlib.ExitStack() as closing:
            if self._wandb is not None:
                closing.callback(self._wandb.finish, int(not succeeded))
            if self.events is not None:
                closing.callback(self.events.close)
                self.events.end_session(succeeded)
                self.events.log.sync()
