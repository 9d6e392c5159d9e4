"""A run's folder: the names of its files, and having it for this process alone.

    manifest.json   what ran, with which versions and settings, from when to when, and how it ended
    source.diff     what was changed in the source tree since its commit, where anything was; and
                    source-STEP.diff, where it was another when the run was resumed after STEP steps
    curve.csv       the learning curve, a row per evaluation
    summary.json    the result
    model.zip       the trained model; best_model.zip: that of the lowest exact regret, the first of equals
    evaluations.npz the learning curve's exact returns and lengths, as SB3's EvalCallback writes sampled ones
    world.npz       the world's tables, where it is not a map (`gridworld.world.sources.arrays`)
    visits.npy      how often training took each action in each state, (S, A)
    policy.png, q_error.png, visits.png, learning.gif   what was learned, how well, where, and how
    frames/, episode.gif, ...   the final policy's episode
    train.log       when it began and ended, and what was warned about
    error.txt       the traceback, where a bug ended it
    checkpoints/    the states from which the run can be resumed (`gridworld.run.checkpoints`)
    .hydra/         the configuration as Hydra composed it
    events.out...   TensorBoard's event file

The manifest is enough to build the world and the agent again: it holds the resolved settings and the map's
text, or of another world the digest of the tables beside it. Of a finished run it also has the checksums of
the files that hold its result, its world and its pictures. It is sealed. `run.writer` writes these files,
`run.reader` reads and verifies them.
"""

from __future__ import annotations

import contextlib
import os
import shlex
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from gridworld.base.atomic_write import inside, locked, make_folder, remove_path, tidy
from gridworld.base.console import command, printable
from gridworld.base.errors import InputError
from gridworld.base.user_input import users_folder
from gridworld.config import train as schema
from gridworld.config.fields import Use
from gridworld.config.settings import foreign

MANIFEST = "manifest.json"
SOURCE_DIFF = "source.diff"
CURVE = "curve.csv"
SUMMARY = "summary.json"
MODEL = "model.zip"
VISITS = "visits.npy"
WORLD = "world.npz"
BEST_MODEL = "best_model.zip"  # these two as SB3's EvalCallback names them
EVALUATIONS = "evaluations.npz"
RESULTS = (CURVE, SUMMARY, MODEL, BEST_MODEL, VISITS, EVALUATIONS)
# those of one file
PICTURES = tuple(each.file for each in schema.PICTURES.values() if Path(each.file).suffix)
CHECKED = (*RESULTS, WORLD, *PICTURES)  # what has a checksum in the manifest of a finished run
CHECKPOINTS = "checkpoints"
EVENTS = "events.out.tfevents.*"
TRAIN_LOG = "train.log"
ERROR_FILE = "error.txt"  # the traceback of an unforeseen error
HYDRA = ".hydra"
LOCK = ".lock"  # held by the process that works in the folder
SWEEP_JSON = "sweep.json"  # a sweep's folder has this instead of a manifest

# Patterns of all that training writes, except the manifest.
OUTPUTS = (
    *(*RESULTS, WORLD, *(each.file for each in schema.PICTURES.values())),
    *(CHECKPOINTS, TRAIN_LOG, ERROR_FILE, EVENTS, "source*.diff"),
)


