"""Resuming a run that was interrupted, and making a finished one longer.

A run's folder is data: its settings are read against the schema, and its state as arrays. A run is resumed
from its newest checkpoint that is valid and whose files are as they were, after these are cut back to where
they ended then; without one it is started again. Either way it ends as if it had not been interrupted, since
a run depends on nothing but its settings and its environment, and both are compared first.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from gridworld.base.atomic_write import holds
from gridworld.base.bounds import falls
from gridworld.base.console import printable, tell, telling_if_slow
from gridworld.base.errors import InputError
from gridworld.base.safe_read import open_ordinary
from gridworld.base.serialization import State, StateError
from gridworld.config.fields import Use
from gridworld.config.settings import flat, foreign
from gridworld.config.train import TrainConfig
from gridworld.config.worlds import MapConfig, World, compiled
from gridworld.run.checkpoints import Checkpoints, steps_of
from gridworld.run.console import Summary
from gridworld.run.folder import CHECKPOINTS, CURVE
from gridworld.run.provenance import environment, git, identity, settings, source_differences
from gridworld.run.reader import RunReader, read_run, stored_world
from gridworld.run.writer import RunWriter
from gridworld.training.learning_curve import CURVE_COLUMNS
from gridworld.training.saved_run import settings_of
from gridworld.training.session import CONTENT, FORMAT, LOGS
from gridworld.training.setup import check_settings
from gridworld.training.together import Training, alone
from gridworld.training.train import Beginning, OnBuilt, training
from gridworld.world.mdp import Mdp

_LONGEST_HEADER = 2**12  # bytes
_NAMED = 3  # settings that differ


def open_unfinished(folder: Path, trust: bool = False) -> Unfinished:
    """Read a run that is to be resumed; `trust` imports its settings' classes, wherever they are from."""
    run = read_run(folder)
    config = settings_of(run, trust, Use.RESUME, "trust=true")
    return Unfinished(run, config, stored_world(run, config.env), trust)


def unfinished_of(
    folder: Path, config: TrainConfig, world: World = compiled, trust: bool = True
) -> Unfinished:
    """Read the run of these settings in a folder, to resume it with them; refused if its own differ."""
    unfinished = open_unfinished(folder, trust)  # its classes are those of `config`, or it is refused
    own, given = (
        dict(flat(settings(each) | {"total_timesteps": each.total_timesteps}))
        for each in (unfinished.config, config)
    )
    keys = [key for key in dict.fromkeys([*own, *given]) if own.get(key) != given.get(key)]
    differing = [f"{key}={given.get(key)} instead of {own.get(key)}" for key in keys]
    if check_settings(config, world).text() != unfinished.mdp.text() and not differing:
        differing = [f"the world {config.env.name} has changed"]
    if differing:
        if unfinished.run.is_finished:
            raise InputError(f"{folder}: contains a run already; choose another folder")
        more = f" and {len(differing) - _NAMED} more" if len(differing) > _NAMED else ""
        raise InputError(
            f"{folder}: contains an unfinished run with other settings "
            f"({', '.join(differing[:_NAMED])}{more}); choose another folder, or resume the old one with "
            f"{unfinished.run.resume_command()}"
        )
    return dataclasses.replace(unfinished, config=config)


