"""Writing a run's folder: the manifest, the log, and the order in which files become durable."""

from __future__ import annotations

import contextlib
import logging
import os
import warnings
from collections.abc import Mapping
from contextvars import ContextVar
from datetime import UTC, datetime
from logging.handlers import MemoryHandler
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from gridworld.base.atomic_write import remove_path, sync, sync_folder, tidy, write_bytes, write_json
from gridworld.base.console import TOLD, plain, recorded_command_line
from gridworld.base.errors import InputError
from gridworld.base.safe_read import check_no_link, file_sha256, sealed
from gridworld.base.together import mixed
from gridworld.base.user_input import npz_bytes, users_folder
from gridworld.run import provenance
from gridworld.run.folder import CHECKED, CHECKPOINTS, OUTPUTS, RunFolder
from gridworld.run.provenance import describe, source_differences
from gridworld.run.reader import LARGEST_RESULT, NUMBERS_DEPEND_ON, RunReader
from gridworld.world.grid import GridMdp
from gridworld.world.mdp import Mdp
from gridworld.world.sources.arrays import world_bytes

NEEDED = ("step", "return", "length", "goal_probability")  # columns of a learning curve


class RunWriter(RunFolder):
    """A run in progress, in a folder that this process holds. `start` or `resume` one."""

    def __init__(self, folder: Path, manifest: dict[str, Any]) -> None:
        super().__init__(folder)
        self._manifest = manifest
        self._is_settled = False

    @classmethod
    def start(
        cls, folder: Path, config: dict[str, Any], world: Mdp, overrides: list[str], replace: bool = False
    ) -> Self:
        """Write the manifest of a new run, with its resolved settings, its world and its command line.

        A new run loses nothing by a power cut before its first checkpoint, so its manifest is durable only
        from then on (see `settle`); where it is to `replace` another run in the folder, from the start.
        """
        content = {
            "status": "running",
            "started": _now(),
            "ended": None,
            "command": recorded_command_line(),
            "overrides": overrides,
            "called_from": os.path.relpath(os.path.realpath(users_folder()), os.path.realpath(folder)),
            "seed": config["seed"],
            "threads": config["threads"],
            **_mixed_runs(),
            **describe(),
            "layout": world.text().split("\n"),
            "config": config,
        }
        run = cls(folder, content)
        if not replace and run.manifest_file.exists():
            raise InputError(f"{folder}: contains a run already; choose another folder")
        (clear if replace else _remove_partial_files)(folder)
        if not isinstance(world, GridMdp):
            write_bytes(run.world_file, world_bytes(world), durable=replace)
        run._write(durable=replace)
        run._keep_diff(content["git"])
        return run

    @classmethod
    def resume(cls, earlier: RunReader, step: int, total_timesteps: int, differs: list[str]) -> Self:
        """Write the manifest of a run that is resumed from the checkpoint after `step` environment steps.

        `total_timesteps` is its length from here on; `differs`, how its environment differs from the one that
        it was started in.
        """
        again: dict[str, Any] = {"at": _now(), "step": step, "command": recorded_command_line()}
        again |= _mixed_runs()
        if differs:
            again["differs"] = differs
        tree = provenance.git(f"source-{step}.diff")
        is_other_tree = any(source_differences(earlier.git, tree))
        if is_other_tree:
            again["git"] = tree
        content = earlier.manifest | {"status": "running", "ended": None}
        if total_timesteps != (old := content["config"]["total_timesteps"]):
            again |= {"total_timesteps": total_timesteps, "instead_of": old}
            content["config"] = content["config"] | {"total_timesteps": total_timesteps}
        content["resumed"] = [*earlier.resumptions, again]
        content.pop("error", None)
        run = cls(earlier.folder, content)
        run.error_file.unlink(missing_ok=True)
        _remove_partial_files(run.folder)
        if is_other_tree:
            run._keep_diff(tree, durable=True)
        run._write()
        return run

    def settle(self, *files: Path) -> None:
        """Make the manifest, then these files, and all names in the folder survive a power cut."""
        if not self._is_settled:
            files = (self.manifest_file, self.world_file, *self.folder.glob("source*.diff"), *files)
            sync_folder(self.folder.parent)
        if files:
            sync(files, self.folder)
        self._is_settled = True

    @property
    def manifest(self) -> Mapping[str, Any]:
        """The manifest's content, as it is now."""
        return self._manifest

    def end(self, status: str, error: str | None = None, **progress: int | None) -> None:
        """Record that the run "finished", which has its results settled, or was "interrupted", or "failed".

        `error` says why; `progress`, environment steps `reached`, and those at the newest `checkpoint`.
        """
        self._manifest |= {"status": status, "ended": _now(), **progress}
        if error is not None:
            self._manifest["error"] = error
        if status == "finished":
            there = [path for name in CHECKED if (path := self.folder / name).exists()]
            self._manifest["sha256"] = {path.name: file_sha256(path, LARGEST_RESULT) for path in there}
        self._write()

    def _keep_diff(self, git: dict[str, Any] | None, durable: bool = False) -> None:
        """Write what was changed since the commit to the file that the manifest names for it."""
        tree, name = provenance.source(), ((git or {}).get("diff") or {}).get("file")
        if tree is not None and name is not None:
            write_bytes(self.folder / name, tree.diff, durable)

    def _write(self, durable: bool = True) -> None:
        self._manifest = sealed(self._manifest)
        write_json(self.manifest_file, self._manifest, durable)


