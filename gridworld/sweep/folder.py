"""A sweep's folder: which jobs it has, and the lock of the process that runs the sweep.

sweep.json      what was asked for, by which versions, and the jobs: folder, hash, overrides
jobs.csv        how each job stands; see job_table.py
agent=dqn,seed=0/   a job's folder, an ordinary run's
.lock           held by the process that runs the sweep; one in each job's folder, by the job's process
"""

from __future__ import annotations

import contextlib
import os
import re
import shlex
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from gridworld.errors import InputError
from gridworld.process.console.command_line import recorded_command_line
from gridworld.process.console.terminal import printable
from gridworld.run.claim import check_writable
from gridworld.run.folder import HYDRA, LOCK, MANIFEST, SWEEP_JSON
from gridworld.run.provenance import settings_hash, versions
from gridworld.run.reader import find_run, is_started
from gridworld.storage.atomic_write import check_no_links, make_folder, tidy, write_json
from gridworld.storage.file_lock import locked
from gridworld.storage.safe_read import LARGEST_JSON, read_bytes
from gridworld.storage.sealed_json import read_sealed, sealed
from gridworld.sweep.plan import Job, folder_name

STOP = ".stop"  # in the sweep's folder: no more jobs begin, wherever they wait
_JOB = re.compile(r"[\w=+,-][\w.,=+-]*", re.ASCII)  # as `folder_name` makes them: no other folder


@dataclass(frozen=True)
class JobEntry:
    """A job as sweep.json has it: its folder's name, its hash, its overrides."""

    job: str
    hash: str
    overrides: tuple[str, ...]


class SweepFolder:
    """A sweep's folder, by its sweep.json. Raises `InputError` where it cannot be a sweep's."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.entries: dict[str, JobEntry] = {}  # by hash, in the order they were asked for
        self.damage: str | None = None  # of sweep.json; the jobs' folders tell what was in it
        self._manifest: dict[str, Any] = {}
        if (path / MANIFEST).exists():
            raise InputError(f"{path}: is the folder of a single run; choose another hydra.sweep.dir")
        if os.path.lexists(path / SWEEP_JSON):
            self._load(path / SWEEP_JSON)
        elif used := next(iter(sorted(path.glob(f"*/{MANIFEST}"))), None):
            raise InputError(
                f"{path}: has no {SWEEP_JSON}, but {used.parent} holds a run already; "
                "choose another hydra.sweep.dir"
            )

    def check(self, jobs: Sequence[Job], extend: bool) -> None:
        """Raise `InputError` if the folder cannot be written, or is another sweep's and not to `extend`."""
        check_writable(self.path, "hydra.sweep.dir")
        for job in jobs:
            if job.hash in self.entries:  # others get a folder of their own
                self._check_no_links(self.entries[job.hash].job)
        if self.entries and not extend and not any(job.hash in self.entries for job in jobs):
            asked = self._manifest["asked"][-1]["overrides"] if self._manifest else []
            raise InputError(
                f"{self.path}: holds the sweep '{shlex.join(asked)}', which has no job in common with this "
                "one; choose another hydra.sweep.dir, or add hydra.sweeper.extend=true to put both into one"
            )

    def _check_no_links(self, job: str) -> None:
        """Hydra writes files before the job begins, and would write them through links."""
        for names in ((job,), (job, HYDRA)):
            check_no_links(self.path, *names)

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

    def add(self, jobs: Sequence[Job], words: Sequence[str]) -> list[JobEntry]:
        """Write to sweep.json what is asked for.

        Args:
            jobs: the jobs.
            words: the command line's overrides.

        Returns:
            The jobs' entries; a new job has a folder's name of its own.
        """
        taken = {entry.job.lower() for entry in self.entries.values()}
        taken |= {folder.name.lower() for folder in self._runs()}  # also those of no job
        taken |= {path.name.lower() for path in self.path.iterdir() if path.is_symlink()}
        lines = [e.overrides for e in self.entries.values()] + [job.overrides for job in jobs]
        common = set(lines[0]).intersection(*lines)
        for job in jobs:
            if job.hash not in self.entries:
                name = folder_name(job, taken, common)
                taken.add(name.lower())
                self.entries[job.hash] = JobEntry(name, job.hash, job.overrides)
        self._save(words)
        return [self.entries[job.hash] for job in jobs]

    def _save(self, words: Sequence[str]) -> None:
        asked = self._manifest.get("asked", [])
        if not any(earlier["overrides"] == list(words) for earlier in asked):
            now = datetime.now(UTC).isoformat(timespec="seconds")
            asked = [*asked, {"at": now, "overrides": list(words), "command": recorded_command_line()}]
        content = {
            "asked": asked,
            "versions": versions(),
            "jobs": [
                {"job": entry.job, "hash": entry.hash, "overrides": list(entry.overrides)}
                for entry in self.entries.values()
            ],
        }
        self._manifest = sealed(content)
        write_json(self.path / SWEEP_JSON, self._manifest, durable=True)

    def _load(self, file: Path) -> None:
        if _is_cut_off(file):  # as a power cut leaves it
            self.damage = f"{file}: is empty or cut off"
            self.entries = self._entries_of_runs()
            return
        try:
            content = read_sealed(file)
            asked, entries = content.get("asked"), [_entry(item) for item in _objects(content.get("jobs"))]
            if not asked:
                raise ValueError("nothing was asked for")
            for earlier in _objects(asked):
                _words(earlier.get("overrides"))
        except ValueError as error:  # ours is one
            told = str(error).removeprefix(f"{file}: ")
            raise InputError(
                f"{file}: damaged ({told}); put back a good copy, or choose another hydra.sweep.dir"
            ) from None
        self.entries = {entry.hash: entry for entry in entries}
        if not len(entries) == len(self.entries) == len({entry.job.lower() for entry in entries}):
            raise InputError(f"{file}: damaged (two jobs have one folder, or one hash)")
        self._manifest = content

    def _runs(self) -> list[Path]:
        """The folders in which a run began."""
        files = sorted(self.path.glob(f"*/{MANIFEST}"))
        return [file.parent for file in files if file.stat().st_size or is_started(file.parent)]

    def _entries_of_runs(self) -> dict[str, JobEntry]:
        """The jobs that have begun, as their own folders have it, in that order."""
        found = []
        for folder in self._runs():
            with contextlib.suppress(InputError, LookupError):
                run = find_run(folder)
                if run is not None:
                    digest = settings_hash(run.manifest["config"], "\n".join(run.manifest["layout"]))
                    entry = JobEntry(folder.name, digest, tuple(run.manifest["overrides"]))
                    found.append((run.manifest["started"], entry))
        return {entry.hash: entry for _, entry in sorted(found, key=lambda pair: pair[0])}


