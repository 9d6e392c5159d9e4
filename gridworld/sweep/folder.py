"""A sweep's folder.

sweep.json      what was asked for, by which versions, and the jobs: folder, hash, overrides
jobs.csv        how each job stands; see table.py
agent=dqn,seed=0/   a job's folder, an ordinary run's
.lock           held by the process that runs the sweep; one in each job's folder, by the job's process
"""

from __future__ import annotations

import contextlib
import json
import os
import shlex
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from gridworld.errors import InputError
from gridworld.files import make_folder, tidy, write_json
from gridworld.lock import locked
from gridworld.provenance import versions
from gridworld.recovery import is_begun, manifest_of
from gridworld.run import LOCK, MANIFEST, SWEEP_JSON, check_writable
from gridworld.sweep.plan import Job, folder_name, settings_hash
from gridworld.terminal import printable

STOP = ".stop"  # in the sweep's folder: no more jobs are to begin, wherever they wait
_FORMAT = 1


@dataclass(frozen=True)
class Entry:
    """A job as sweep.json has it."""

    job: str  # its folder
    hash: str
    overrides: tuple[str, ...]


class SweepFolder:
    """The folder and what sweep.json says. Raises `InputError` where it cannot be a sweep's."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.entries: dict[str, Entry] = {}  # by hash, in the order they were asked for
        self.damage: str | None = None  # of sweep.json; the jobs' folders tell what was in it
        self._manifest: dict[str, Any] = {}
        if (path / MANIFEST).exists():
            raise InputError(f"{path}: is the folder of a single run; choose another hydra.sweep.dir")
        if (path / SWEEP_JSON).exists():
            self._load(path / SWEEP_JSON)
        elif used := next(iter(sorted(path.glob(f"*/{MANIFEST}"))), None):
            raise InputError(
                f"{path}: has no {SWEEP_JSON}, but {used.parent} holds a run already; "
                "choose another hydra.sweep.dir"
            )

    def check(self, jobs: Sequence[Job], extend: bool) -> None:
        """Raise `InputError` if the folder cannot be written, or is of another sweep."""
        check_writable(self.path, "hydra.sweep.dir")
        if self.entries and not extend and not any(job.hash in self.entries for job in jobs):
            asked = self._manifest["asked"][-1]["overrides"] if self._manifest else []
            raise InputError(
                f"{self.path}: holds the sweep '{shlex.join(asked)}', which has no job in common with this "
                "one; choose another hydra.sweep.dir, or add hydra.sweeper.extend=true to put both into one"
            )

    @contextlib.contextmanager
    def at_work(self) -> Iterator[None]:
        """Make the folder, and keep other sweeps out of it. Raises `InputError` if one is there."""
        try:
            make_folder(self.path)
        except OSError as error:
            raise InputError(
                f"{self.path}: cannot be made ({error.strerror}); choose another hydra.sweep.dir"
            ) from None
        with locked(self.path / LOCK, wait=1) as is_ours:
            if not is_ours:
                raise InputError(f"{self.path}: another process runs this sweep; wait for it or stop it")
            (self.path / STOP).unlink(missing_ok=True)
            tidy(self.path)
            if self.damage is not None:
                print(printable(f"{self.damage}; written again from the jobs' folders"), file=sys.stderr)
            yield

    def add(self, jobs: Sequence[Job], words: Sequence[str]) -> list[Entry]:
        """Note what is asked for; returns the jobs' entries, new ones with a folder of their own."""
        taken = {entry.job.lower() for entry in self.entries.values()}
        taken |= {folder.name.lower() for folder in self._runs()}  # whosever they are
        lines = [e.overrides for e in self.entries.values()] + [job.overrides for job in jobs]
        common = set(lines[0]).intersection(*lines)
        for job in jobs:
            if job.hash not in self.entries:
                name = folder_name(job, taken, common)
                taken.add(name.lower())
                self.entries[job.hash] = Entry(name, job.hash, job.overrides)
        self._save(words)
        return [self.entries[job.hash] for job in jobs]

    def _save(self, words: Sequence[str]) -> None:
        asked = self._manifest.get("asked", [])
        if not any(earlier["overrides"] == list(words) for earlier in asked):
            now = datetime.now(UTC).isoformat(timespec="seconds")
            command = [Path(sys.argv[0]).name, *sys.argv[1:]]
            asked = [*asked, {"at": now, "overrides": list(words), "command": command}]
        self._manifest = {
            "format": _FORMAT,
            "asked": asked,
            "versions": versions(),
            "jobs": [
                {"job": entry.job, "hash": entry.hash, "overrides": list(entry.overrides)}
                for entry in self.entries.values()
            ],
        }
        write_json(self.path / SWEEP_JSON, self._manifest, durable=True)

    def _load(self, file: Path) -> None:
        try:
            content = json.loads(file.read_text("utf-8"))
        except ValueError as error:  # it is empty or cut, as a power cut leaves it
            self.damage = f"{file}: damaged ({error})"
            self.entries = self._entries_of_runs()
            return
        except OSError as error:
            raise InputError(f"{file}: cannot be read ({error.strerror})") from None
        try:
            known = content["format"]
            self.entries = {
                item["hash"]: Entry(_plain_name(item["job"]), str(item["hash"]), tuple(item["overrides"]))
                for item in content["jobs"]
            }
            if not content["asked"]:
                raise ValueError("nothing was asked for")
            for earlier in content["asked"]:
                shlex.join(earlier["overrides"])
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            raise InputError(
                f"{file}: damaged ({type(error).__name__}: {error}); put back a good copy, or choose "
                "another hydra.sweep.dir"
            ) from None
        if known != _FORMAT:
            raise InputError(f"{file}: has format {known}, this version reads {_FORMAT}")
        self._manifest = content

    def _runs(self) -> list[Path]:
        """The folders in which a run began."""
        files = sorted(self.path.glob(f"*/{MANIFEST}"))
        return [file.parent for file in files if file.stat().st_size or is_begun(file.parent)]

    def _entries_of_runs(self) -> dict[str, Entry]:
        """The jobs that have begun, as their own folders have it, in that order."""
        found = []
        for folder in self._runs():
            with contextlib.suppress(InputError, LookupError, TypeError, AttributeError):
                manifest = manifest_of(folder)
                digest = settings_hash(manifest["config"], "\n".join(manifest["layout"]))
                entry = Entry(folder.name, digest, tuple(map(str, manifest["overrides"])))
                found.append((str(manifest["started"]), entry))
        return {entry.hash: entry for _, entry in sorted(found, key=lambda pair: pair[0])}


def open_sweep(path: Path) -> SweepFolder:
    """A sweep's folder, to look at. Raises `InputError` where there is none."""
    if not (path / SWEEP_JSON).is_file():
        reason = f"not a sweep's folder, it has no {SWEEP_JSON}" if path.exists() else "no such folder"
        raise InputError(f"{path}: {reason}; give the folder of a sweep, e.g. one in runs/")
    folder = SweepFolder(path)
    if folder.damage is not None:
        raise InputError(f"{folder.damage}; the sweep's own command writes it again")
    return folder


def _plain_name(name: str) -> str:
    """A folder's name that leads nowhere else."""
    if name in ("", ".", "..") or os.sep in name or "\n" in name:
        raise ValueError(f"{name!r} is no job's folder")
    return name
