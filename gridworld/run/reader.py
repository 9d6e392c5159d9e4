"""Reading a run's folder: its manifest, its world, and the files with its result, verified.

`read_run` reads a run whatever its status, `open_run` a finished one, `find_run` one that there may be. The
manifest's seal and the types of its entries are checked.
"""

from __future__ import annotations

import csv
import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any

from gridworld.base.console import printable
from gridworld.base.errors import InputError
from gridworld.base.safe_read import (
    LARGEST_CSV,
    LARGEST_JSON,
    as_object,
    as_table,
    check_no_link,
    file_sha256,
    read_bytes,
    read_sealed,
    sha256,
)
from gridworld.base.user_input import COPIES
from gridworld.config.worlds import EnvConfig, MapConfig
from gridworld.run.folder import (
    CHECKED,
    CHECKPOINTS,
    MANIFEST,
    PICTURES,
    SWEEP_JSON,
    RunFolder,
    check_writable,
)

if TYPE_CHECKING:
    from gridworld.world.mdp import FloatArray, Mdp

REQUIRED = ("step", "value", "regret", "certified", "goal_probability", "return")  # columns of a curve
ONLINE = "online_return"  # undiscounted, of training episodes (`training.learning_curve`); may be empty
_MOST_COLUMNS = 100
LARGEST_RESULT = 2**30  # bytes of a file
# Runs that were updated at once, this one among them, so that the numbers of each depend on all: a hash of
# the settings of each (`provenance.settings_hash`) by its folder's name, in their order.
NUMBERS_DEPEND_ON = "numbers_depend_on"
_KINDS = {MANIFEST: "run", SWEEP_JSON: "sweep"}  # of folders


class RunReader(RunFolder):
    """A run that another process wrote: its folder, and the content of its manifest."""

    def __init__(self, folder: Path, manifest: dict[str, Any]) -> None:
        super().__init__(folder)
        self.manifest = manifest

    @property
    def is_finished(self) -> bool:
        """Whether the run came to its end."""
        return bool(self.manifest["status"] == "finished")

    @property
    def resumptions(self) -> list[dict[str, Any]]:
        """What the manifest says of each time that the run was resumed."""
        found: list[dict[str, Any]] = self.manifest.get("resumed", [])
        return found

    @property
    def git(self) -> Any:
        """The source tree of the last attempt, as `provenance.git` describes it."""
        attempts = [self.manifest, *self.resumptions]
        return next((attempt["git"] for attempt in reversed(attempts) if "git" in attempt), None)

    def read(self, path: Path, most: int, copies: int = 1) -> bytes:
        """Read one of the run's files of at most `most` bytes, of which `copies` will be in memory.

        Raises `InputError` for another file than the run wrote; without being finished, it has no checksums.
        """
        content = read_bytes(path, most, copies)
        if self.is_finished:
            self._check(path, sha256(content))
        return content

    def read_summary(self) -> dict[str, Any]:
        """What the run reached, as summary.json has it, verified as by `read` and checked by `_RESULT`."""
        content = as_object(self.read(self.summary_file, LARGEST_JSON), self.summary_file)
        for key, (kind, what) in _RESULT.items():
            value = content.get(key)
            is_below_zero = kind in (int, int | None) and type(value) is int and value < 0
            if key not in content or not _is(kind, value) or not str(value).strip() or is_below_zero:
                raise InputError(
                    f"{self.summary_file}: {key}={value!r} must be {what}; was it written by another version?"
                )
        return content

    def verify(self, path: Path) -> None:
        """Compare a file's checksum with the manifest's; an `InputError` where it is another file."""
        self._check(path, file_sha256(path, LARGEST_RESULT))

    def damage(self) -> dict[str, str]:
        """By name, a sentence for each file of a finished run that is missing, unreadable or another."""
        found = {}
        for name in CHECKED:
            try:
                if name in self.manifest.get("sha256", {}):
                    self.verify(self.folder / name)
            except InputError as error:
                found[name] = str(error)
        return found

    def pictures(self) -> dict[str, str]:
        """The checksum of each picture that the run drew."""
        sums = self.manifest.get("sha256", {})
        return {name: sums[name] for name in PICTURES if name in sums}

    def _check(self, path: Path, digest: str) -> None:
        noted = self.manifest.get("sha256", {}).get(path.name)
        if noted is None:
            raise InputError(
                f"{self.manifest_file}: has no checksum (sha256) of {path.name}; was the run written by "
                "another version, or the file added later?"
            )
        if digest != noted:
            raise InputError(
                f"{path}: is not the file that the run wrote: its checksum differs from {MANIFEST}; it was "
                "damaged or changed"
            )