class RunFolder:
    """The paths of a run's files; its folder need not exist."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.manifest_file = folder / MANIFEST
        self.curve_file = folder / CURVE
        self.summary_file = folder / SUMMARY
        self.model_file = folder / MODEL
        self.best_model_file = folder / BEST_MODEL
        self.log_file = folder / TRAIN_LOG
        self.error_file = folder / ERROR_FILE
        self.visits_file = folder / VISITS
        self.evaluations_file = folder / EVALUATIONS
        self.world_file = folder / WORLD

    def results(self) -> tuple[Path, ...]:
        """The paths of the files that hold the result."""
        return tuple(self.folder / name for name in RESULTS)

    def resume_command(self, trusted: Mapping[str, Any] | None = None) -> str:
        """The command line that resumes the run; for settings that the user has `trusted`, it says so."""
        trust = " trust=true" if any(foreign(trusted or {}, Use.RESUME)) else ""
        place = Path(os.path.normpath(users_folder() / self.folder))  # `resume` refuses ../runs/mine
        return f"{command('train')} resume={shell_path(place)}{trust}"


def shown(folder: Path) -> str:
    """The folder as a user would type it where the command was called, printable."""
    try:
        return printable(str(folder.relative_to(users_folder())))
    except ValueError:
        return printable(str(folder))


def shell_path(folder: Path) -> str:
    """The same, quoted where a shell needs it."""
    return shlex.quote(shown(folder))


def check_inside(path: Path, key: str) -> None:
    """Refuse the root, and a relative path that leads out of the current folder; `key` is its option."""
    if os.path.realpath(path) == os.sep:
        where = f"{key}={path}: is the root of the file system"
        raise InputError(f"{where}; name a folder in it, e.g. /home/me/run")
    normal = os.path.normpath(path)
    if os.path.isabs(normal) or normal.split(os.sep)[0] not in (os.curdir, os.pardir):
        return
    if normal == os.curdir:
        raise InputError(f"{key}={path}: is the current folder; name one in it, e.g. runs/mine")
    raise InputError(
        f"{key}={path}: leads out of the current folder; if you mean that, write {os.path.abspath(path)}"
    )


def check_writable(folder: Path, key: str) -> None:
    """Refuse a folder that cannot be made, where there is none, or written to."""
    existing = next(path for path in (folder, *folder.parents) if path.exists())
    if not existing.is_dir():
        raise InputError(f"{folder}: cannot be made, {existing} is a file; choose another {key}")
    if not os.access(existing, os.W_OK | os.X_OK):
        raise InputError(f"{folder}: cannot be written, {existing} is read-only; choose another {key}")


def check_file(path: Path, key: str) -> None:
    """Refuse a file whose folder is not there or cannot be written to, or whose place something else has."""
    if not path.absolute().parent.is_dir():
        raise InputError(f"{key} {path}: no such folder {path.parent}")
    if path.is_dir():
        raise InputError(f"{key} {path}: is a folder; name a file in it")
    if path.is_symlink() or (path.exists() and not path.is_file()):
        raise InputError(f"{key} {path}: is not a plain file; choose another")
    check_writable(path.absolute().parent, key)


@contextlib.contextmanager
def alone_in(folder: Path, wait: float = 0) -> Iterator[None]:
    """Hold a folder for this process, and remove what one that died has left half written.

    Raises `InputError` if another process still holds it after `wait` seconds.
    """
    with locked(folder / LOCK, wait) as is_ours:
        if not is_ours:
            raise InputError(f"{shown(folder)}: another process is using it; wait for it or stop it")
        tidy(folder)
        yield


@contextlib.contextmanager
def claimed(folder: Path, begun: str = MANIFEST, alone: bool = True) -> Iterator[None]:
    """Make a folder and hold it for this process; afterwards, undo that unless it has the file `begun`.

    Where others may work in it too, it is not `alone`. An `OSError` of the block names the folder, if it
    names nothing.
    """
    is_first = not folder.parent.exists()
    make_folder(folder.parent)
    folder.mkdir(exist_ok=True)
    with alone_in(folder) if alone else contextlib.nullcontext():
        try:
            yield
        except OSError as error:
            error.filename = error.filename or shown(folder)  # a failed write names no file
            raise
        finally:
            with contextlib.suppress(OSError):
                if not (folder / begun).exists():
                    tidy(folder)
                    if begun == MANIFEST:  # what Hydra wrote for a run that never started
                        remove_path(inside(folder, HYDRA))
                    (folder / LOCK).unlink(missing_ok=True)
                    folder.rmdir()
                    if is_first:
                        folder.parent.rmdir()