def record_failure(run: RunReader, why: str) -> None:
    """Record in the manifest why a run failed whose own process could not do so."""
    content = run.manifest | {"status": "failed", "error": why}
    write_json(run.manifest_file, sealed(content), durable=True)


def clear(folder: Path) -> None:
    """Remove all that a run wrote to its folder, except the manifest. Other files stay."""
    _remove_partial_files(folder)
    for pattern in OUTPUTS:
        for path in folder.glob(pattern):
            remove_path(path)


def write_evaluations(path: Path, curve: Mapping[str, NDArray[Any]], **more: NDArray[Any]) -> None:
    """Write a learning curve as SB3's `EvalCallback` does, for the scripts that plot its `evaluations.npz`.

    SB3 has a column per sampled episode. Here is one, of expectations, which is exact. `curve` has (n,) by
    name, those of `NEEDED`; the returns are not discounted.
    """
    columns = {
        **more,
        "timesteps": curve["step"].astype(np.int64),
        "results": curve["return"][:, None],
        "ep_lengths": curve["length"][:, None],
        "successes": curve["goal_probability"][:, None],
    }
    write_bytes(path, npz_bytes(columns))


def _remove_partial_files(folder: Path) -> None:
    check_no_link(folder / CHECKPOINTS)  # what it leads to is not the run's
    for each in (folder, folder / CHECKPOINTS):
        tidy(each)


def _mixed_runs() -> dict[str, Any]:
    return {NUMBERS_DEPEND_ON: dict(mixed())} if mixed() else {}


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="milliseconds")


class TrainLog:
    """`train.log`: warnings, Python's and logged ones, and what is told on standard error in its block.

    The lines are kept until there is a file. What goes to the terminal is the same as without it. Of runs
    that train together, each has its own, which takes what comes while its run is at work.
    """

    _all: ClassVar[list[TrainLog]] = []  # inside whose blocks the process is

    def __init__(self) -> None:
        self._handler = MemoryHandler(1)  # keeps everything until it has a target
        self._handler.addFilter(self._takes)

    def __enter__(self) -> Self:
        if logging.lastResort is not None and not logging.getLogger().handlers:
            logging.getLogger().addHandler(logging.lastResort)  # which prints only where there is no other
        for logger in (logging.getLogger(), TOLD):
            logger.addHandler(self._handler)
        with warnings.catch_warnings():  # forgets what was warned about before, in another run
            pass
        logging.captureWarnings(True)
        self._all.append(self)
        self._token = _current.set(self)
        return self

    def __exit__(self, *error: object) -> None:
        _current.reset(self._token)
        self._all.remove(self)
        for logger in (logging.getLogger(), TOLD):
            logger.removeHandler(self._handler)
        if not self._all:
            logging.captureWarnings(False)
            if logging.lastResort is not None:
                logging.getLogger().removeHandler(logging.lastResort)
        if self._handler.target is not None:
            self._handler.target.close()

    def open(self, path: Path) -> None:
        """Append to a file from here on, beginning with what was kept."""
        with contextlib.suppress(OSError):  # which are told elsewhere
            if path.is_symlink() or not path.is_file():
                remove_path(path)
            file = logging.FileHandler(path, encoding="utf-8", errors="backslashreplace")
            file.setFormatter(_Lines())
            file.handleError = lambda record: None  # type: ignore[method-assign]
            self._handler.setTarget(file)
            self._handler.flush()

    def add(self, text: str, level: int = logging.INFO) -> None:
        """Append a line."""
        self._handler.emit(TOLD.makeRecord(TOLD.name, level, "", 0, text, (), None))

    def _takes(self, record: logging.LogRecord) -> bool:
        """Whether a record is for this run's log."""
        # In a thread, the log of the only run is meant, if there is one only.
        at_work = _current.get() or (self._all[0] if len(self._all) == 1 else None)
        return at_work is self and (record.name == TOLD.name or record.levelno >= logging.WARNING)


class _Lines(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        now = datetime.now(UTC).isoformat(timespec="seconds")
        return f"{now} {record.levelname} {plain(record.getMessage().strip())}"


_current: ContextVar[TrainLog | None] = ContextVar("current", default=None)  # of the run that is at work