@dataclass(frozen=True, eq=False)
class Unfinished:
    """A run to resume: its folder, its settings and its world, and whether what these name may be run."""

    run: RunReader
    config: TrainConfig
    mdp: Mdp
    is_trusted: bool

    def resumption(
        self,
        total_timesteps: int | None = None,
        anyway: bool = False,
        progress: bool = True,
        on_built: OnBuilt = None,
    ) -> Training[Summary]:
        """Train to the end, which `total_timesteps` may set anew.

        `anyway` accepts an environment in which the last bits of the numbers may differ; progress is shown
        where the run's settings do so, too; `on_built` takes the agent before it learns.
        """
        folder, old_total = self.run.folder, self.config.total_timesteps
        total = old_total if total_timesteps is None else total_timesteps
        logging = self.config.logging
        config = dataclasses.replace(
            self.config,
            total_timesteps=total,
            logging=dataclasses.replace(logging, progress=logging.progress and progress),
        )
        if total_timesteps is None and self.run.is_finished and Checkpoints(folder).files():
            raise InputError(
                f"{folder}: is finished; to make it longer:  {_resume_command(self.run)} "
                f"total_timesteps={2 * old_total}"
            )
        continued = partial(self._beginning, anyway)
        return training(config, folder, [], lambda env: self.mdp, on_built, self.is_trusted, continued)

    resume = alone(resumption)

    def _beginning(self, anyway: bool, config: TrainConfig, mdp: Mdp) -> Beginning:
        """The newest checkpoint's state, checked, and what writes the manifest; tells what differs."""
        self._tell_if_map_changed()
        with telling_if_slow(f"reading the checkpoints of {self.run.folder}"):
            state = _newest_state(self.run, identity(config, mdp.text()))
        again = partial(self._restart, config)
        return state, again if state is None else self._continue(config, state, anyway)

    def _restart(self, config: TrainConfig) -> RunWriter:
        """Start again, which a finished run is too good for."""
        if self.run.is_finished:
            raise InputError(
                f"{self.run.folder}: is finished, but {CHECKPOINTS}/ has no checkpoint to continue from; "
                f"start a new run of {config.total_timesteps:,} steps in another folder"
            )
        if config.total_timesteps != self.config.total_timesteps or self.run.curve_file.exists():
            tell(f"{self.run.folder}: has no checkpoint yet; it starts over")
        overrides = self.run.manifest.get("overrides", [])
        return RunWriter.start(self.run.folder, dataclasses.asdict(config), self.mdp, overrides, replace=True)

    def _continue(self, config: TrainConfig, state: State, anyway: bool) -> Callable[[], RunWriter]:
        """Check that a state may be continued from, and tell what differs; what is returned does so."""
        run, folder, steps = self.run, self.run.folder, state["steps"]
        total, old_total = config.total_timesteps, self.config.total_timesteps
        then, now = state["environment"], environment(config.agent)
        keys = [key for key in {**then, **now} if then.get(key) != now.get(key)]
        differs = [f"{key} {then.get(key)} is now {now.get(key)}" for key in keys]
        if differs and not anyway:
            raise InputError(
                f"{folder}: was started in another environment ({'; '.join(differs)}), so numbers may "
                f"differ; resume it there, or anyway with {_resume_command(run)} anyway=true"
            )
        if (total != old_total and total < steps) or (run.is_finished and total <= old_total):
            raise InputError(
                f"total_timesteps={total}: {folder} has done {steps:,} of {old_total:,} steps; it can be "
                "made longer, not shorter"
            )
        tell(f"{folder}: resumes after {steps:,} of {total:,} steps")
        if changes := list(source_differences(run.git, git())):
            tell(
                f"{folder}: the source code has changed, as its manifest will say:  "
                f"{printable('; '.join(changes))}"
            )
        if total != old_total:
            agent = flat(dataclasses.asdict(config.agent))
            scheduled = [key for key, value in agent if falls(value) or (value and key.endswith("_fraction"))]
            spread = f"; as in a run of that length: {', '.join(scheduled)}" if scheduled else ""
            tell(f"{folder}: {total:,} steps instead of {old_total:,}{spread}")

        def begin() -> RunWriter:
            Checkpoints(folder).forget_after(steps)
            return RunWriter.resume(run, steps, total, differs)

        return begin

    def _tell_if_map_changed(self) -> None:
        env = self.config.env
        is_foreign = not self.is_trusted and any(foreign({"env": dataclasses.asdict(env)}))
        if is_foreign or not isinstance(env, MapConfig):  # a stranger's may be any file
            return
        try:
            changed = env.compile().text() != self.mdp.text()
        except InputError:
            changed = True
        if changed:
            tell(
                f"{self.run.folder}: its world {env.name} has changed; the run continues with its original "
                "world"
            )


def _resume_command(run: RunReader) -> str:
    return run.resume_command(run.manifest["config"])  # which were read, so the user trusts them


def _newest_state(run: RunReader, own: str) -> State | None:
    """The state to resume from; says why others are passed over. `own` is the run's identity."""
    lengthened = [again["step"] for again in run.resumptions if "total_timesteps" in again]
    for path, state in Checkpoints(run.folder).states():
        reason = _why_not(path, state, run.folder, own)
        if reason is None and lengthened and state["steps"] < lengthened[-1]:  # type: ignore[index]
            reason = f"it is older than the lengthening after {lengthened[-1]:,} steps"
        if reason is None:
            assert isinstance(state, dict)
            return state
        tell(f"{path}: skipped, {reason}")
    if lengthened:
        raise InputError(
            f"{run.folder}: was made longer after {lengthened[-1]:,} steps and has no checkpoint left from "
            "then on, so it cannot be resumed exactly; start a new run"
        )
    return None


def _why_not(path: Path, state: State | StateError, folder: Path, own: str) -> str | None:
    """Why a run cannot be resumed from a checkpoint's state; None: it can."""
    if isinstance(state, StateError):
        return str(state)
    if state.get("format") != FORMAT:
        return "it was written by another version of gridworld"
    if {key: type(value) for key, value in state.items()} != CONTENT or state["marks"].keys() != LOGS.keys():
        return "parts of a checkpoint are missing"
    if state["identity"] != own:
        return "it belongs to another run"
    if not 0 < state["steps"] == steps_of(path) or not math.isfinite(state["seconds"]):
        return "its number of steps differs from its name, or its training time is impossible"
    for name, mark in state["marks"].items():
        if not holds(folder, mark, LOGS[name]) and not (name == "events" and mark is None):
            return f"the file of the {name} has changed since"
    with open_ordinary(folder / CURVE) as file:
        header = file.readline(_LONGEST_HEADER).decode(errors="replace").rstrip("\n")
    if tuple(header.split(",")) != CURVE_COLUMNS:
        return "the curve's columns differ from this version's"
    return None
