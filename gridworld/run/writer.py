"""Writing a run's folder: the manifest, and the order in which files become durable."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from gridworld.errors import InputError
from gridworld.process.console.command_line import recorded_command_line
from gridworld.process.parallel.together import mixed
from gridworld.run import provenance
from gridworld.run.folder import CHECKED, CHECKPOINTS, OUTPUTS, RunFolder
from gridworld.run.manifest import NUMBERS_DEPEND_ON
from gridworld.run.provenance import describe, source_differences
from gridworld.run.reader import LARGEST_RESULT, RunReader
from gridworld.storage.atomic_write import (
    remove_path,
    replacing,
    sync,
    sync_folder,
    tidy,
    write_bytes,
    write_json,
)
from gridworld.storage.safe_read import check_no_link, file_sha256
from gridworld.storage.sealed_json import sealed
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
        cls,
        folder: Path,
        config: dict[str, Any],
        world: Mdp,
        overrides: list[str],
        replace: bool = False,
    ) -> Self:
        """Write the manifest of a new run.

        A new run loses nothing by a power cut before its first checkpoint, so its manifest is durable only
        from then on (see `settle`); where it replaces another run, from the start.

        Args:
            folder: the run's folder, which exists.
            config: the resolved settings.
            world: the compiled world, which the manifest or the folder keeps.
            overrides: the settings given on the command line.
            replace: remove what the folder has of an earlier run; without it, a run there is refused.
        """
        content = {
            "status": "running",
            "started": _now(),
            "ended": None,
            "command": recorded_command_line(),
            "overrides": overrides,
            "seed": config["seed"],
            "threads": config["threads"],
            **_mixed_runs(),
            **describe(),
            "layout": world.text().split("\n"),
            "config": config,
        }
        run = cls(folder, content)
        if not replace and run.manifest_file.exists():
            raise InputError(f"{folder}: holds a run already; give every run a folder of its own")
        (clear if replace else _remove_partial_files)(folder)
        if not isinstance(world, GridMdp):
            write_bytes(run.world_file, world_bytes(world), durable=replace)
        run._write(durable=replace)
        run._keep_diff(content["git"])
        return run

    @classmethod
    def resume(cls, earlier: RunReader, step: int, total_timesteps: int, differs: list[str]) -> Self:
        """Write the manifest of a run that is resumed from a checkpoint.

        Args:
            earlier: the run as its folder has it.
            step: environment steps at the checkpoint.
            total_timesteps: the run's length from here on.
            differs: how the environment differs from the one that the run was started in.
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
        if self._is_settled and not files:
            return
        own = [] if self._is_settled else [self.manifest_file, self.world_file]
        own += [] if self._is_settled else self.folder.glob("source*.diff")
        sync([*own, *files], self.folder)
        if not self._is_settled:
            sync_folder(self.folder.parent)
        self._is_settled = True

    @property
    def manifest(self) -> Mapping[str, Any]:
        """The manifest's content, as it is now."""
        return self._manifest

    def end(self, status: str, error: str | None = None, **progress: int | None) -> None:
        """Record how the run ended.

        Args:
            status: "finished", "interrupted" or "failed". The results of a finished run are durable already:
                see `settle`.
            error: why it did not finish.
            progress: environment steps `reached`, and those at the newest `checkpoint`.
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

    SB3 has a column per sampled episode. An exact evaluation has one number, the expectation, so there is one
    column, whose mean is exact and whose standard deviation is 0.

    Args:
        path: the file.
        curve: (n,) by name, those of `NEEDED`: they become `timesteps` (n,) and, (n, 1) each, `results`,
            which are not discounted, `ep_lengths` and `successes`, the probability of the goal.
        more: other arrays to put beside them.
    """
    named: dict[str, Any] = {
        **more,
        "timesteps": curve["step"].astype(np.int64),
        "results": curve["return"][:, None],
        "ep_lengths": curve["length"][:, None],
        "successes": curve["goal_probability"][:, None],
    }
    with replacing(path) as part, part.open("wb") as file:  # given a path, numpy would add .npz to it
        np.savez(file, **named)


def _remove_partial_files(folder: Path) -> None:
    check_no_link(folder / CHECKPOINTS)  # what it leads to is not the run's
    for each in (folder, folder / CHECKPOINTS):
        tidy(each)


def _mixed_runs() -> dict[str, Any]:
    return {NUMBERS_DEPEND_ON: dict(mixed())} if mixed() else {}


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="milliseconds")
