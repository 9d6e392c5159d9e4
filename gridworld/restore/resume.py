"""Resuming a run that was interrupted, and making a finished one longer.

A run's folder is data: its settings are read against the schema, and its state as arrays. A run is resumed
from its newest checkpoint that is valid and whose files are as they were, after these are cut back to where
they ended then; without one it is started again. Either way it ends as if it had not been interrupted, since
a run depends on nothing but its settings and its environment, and both are compared first.
"""

from __future__ import annotations

import dataclasses
import math
import os
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from gridworld.config.agents import AgentConfig, falls, parse_schedule
from gridworld.config.plain_settings import foreign
from gridworld.config.settings import flat
from gridworld.config.train import TrainConfig
from gridworld.config.worlds import BuiltConfig, EnvConfig, GymnasiumConfig, MapConfig
from gridworld.errors import InputError
from gridworld.process.console.progress import telling_if_slow
from gridworld.process.console.terminal import printable, tell
from gridworld.restore.saved_run import settings_of
from gridworld.run.checkpoints import MOST_STEPS, Checkpoints, steps_of
from gridworld.run.folder import CHECKPOINTS, CURVE, MANIFEST
from gridworld.run.identity.fingerprint import environment, identity, settings
from gridworld.run.identity.provenance import git, source_differences
from gridworld.run.identity.stored_world import stored_world
from gridworld.run.reader import RunReader
from gridworld.run.recovery import is_started, run_to_resume
from gridworld.run.summary import Summary
from gridworld.run.train_log import TrainLog
from gridworld.run.writer import RunWriter
from gridworld.storage.append_log import holds
from gridworld.storage.safe_read import open_ordinary
from gridworld.storage.serialization import State, StateError
from gridworld.training.session import CONTENT, FORMAT, LOGS
from gridworld.training.setup import check_settings
from gridworld.training.sinks import CURVE_COLUMNS
from gridworld.training.together import Training, run_alone
from gridworld.training.train import OnBuilt, carry_out, ignore, training
from gridworld.world.mdp import Mdp

_LONGEST_HEADER = 2**12  # bytes


def train_or_resume(
    config: TrainConfig, folder: Path, overrides: list[str], on_built: OnBuilt = ignore
) -> Summary:
    """Train in a folder, or resume the unfinished run of the same settings that it holds.

    Args:
        config: The settings.
        folder: The run's folder, which this process holds.
        overrides: The settings given on the command line, for the manifest.
        on_built: Takes the agent before it learns.

    Raises:
        InputError: The folder holds another run, or a setting is wrong.
        Interrupted: Training was asked to stop.
    """
    return run_alone(training_or_resumption(config, folder, overrides, on_built))


def training_or_resumption(
    config: TrainConfig, folder: Path, overrides: list[str], on_built: OnBuilt = ignore
) -> Training[Summary]:
    """The same as a generator, for `run_together`."""
    if is_started(folder):
        return (yield from unfinished_of(folder, config).resumption(on_built=on_built))
    is_empty = os.path.lexists(folder / MANIFEST)
    if is_empty:
        tell(f"{folder / MANIFEST}: is empty, and nothing of the run was saved; it begins anew")
    return (yield from training(config, folder, overrides, replace=is_empty, on_built=on_built))


def open_unfinished(folder: Path, trust: bool = False) -> Unfinished:
    """Read a run that is to be resumed.

    Args:
        folder: The run's folder.
        trust: Import the classes that its settings name, wherever they are from.
    """
    run = run_to_resume(folder)
    config = settings_of(run, trust, allow="trust=true")
    return Unfinished(run, config, stored_world(run, config.env), trust)


def unfinished_of(folder: Path, config: TrainConfig) -> Unfinished:
    """Read the unfinished run of these settings, to resume it with them."""
    unfinished = open_unfinished(folder, trust=True)  # its classes are those of `config`, or it is refused
    if unfinished.run.is_finished:
        raise InputError(f"{folder}: holds a run already; give every run a folder of its own")
    unfinished.check_same(config, check_settings(config).text())
    return dataclasses.replace(unfinished, config=config)