def open_run(folder: Path) -> RunReader:
    """Read a finished run."""
    run = read_run(folder)
    if not run.is_finished:
        what = f"this run is {run.manifest['status']!r}, not finished; resume it with  {run.resume_command()}"
        raise InputError(f"{folder}: {what}")
    return run


def read_run(folder: Path) -> RunReader:
    """Read a run, finished or not."""
    check_is(folder)
    return RunReader(folder, _read_manifest(folder / MANIFEST))


def find_run(folder: Path) -> RunReader | None:
    """Read the run in a folder, if one has started there."""
    return read_run(folder) if is_started(folder) else None


def is_started(folder: Path) -> bool:
    """Whether a folder holds a run: a manifest, or beside an empty one a result.

    A power cut may leave a manifest empty before anything of the run was saved.
    """
    run = RunFolder(folder)
    try:
        is_empty = not read_bytes(run.manifest_file, LARGEST_JSON).strip(b"\0")
    except InputError:
        return os.path.lexists(run.manifest_file)
    results = (run.summary_file, run.model_file)
    return not is_empty or any(path.exists() and path.stat().st_size for path in results)


def check_is_folder(path: Path, of: str) -> None:
    """Check that there is a folder; it is to be that `of` something."""
    if not os.path.isdir(path):  # whatever its length
        key, _, value = str(path).partition("=")
        wanted = f"leave out {key}=" if value and os.path.isdir(value) else f"give the folder of {of}"
        raise InputError(f"{path}: {'is a file' if os.path.exists(path) else 'no such folder'}; {wanted}")


def check_is(folder: Path, file: str = MANIFEST) -> None:
    """Check that a folder is a run's, or of the file `SWEEP_JSON` a sweep's, whatever is in it."""
    kind = _KINDS[file]
    check_is_folder(folder, f"a {kind}")
    if not os.path.lexists(folder / file):
        others = [f"is a {kind}'s folder, not" for each, kind in _KINDS.items() if (folder / each).exists()]
        what = f"{others[0]} a {kind}'s" if others else f"not a {kind}'s folder, it has no {file}"
        found = sorted(path.parent for path in folder.glob(f"*/{file}"))
        raise InputError(f"{folder}: {what}" + (f"; give a {kind}'s, e.g. {found[0]}" if found else ""))


def check_free(folder: Path, key: str = "hydra.run.dir", may_be_finished: bool = False) -> None:
    """Refuse a folder that cannot be written, or holds a finished run, a sweep or other runs.

    An unfinished run in it is accepted here: whether it is the same one is checked with the settings.
    """
    try:
        is_finished = read_run(folder).is_finished and not may_be_finished
    except InputError:  # there is none, or its manifest is damaged
        is_finished = False
    if is_finished:
        longer = f", or make that run longer with {RunFolder(folder).resume_command()} total_timesteps=..."
        can_be_longer = any(folder.glob(f"{CHECKPOINTS}/*"))
        raise InputError(
            f"{folder}: contains a run already; choose another folder{longer if can_be_longer else ''}"
        )
    if (folder / SWEEP_JSON).exists():
        raise InputError(f"{folder}: is the folder of a sweep; choose another {key}")
    if used := next(folder.glob(f"*/{MANIFEST}"), None):
        raise InputError(f"{folder}: contains other runs, such as {used.parent}; name a new folder in it")
    check_no_link(folder / CHECKPOINTS)
    check_writable(folder, key)


def stored_world(run: RunReader, env: EnvConfig) -> Mdp:
    """The world that a run keeps, a map in its manifest or tables in its folder, whatever its settings say.

    `env` are its settings of the world, whose name a map gets.
    """
    from gridworld.world.layout import parse  # here, since most commands need no world
    from gridworld.world.sources.arrays import world_from_bytes

    text = "\n".join(run.manifest["layout"])
    if isinstance(env, MapConfig):
        layout = parse(text, f"{run.manifest_file}: layout")
        return env.compile(dataclasses.replace(layout, name=env.layout))
    is_noted = run.world_file.name in run.manifest.get("sha256", {})  # not of an unfinished run
    content = (run.read if is_noted else read_bytes)(run.world_file, LARGEST_RESULT, COPIES)
    mdp = world_from_bytes(content, str(run.world_file))
    if mdp.text() != text:
        raise InputError(
            f"{run.world_file}: is not the world that {MANIFEST} names; it was damaged or changed"
        )
    return mdp


