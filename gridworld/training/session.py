"""One run's training, from its first step or from a checkpoint to its last file.

What a checkpoint holds is in plain sight here: `Session._state` makes it, `CONTENT` has its keys, `LOGS` the
files that grow while training and are cut back to the checkpoint. The files that are written when training is
over can be written again: a run that is killed there does so.
"""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import math
import shlex
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

from gridworld.agents import Agent, Learning
from gridworld.base.atomic_write import AppendLog, sync, write_bytes, write_json
from gridworld.base.console import Progress, tell
from gridworld.base.errors import InputError
from gridworld.base.serialization import State, fitting, npy_bytes
from gridworld.base.signals import StopRequest
from gridworld.base.together import clock
from gridworld.config.recipes import agent_and_recipe
from gridworld.config.settings import privileges
from gridworld.config.train import TrainConfig
from gridworld.run.checkpoints import Checkpoints, Pace
from gridworld.run.console import MOST_NAMED, Summary
from gridworld.run.folder import CURVE, EVENTS
from gridworld.run.provenance import environment, identity
from gridworld.run.writer import RunWriter, write_evaluations
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
from gridworld.training.setup import make_context
from gridworld.training.tensorboard import HOW_TO_READ, EventWriter, as_markdown, hparams
from gridworld.training.together import Training
from gridworld.world.evaluation import Evaluator
from gridworld.world.mdp import EXACT, Mdp
from gridworld.world.metrics import numbers, optimal_numbers

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
OnBuilt = Callable[[Agent], None]

_log = logging.getLogger("gridworld")


def ignore(agent: Agent) -> None:
    """No-op `OnBuilt`."""