@dataclass(frozen=True, eq=False)
class Unfinished:
    """A run to resume: its folder, its settings and its world, and whether what these name may be run."""

    run: RunReader
    config: TrainConfig
    mdp: Mdp
    is_trusted: bool

    def check_same(self, config: TrainConfig, world: str) -> None:
        """Check that settings and a world's text are the run's own."""
        own, other = (
            dict(flat(settings(each) | {"total_timesteps": each.total_timesteps}))
            for each in (self.config, config)
        )
        differing = [
            f"{key}={other.get(key)} instead of {own.get(key)}"
            for key in dict.fromkeys([*own, *other])
            if own.get(key) != other.get(key)
        ]
        if not differing and world != self.mdp.text():
            differing = [f"the {_kind(config.env)} {config.env.name} has changed since"]
        if differing:
            more = f" and {len(differing) - 3} more" if len(differing) > 3 else ""
            raise InputError(
                f"{self.run.folder}: holds an unfinished run with other settings "
                f"({', '.join(differing[:3])}{more}); choose another folder, or go on with the old one by "
                f"{self.run.resume_command()}"
            )

    def resume(
        self,
        total_timesteps: int | None = None,
        anyway: bool = False,
        progress: bool = True,
        on_built: OnBuilt = ignore,
    ) -> Summary:
        """Train to the end.

        Args:
            total_timesteps: The run's length from here on, in environment steps; None: as it was.
            anyway: Accept an environment in which the last bits of the numbers may differ.
            progress: Show progress, where the run's settings do so.
            on_built: Takes the agent before it learns.

        Returns:
            The run's summary.

        Raises:
            InputError: The run cannot be resumed in this way.
            Interrupted: Training was asked to stop.
        """
        return run_alone(self.resumption(total_timesteps, anyway, progress, on_built))

    def resumption(
        self,
        total_timesteps: int | None = None,
        anyway: bool = False,
        progress: bool = True,
        on_built: OnBuilt = ignore,
    ) -> Training[Summary]:
        """The same as a generator, for `run_together`."""
        with TrainLog() as log:
            return (yield from self._resume(log, total_timesteps, anyway, progress, on_built))

    def _resume(
        self, log: TrainLog, total_timesteps: int | None, anyway: bool, progress: bool, on_built: OnBuilt
    ) -> Training[Summary]:
        run, old_total = self.run, self.config.total_timesteps
        if total_timesteps is None and run.is_finished and Checkpoints(run.folder).files():
            raise InputError(
                f"{run.folder}: is finished; to make it longer, say how long: {_resume_command(run)} "
                f"total_timesteps={2 * old_total}"
            )
        config = dataclasses.replace(
            self.config,
            total_timesteps=old_total if total_timesteps is None else total_timesteps,
            logging=dataclasses.replace(
                self.config.logging, progress=self.config.logging.progress and progress
            ),
        )
        mdp = check_settings(config, lambda env: self.mdp)
        self._tell_if_map_changed()
        with telling_if_slow(f"reading the checkpoints of {run.folder}"):
            state = _newest_state(run, identity(config, mdp.text()))
        if state is None:
            self._check_restart(config)
            start = partial(self._restart, config)
            return (
                yield from carry_out(config, run.folder, mdp, start, log, self.is_trusted, on_built=on_built)
            )
        differs = _differences(state["environment"], config.agent, run, anyway)
        steps = state["steps"]
        self._check_length(config, steps)
        self._tell_resumed(config, steps)
        Checkpoints(run.folder).forget_after(steps)

        def begin() -> RunWriter:
            return RunWriter.resume(run, steps, config.total_timesteps, differs)

        return (
            yield from carry_out(config, run.folder, mdp, begin, log, self.is_trusted, (run, state), on_built)
        )

    def _tell_if_map_changed(self) -> None:
        env = self.config.env
        if isinstance(env, BuiltConfig | GymnasiumConfig):  # which would run their code
            return
        if not self.is_trusted and any(foreign({"env": dataclasses.asdict(env)})):
            return
        try:
            changed = env.compile().text() != self.mdp.text()
        except InputError:
            changed = True
        if changed:
            tell(
                f"{self.run.folder}: its {_kind(env)} {env.name} has changed since; "
                "it goes on with the one that it began with"
            )

    def _check_restart(self, config: TrainConfig) -> None:
        """Refuse to replace a finished run by one that starts again; tell it of another."""
        if self.run.is_finished:
            raise InputError(
                f"{self.run.folder}: is finished, and {CHECKPOINTS}/ has no checkpoint that it could go on "
                f"from; for {config.total_timesteps:,} steps begin a new run in another folder"
            )
        if config.total_timesteps != self.config.total_timesteps or self.run.curve_file.exists():
            tell(f"{self.run.folder}: has no checkpoint yet; begins anew")

    def _restart(self, config: TrainConfig) -> RunWriter:
        overrides = self.run.manifest.get("overrides", [])
        content = dataclasses.asdict(config)
        return RunWriter.start(self.run.folder, content, self.mdp, overrides, replace=True)

    def _check_length(self, config: TrainConfig, steps: int) -> None:
        total, old_total = config.total_timesteps, self.config.total_timesteps
        is_shorter = total != old_total and total < steps
        if is_shorter or (self.run.is_finished and total <= old_total):
            raise InputError(
                f"total_timesteps={total}: {self.run.folder} has come to {steps:,} of {old_total:,} steps; "
                "it can be made longer, not shorter"
            )

    def _tell_resumed(self, config: TrainConfig, steps: int) -> None:
        folder, old_total = self.run.folder, self.config.total_timesteps
        tell(f"{folder}: goes on after {steps:,} of {config.total_timesteps:,} steps")
        if changes := list(source_differences(self.run.git, git())):
            tell(f"{folder}: the source tree is another, which is noted: {printable('; '.join(changes))}")
        if config.total_timesteps != old_total:
            tell(_what_changes(config, steps, old_total))


