"""One run's training, from its first step or from a checkpoint to its last file.

What a checkpoint holds is in plain sight here: `Parts` has what continues from a state of its own, `LOGS` the
files that grow while training and are cut back to the checkpoint, `CONTENT` all keys. The files that are
written when training is over can be written again: a run that is killed there does so.
"""

from __future__ import annotations

import dataclasses
import logging
import math
import shlex
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from gridworld.agents import Agent, Learning, TrainingContext
from gridworld.config.settings import privileges
from gridworld.config.train import AUTO, TrainConfig
from gridworld.errors import InputError
from gridworld.process.console import Progress, tell
from gridworld.process.signals import StopRequest
from gridworld.process.together import clock
from gridworld.run.checkpoints import Checkpoints, Pace
from gridworld.run.folder import CURVE, EVENTS
from gridworld.run.provenance import environment, identity
from gridworld.run.summary import MOST_NAMED, Summary
from gridworld.run.writer import NEEDED, RunWriter, write_evaluations
from gridworld.storage.append_log import AppendLog
from gridworld.storage.atomic_write import sync, write_bytes, write_json
from gridworld.storage.serialization import State, fitting, npy_bytes
from gridworld.training.learning_curve import (
    CHARTS,
    CurveScalars,
    Evaluation,
    LearningCurve,
    read_curve,
    show_progress,
    write_row,
)
from gridworld.training.pictures import Pictures
from gridworld.training.tensorboard import EventWriter, as_markdown, hparams
from gridworld.training.together import Training
from gridworld.world.evaluation import Evaluator
from gridworld.world.mdp import EXACT
from gridworld.world.metrics import numbers, optimal_numbers

CLOCK = {"train_seconds", "evaluation_seconds"}  # the summary's times

_log = logging.getLogger("gridworld")


class Learner:
    """An agent, which takes its state when it begins to learn."""

    def __init__(self, agent: Agent) -> None:
        self.agent = agent
        self.state: State | None = None

    def get_state(self) -> State:
        """The agent's, with its environments."""
        return self.agent.get_state()

    def set_state(self, state: State) -> None:
        self.state = state


@dataclass(frozen=True, eq=False)
class Parts:
    """What has a state: a field's name is the checkpoint's key, its type has `get_state` and `set_state`."""

    agent: Learner
    curve: LearningCurve
    pictures: Pictures

    def get_state(self) -> State:
        """{name of the part: its state}."""
        return {name: getattr(self, name).get_state() for name in PARTS}

    def set_state(self, state: State) -> None:
        """Continue from the state of a whole checkpoint."""
        with fitting():
            for name in PARTS:
                getattr(self, name).set_state(state[name])


PARTS = tuple(field.name for field in dataclasses.fields(Parts))
LOGS = {"curve": CURVE, "events": EVENTS}  # that a checkpoint has marks of, and the pattern of their names
FORMAT = 6  # of a checkpoint; a number more where a part's state has other keys or another meaning
CONTENT = {  # the type of each key of a checkpoint
    "format": int,
    "identity": str,
    "environment": dict,
    "steps": int,
    "total_timesteps": int,
    "seconds": float,
    **dict.fromkeys(PARTS, dict),
    "marks": dict,
}