def _is_cut_off(file: Path) -> bool:
    """Whether a file of JSON has lost its end, or all of it."""
    with contextlib.suppress(InputError):
        content = read_bytes(file, LARGEST_JSON).strip(b"\0 \n")
        return not content or (content.startswith(b"{") and not content.endswith(b"}"))
    return False


def open_sweep(path: Path) -> SweepFolder:
    """A sweep's folder, for reading. Raises `InputError` where there is none, or sweep.json is damaged."""
    if not os.path.lexists(path / SWEEP_JSON):
        reason = f"not a sweep's folder, it has no {SWEEP_JSON}" if path.exists() else "no such folder"
        raise InputError(f"{path}: {reason}; give the folder of a sweep, e.g. one in runs/")
    folder = SweepFolder(path)
    if folder.damage is not None:
        raise InputError(f"{folder.damage}; the sweep's own command writes it again")
    return folder


def _entry(item: dict[str, Any]) -> JobEntry:
    job, digest = item.get("job"), item.get("hash")
    if not (isinstance(job, str) and _JOB.fullmatch(job)):
        raise ValueError(f"{str(job)[:80]!r} is no job's folder")
    if not isinstance(digest, str):
        raise ValueError("a job has no hash")
    return JobEntry(job, digest, _words(item.get("overrides")))


def _objects(value: Any) -> list[dict[str, Any]]:
    if not (isinstance(value, list) and all(isinstance(each, dict) for each in value)):
        raise ValueError("it has no list of jobs, or of what was asked for")
    return value


def _words(value: Any) -> tuple[str, ...]:
    if not (isinstance(value, list) and all(isinstance(each, str) for each in value)):
        raise ValueError("overrides must be what stands on a command line")
    return tuple(value)