def _resume_command(run: RunReader) -> str:
    return run.resume_command(run.manifest["config"])  # which were read, so the user trusts them


def _kind(env: EnvConfig) -> str:
    return "map" if isinstance(env, MapConfig) else "world"


def _newest_state(run: RunReader, own: str) -> State | None:
    """The state to resume from; says why others are passed over. `own` is the run's identity."""
    lengthened = [again["step"] for again in run.resumptions if "total_timesteps" in again]
    for path, state in Checkpoints(run.folder).states():
        reason = _why_not(path, state, run.folder, own)
        if reason is None and lengthened and state["steps"] < lengthened[-1]:  # type: ignore[index]
            reason = f"it is from before the run was made longer, after {lengthened[-1]:,} steps"
        if reason is None:
            assert isinstance(state, dict)
            return state
        tell(f"{path}: passed over, {reason}")
    if lengthened:
        raise InputError(
            f"{run.folder}: was made longer after {lengthened[-1]:,} steps and has no checkpoint left from "
            "then on; begun anew it would end otherwise: start a new run"
        )
    return None


def _why_not(path: Path, state: State | StateError, folder: Path, own: str) -> str | None:
    """Why a run cannot be resumed from a checkpoint's state; None: it can."""
    if isinstance(state, StateError):
        return str(state)
    if state.get("format") != FORMAT:
        return "another version of gridworld wrote it"
    kinds = {"manifest": str} | {key: type(value) for key, value in state.items()}
    if kinds != CONTENT or state["marks"].keys() != LOGS.keys():
        return "it lacks what a checkpoint has"
    if state["identity"] != own:
        return "it is of another run"
    if steps_of(path) != state["steps"] or not 0 < state["steps"] <= MOST_STEPS:
        return "it is not of as many steps as its name says, or of more than a run can have"
    if not math.isfinite(state["seconds"]):
        return "it took no number of seconds"
    for name, mark in state["marks"].items():
        if not holds(folder, mark, LOGS[name]) and not (name == "events" and mark is None):
            return f"the file of the {name} is not what it was then"
    if _columns(folder / CURVE) != CURVE_COLUMNS:
        return "the curve has other columns than this version of gridworld writes"
    return None


def _columns(curve: Path) -> tuple[str, ...]:
    with open_ordinary(curve) as file:
        return tuple(file.readline(_LONGEST_HEADER).decode(errors="replace").rstrip("\n").split(","))


def _differences(then: dict[str, Any], agent: AgentConfig, run: RunReader, anyway: bool) -> list[str]:
    """How the environment differs from the run's; refused if it does, unless `anyway`."""
    now = environment(agent)
    keys = [key for key in {**then, **now} if then.get(key) != now.get(key)]
    differs = [f"{key} {then.get(key)} is now {now.get(key)}" for key in keys]
    if differs and not anyway:
        raise InputError(
            f"{run.folder}: was begun in another environment ({'; '.join(differs)}), where numbers may "
            f"come out otherwise; go on there, or by {_resume_command(run)} anyway=true, which notes it in "
            "the manifest"
        )
    return differs


def _what_changes(config: TrainConfig, steps: int, old_total: int) -> str:
    """What a new length does to the settings that are scheduled over training."""
    before, after = (
        _schedules(config, min(steps / total, 1)) for total in (old_total, config.total_timesteps)
    )
    parts = [f"{name} {before[name]:.4g} -> {after[name]:.4g}" for name in before]
    what = (
        f"from here on as in a run of that length: {', '.join(parts)}"
        if parts
        else "no setting depends on that"
    )
    return f"{config.total_timesteps:,} steps instead of {old_total:,}: {what}"


def _schedules(config: TrainConfig, progress: float) -> dict[str, float]:
    agent = getattr(config.agent, "arguments", None) or vars(config.agent)
    found = {key: parse_schedule(key, value).at(progress) for key, value in agent.items() if falls(value)}
    fraction = agent.get("exploration_fraction")
    if fraction:
        start, end = agent.get("exploration_initial_eps", 1.0), agent.get("exploration_final_eps", 0.05)
        found["exploration rate"] = start + (end - start) * min(progress / fraction, 1.0)
    return found