class Session:
    """The training of one run, new or continued; nothing is written before `run`.

    Args:
        config: the run's settings.
        folder: the run's.
        evaluator: the evaluator of its world.
        agent: ready to learn.
        context: where the agent learns.
        events: the event file, if there is to be one.
        state: the content of a checkpoint to continue from; None: from the start.
        is_trusted: whether the environment that the settings name may be made.

    Raises:
        StateError: for a state that does not fit.
    """

    def __init__(
        self,
        config: TrainConfig,
        folder: Path,
        evaluator: Evaluator,
        agent: Agent,
        context: TrainingContext,
        events: EventWriter | None,
        state: State | None,
        is_trusted: bool,
    ) -> None:
        self._config, self._events = config, events
        self._evaluator, self._visits = evaluator, context.envs.visits
        self._is_new = state is None
        self._curve_mark = None if state is None else state["marks"]["curve"]
        self.reached = 0 if state is None else int(state["steps"])  # environment steps
        self.checkpoints = Checkpoints(folder)
        self.checkpoints.newest = None if state is None else self.reached
        self._origin = {
            "identity": identity(config, evaluator.mdp.text()),
            "environment": environment(config.agent),
        }
        self._pace = Pace(self._checkpoint_every(agent), self.reached)
        self._stop = StopRequest()
        self._started = clock() - (0.0 if state is None else float(state["seconds"]))
        self._parts = Parts(
            Learner(agent),
            LearningCurve(evaluator, agent, config, envs=context.envs),
            Pictures(config, folder, evaluator, self._visits, events, is_trusted),
        )
        if state is not None:
            self._parts.set_state(state)

    def _checkpoint_every(self, agent: Agent) -> int | str | None:
        every = self._config.checkpoint.every
        if every is not None and (unknown := agent.class_without_state()) is not None:
            tell(f"checkpoints: none, since {unknown} does not define get_state and set_state")
            return None
        return every

    def progress(self) -> dict[str, int | None]:
        """How many steps were made, and how many of them are saved."""
        return {"reached": self.reached, "checkpoint": self.checkpoints.newest}

    def run(self, run: RunWriter) -> Training[Summary]:
        """Train, evaluate, record; the summary is written, too."""
        self._open(run)
        succeeded = False
        try:
            with self._stop.listening():
                self._begin()
                self._stop.patient = not self._pace.never
                yield self._learning()
                self._stop.patient = False
                self._stop.obey()
                summary = self._finish()
            succeeded = True
        finally:
            self._close(succeeded)
        return summary

    def _open(self, run: RunWriter) -> None:
        """Open the curve's file, cut back to the state, and the rest that takes evaluations."""
        config, events, curve = self._config, self._events, self._parts.curve
        self._run = run
        self._curve_log = AppendLog(run.curve_file, self._curve_mark)
        label = f"{config.agent.name} on {self._evaluator.mdp.name}"
        self._progress = Progress(config.total_timesteps, label, config.logging.progress)
        curve.sinks.append(partial(write_row, self._curve_log))
        if events is not None:
            curve.sinks.append(CurveScalars(events, self._evaluator).write)
        curve.sinks += [partial(show_progress, self._progress), self._parts.pictures.write]

    def _begin(self) -> None:
        if not self._is_new:
            self._parts.curve.write_held_of_shorter_run()
            return
        if self._events is not None:
            self._events.hparams(hparams(self._config))
            self._events.charts("greedy and sampled policy beside the optimum", CHARTS)
            self._events.text("run/command", f"    {shlex.join(self._run.manifest['command'])}", 0)
            self._events.text("run/settings", as_markdown(dataclasses.asdict(self._config)), 0)
        self._parts.curve.evaluate(0)

    def _learning(self) -> Learning:
        learner = self._parts.agent
        state, learner.state = learner.state, None  # it may be large
        on_safe_point = None if self._pace.never else self._on_safe_point
        return Learning(learner.agent, self._config.total_timesteps, self._on_step, on_safe_point, state)

    def _on_step(self, steps: int) -> int:
        self.reached = steps
        if self._pace.never:  # else a safe point will come
            self._stop.obey()
        return self._parts.curve.on_step(steps)

    def _on_safe_point(self, steps: int) -> None:
        """Save if it is time for it; nothing is half done here."""
        asked = self._stop.number is not None
        is_last = steps >= self._config.total_timesteps
        if not (asked or is_last or self._pace.is_due(steps)) or steps == self.checkpoints.newest:
            self._stop.obey()
            return
        started = clock()
        try:
            self._save(steps, is_last)
        except OSError as error:
            _log.warning("%s: no checkpoint after step %s, %s", self._run.folder, steps, error.strerror)
        self._pace.took(steps, clock() - started)
        self._stop.obey()

    def _save(self, steps: int, is_last: bool) -> None:
        # A short run is over before a disk has anything, and waits for it at its end only (see `_settle`).
        durable = not is_last or self.checkpoints.newest is not None
        logs = {"curve": self._curve_log, "events": None if self._events is None else self._events.log}
        if durable:
            for log in logs.values():
                if log is not None:
                    log.sync()
            self._run.settle()
        state = {
            "format": FORMAT,
            **self._origin,
            "steps": steps,
            "total_timesteps": self._config.total_timesteps,
            "seconds": clock() - self._started,
            **self._parts.get_state(),
            "marks": {name: None if log is None else log.mark() for name, log in logs.items()},
        }
        self.checkpoints.save(steps, state, durable, small=is_last)

    def _finish(self) -> Summary:
        seconds = clock() - self._started
        run, parts = self._run, self._parts
        last = parts.curve.evaluate(self.reached)
        write_bytes(run.model_file, parts.agent.agent.model_file())
        write_bytes(run.best_model_file, parts.curve.best.content)
        self._write_evaluations()
        write_bytes(run.visits_file, npy_bytes(self._visits))
        summary = summarise(self._config, parts.curve, last, seconds)
        write_json(run.summary_file, _as_json(summary))
        if self._events is not None:
            timeless = {key: value for key, value in summary.items() if key not in CLOCK}
            self._events.text("run/summary", as_markdown(timeless), last.step)
        with ThreadPoolExecutor(1) as disk:  # pictures are drawn while it is waited for
            settling = disk.submit(self._settle)
            parts.pictures.finish(last)
        settling.result()
        return summary

    def _settle(self) -> None:
        """Make the results, and the checkpoint that makes the run longer, survive a power cut."""
        newest = self.checkpoints.files()[:1]
        self._run.settle(*newest, *self._run.results())
        if newest:
            sync([], self.checkpoints.folder)

    def _write_evaluations(self) -> None:
        self._curve_log.check()
        if self._parts.curve.newest is not None:
            write_evaluations(self._run.evaluations_file, read_curve(self._curve_log, NEEDED))

    def _close(self, succeeded: bool) -> None:
        """Close what is open; on a full disk, without a last word."""
        closing: list[Callable[[], None]] = [self._curve_log.close, self._progress.close]
        if self._events is not None:
            events = self._events
            closing += [lambda: events.end_session(succeeded), lambda: events.log.sync(), events.close]
        if not succeeded:
            closing.insert(0, self._write_evaluations)
        failures: list[Exception] = []
        for close in closing:
            try:
                close()
            except (OSError, InputError) as error:
                failures.append(error)
        if succeeded and failures:
            raise failures[0]


def summarise(config: TrainConfig, curve: LearningCurve, last: Evaluation, seconds: float) -> Summary:
    """The fields of `summary.json`, where numbers may be infinite; `seconds` are those of training."""
    evaluator, certificate = curve.evaluator, curve.certificate
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
        "observation": config.observation.kind,
        "seed": config.seed,
        "recipe": config.recipe,
        "preset": config.preset if config.preset != AUTO else "none",
        "privileges": privileges(dataclasses.asdict(config)),
        "total_timesteps": config.total_timesteps,
        "timesteps": last.step,
        "gamma": config.evaluation.gamma,
        "max_episode_steps": evaluator.max_episode_steps,
        "certified": last.greedy.certified,
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