class Session:
    """The training of one run, new or continued from a checkpoint's `state`; nothing is written before `run`.

    `is_trusted`: the environment that the settings name may be made, which runs its code. `on_built` takes
    the agent before it learns. A state that does not fit is a `StateError`.
    """

    def __init__(
        self,
        config: TrainConfig,
        folder: Path,
        mdp: Mdp,
        is_trusted: bool,
        state: State | None = None,
        on_built: OnBuilt = ignore,
    ) -> None:
        self._config, self._continued_from = config, state
        self._evaluator = Evaluator(mdp, config.evaluation.gamma, config.env.step_limit(mdp))
        self._events: EventWriter | None = None
        if config.logging.tensorboard:
            self._events = EventWriter(folder, None if state is None else state["marks"]["events"])
        self._origin = {"identity": identity(config, mdp.text()), "environment": environment(config.agent)}
        self._wandb: Any = None
        if config.logging.wandb:
            from gridworld.training.wandb_log import begin

            self._wandb = begin(config, [self._origin["identity"], folder.absolute()], state is not None)
        has_scalars = config.logging.tensorboard or config.logging.wandb
        self._write_scalars = partial(_write_scalars, self._events, self._wandb) if has_scalars else None
        context = make_context(config, mdp, self._write_scalars)
        self._agent: Agent = config.agent.build(context)
        on_built(self._agent)
        self._visits = context.envs.visits
        self._curve = LearningCurve(self._evaluator, self._agent, config, context.envs)
        self._pictures = Pictures(config, folder, self._evaluator, self._visits, self._events, is_trusted)
        self.reached, seconds = 0, 0.0  # environment steps; spent on them
        self.checkpoints = Checkpoints(folder)
        if state is not None:
            with fitting():
                self._curve.set_state(state["curve"])
                self._pictures.set_state(state["pictures"])
                self.reached, seconds = int(state["steps"]), float(state["seconds"])
            self.checkpoints.newest = self.reached
        self._pace = Pace(self._checkpoint_every(), self.reached)
        self._stop = StopRequest()
        self._started = clock() - seconds

    def _checkpoint_every(self) -> int | str | None:
        every = self._config.checkpoint.every
        if every is not None and (unknown := self._agent.class_without_state()) is not None:
            tell(f"no checkpoints, since {unknown} does not define get_state and set_state")
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
                yield Learning(
                    self._agent,
                    self._config.total_timesteps,
                    self._on_step,
                    None if self._pace.never else self._on_safe_point,
                    None if self._continued_from is None else self._continued_from["agent"],
                )
                self._stop.patient = False
                self._stop.obey()
                summary = self._finish()
            succeeded = True
        finally:
            self._close(succeeded)
        return summary

    def _open(self, run: RunWriter) -> None:
        """Open the curve's file, cut back to the state, and the rest that takes evaluations."""
        config, state = self._config, self._continued_from
        self._run = run
        self._curve_log = AppendLog(run.curve_file, None if state is None else state["marks"]["curve"])
        label = f"{config.agent.name} on {self._evaluator.mdp.name}"
        self._progress = Progress(config.total_timesteps, label, config.logging.progress)
        self._curve.sinks.append(partial(write_row, self._curve_log))
        if self._write_scalars is not None:
            self._curve.sinks.append(CurveScalars(self._write_scalars, self._evaluator).write)
        self._curve.sinks += [partial(show_progress, self._progress), self._pictures.write]

    def _begin(self) -> None:
        if self._continued_from is not None:
            self._curve.write_held_of_shorter_run()
            return
        if self._events is not None:
            self._events.hparams(hparams(self._config))
            self._events.charts("greedy and sampled policy with the optimum", CHARTS)
            self._events.text("run/how_to_read", HOW_TO_READ, 0)
            self._events.text("run/command", f"    {shlex.join(self._run.manifest['command'])}", 0)
            self._events.text("run/settings", as_markdown(dataclasses.asdict(self._config)), 0)
        self._curve.evaluate(0)

    def _on_step(self, steps: int) -> int:
        self.reached = steps
        if self._pace.never:  # else a safe point will come
            self._stop.obey()
        return self._curve.on_step(steps)

    def _on_safe_point(self, steps: int) -> None:
        """Save if it is time for it; nothing is half done here."""
        asked = self._stop.number is not None  # a later signal waits for the next safe point
        is_last = steps >= self._config.total_timesteps
        if (asked or is_last or self._pace.is_due(steps)) and steps != self.checkpoints.newest:
            started = time.perf_counter()
            try:
                self._save(steps, is_last)
            except OSError as error:
                _log.warning("%s: no checkpoint after step %s, %s", self._run.folder, steps, error.strerror)
            self._pace.took(steps, time.perf_counter() - started)
        if asked:
            self._stop.obey()

    def _save(self, steps: int, is_last: bool) -> None:
        # A short run is over before a disk has anything, and waits for it at its end only (see `_settle`).
        durable = not is_last or self.checkpoints.newest is not None
        if durable:
            self._curve_log.sync()
            if self._events is not None:
                self._events.log.sync()
            self._run.settle()
        self.checkpoints.save(steps, self._state(steps), durable, small=is_last)

    def _state(self, steps: int) -> State:
        return {
            "format": FORMAT,
            **self._origin,
            "steps": steps,
            "total_timesteps": self._config.total_timesteps,
            "seconds": clock() - self._started,
            "agent": self._agent.get_state(),
            "curve": self._curve.get_state(),
            "pictures": self._pictures.get_state(),
            "marks": {
                "curve": self._curve_log.mark(),
                "events": None if self._events is None else self._events.log.mark(),
            },
        }

    def _finish(self) -> Summary:
        seconds, run = clock() - self._started, self._run
        last = self._curve.evaluate(self.reached)
        write_bytes(run.model_file, self._agent.model_file())
        write_bytes(run.best_model_file, self._curve.best.content)
        self._write_evaluations()
        write_bytes(run.visits_file, npy_bytes(self._visits))
        summary = summarise(self._config, self._curve, last, seconds)
        write_json(run.summary_file, _as_json(summary))
        if self._events is not None:
            timeless = {key: value for key, value in summary.items() if key not in CLOCK}
            self._events.text("run/summary", as_markdown(timeless), last.step)
        with ThreadPoolExecutor(1) as disk:  # pictures are drawn while it is waited for
            settling = disk.submit(self._settle)
            self._pictures.finish(last)
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
        if self._curve.newest is not None:
            write_evaluations(self._run.evaluations_file, read_curve(self._curve_log))

    def _close(self, succeeded: bool) -> None:
        """Close what is open; after a failure, which is on its way up, without a word of further ones."""
        closing: list[Callable[[], None]] = [] if succeeded else [self._write_evaluations]
        closing += [self._curve_log.close, self._progress.close]
        if self._events is not None:
            events = self._events
            closing += [partial(events.end_session, succeeded), lambda: events.log.sync(), events.close]
        if self._wandb is not None:
            closing.append(partial(self._wandb.finish, int(not succeeded)))
        ignored = () if succeeded else (OSError, InputError)
        with contextlib.suppress(*ignored), contextlib.ExitStack() as stack:
            for close in reversed(closing):  # all of them, whatever one raises
                stack.callback(close)


def _write_scalars(events: EventWriter | None, wandb: Any, values: Mapping[str, float], step: int) -> None:
    # Not a method: the agent keeps it, and the session the agent, which would be a circle.
    if events is not None:
        events.scalars(values, step)
    if wandb is not None:
        wandb.log({**values, "step": step})


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