def _read_manifest(path: Path) -> dict[str, Any]:
    content = read_sealed(path)
    if not content.keys() >= {"status", "config", "layout"}:
        raise InputError(f"{path}: not the manifest of a run; it lacks status, config or layout")
    for key, (kind, what) in _ENTRIES.items():
        if key in content and not _is(kind, content[key]):
            raise InputError(f"{path}: {key} must be {what}")
    return content


def _is(kind: Any, value: Any) -> bool:
    """Whether a value is of a type, or a list of one; `{}` is texts by the names of files."""
    if isinstance(kind, list):
        return isinstance(value, list) and all(_is(kind[0], each) for each in value)
    if kind == _RESUMPTION:
        return isinstance(value, dict) and ("total_timesteps" not in value or type(value.get("step")) is int)
    if kind == {}:
        return isinstance(value, dict) and all(
            isinstance(text, str) and name.isprintable() and PurePath(name).name == name not in ("", "..")
            for name, text in value.items()
        )
    return isinstance(value, kind) and (kind is bool or not isinstance(value, bool))


_RESUMPTION = "resumption"
_COUNT = (int | None, "a number of steps")
_ENTRIES: dict[str, tuple[Any, str]] = {
    "status": (str, "a word"),
    "config": (dict, "the run's settings; was it written by another version?"),
    "layout": ([str], "a list of the map's rows; was it written by another version?"),
    "started": (str, "a date"),
    "ended": (str | None, "a date"),
    "error": (str, "a sentence"),
    "command": ([str], "the words of a command line"),
    "overrides": ([str], "words of a command line"),
    "called_from": (str, "a path from the run's folder"),
    "sha256": ({}, "a checksum for each file"),
    "resumed": ([_RESUMPTION], "a list of resumptions, with their steps"),
    NUMBERS_DEPEND_ON: ({}, "a hash for each run, by the name of its folder"),
    "reached": _COUNT,
    "checkpoint": _COUNT,
    "versions": (dict, "a version for each package"),
}
_RESULT: dict[str, tuple[Any, str]] = {  # the entries of summary.json that are read again
    "agent": (str, "a name"),
    "env": (str, "a name"),
    "seed": (int, "a whole number"),
    "gamma": (int | float, "a number"),
    "timesteps": (int, "a number of steps"),
    "best_step": (int, "a number of steps"),
    "certified": (bool, "true or false"),
    "first_certified_step": _COUNT,
    "certified_since_step": _COUNT,
    "regret": (int | float | None, "a number"),
    "optimal_value": (int | float, "a number"),
    "train_seconds": (int | float, "a number"),
}


def read_columns(run: RunReader, wanted: Sequence[str] | None = None) -> dict[str, FloatArray]:
    """Read columns (evaluations,) of the learning curve as the run wrote them, NaN where a field is empty.

    `wanted` are names of columns, which the file need not have; None: all that it has. Raises `InputError`
    where the file is missing, too large, cut off, or holds what no run writes.
    """
    import numpy as np  # here, since `train.py --help` does not need it

    path = run.curve_file
    lines = as_table(run.read(path, LARGEST_CSV), path).splitlines()
    if lines and lines[0].count(",") >= _MOST_COLUMNS:
        raise InputError(f"{path}: has more than {_MOST_COLUMNS} columns; was it written by another version?")
    try:
        header, *rows = list(csv.reader(lines)) or [[]]
    except csv.Error as error:
        raise InputError(f"{path}: is not valid CSV ({error})") from None
    if not rows:
        raise InputError(f"{path}: has no rows")
    if missing := [name for name in REQUIRED if name not in header]:
        raise InputError(f"{path}: has no column {', '.join(missing)}; was it written by another version?")
    for line, row in enumerate(rows, 2):
        if len(row) != len(header):
            raise InputError(f"{path}: line {line} has {len(row)} of {len(header)} columns; it was cut off")
    curve: dict[str, FloatArray] = {}
    for name in header if wanted is None else wanted:
        if name not in header:
            continue
        at = header.index(name)
        try:
            curve[name] = np.array([row[at] or "nan" for row in rows], dtype=np.float64)
        except ValueError as error:
            raise InputError(f"{path}: {name}: {printable(str(error))}") from None
        if name != ONLINE and np.isnan(curve[name]).any():
            raise InputError(f"{path}: {name} is NaN or empty; the run diverged or the file was changed")
    steps = curve["step"]
    if steps[0] != 0 or not np.isfinite(steps).all() or (np.diff(steps) <= 0).any():
        raise InputError(f"{path}: the steps do not increase from 0, row by row")
    if not np.isin(curve["certified"], (0, 1)).all():
        raise InputError(f"{path}: certified must be 0 or 1 in every row")
    return curve
