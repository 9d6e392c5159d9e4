"""A sweep's folder: which jobs it has, and the lock of the process that runs the sweep.

sweep.json      what was asked for, by which versions, and the jobs: folder, hash, overrides
jobs.csv        how each job stands; see job_table.py
agent=dqn,seed=0/   a job's folder, an ordinary run's
.lock           held by the process that runs the sweep; one in each job's folder, by the job's process
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import re
import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from gridworld.errors import InputError
from gridworld.process.console import recorded_command_line
from gridworld.run.folder import HYDRA, LOCK, MANIFEST, SWEEP_JSON, check_writable
from gridworld.run.provenance import versions
from gridworld.storage.atomic_write import check_no_links, locked, make_folder, tidy, write_json
from gridworld.storage.safe_read import read_sealed, sealed
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
        self._asked: list[dict[str, Any]] = []  # command lines
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
                for names in ((), (HYDRA,)):
                    check_no_links(self.path, self.entries[job.hash].job, *names)
        if self.entries and not extend and not any(job.hash in self.entries for job in jobs):
            asked = shlex.join(self._asked[-1]["overrides"])
            raise InputError(
                f"{self.path}: holds the sweep '{asked}', which has no job in common with this one; choose "
                "another hydra.sweep.dir, or add hydra.sweeper.extend=true to put both into one"
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
            yield

    def add(self, jobs: Sequence[Job], words: Sequence[str]) -> list[JobEntry]:
        """Write to sweep.json what is asked for by the overrides `words`."""
        taken = {entry.job.lower() for entry in self.entries.values()}
        # Also the folders of no job.
        taken |= {file.parent.name.lower() for file in self.path.glob(f"*/{MANIFEST}")}
        taken |= {path.name.lower() for path in self.path.iterdir() if path.is_symlink()}
        lines = [e.overrides for e in self.entries.values()] + [job.overrides for job in jobs]
        common = set(lines[0]).intersection(*lines)
        for job in jobs:
            if job.hash not in self.entries:
                name = folder_name(job, taken, common)
                taken.add(name.lower())
                self.entries[job.hash] = JobEntry(name, job.hash, job.overrides)
        if not any(earlier["overrides"] == list(words) for earlier in self._asked):
            now = datetime.now(UTC).isoformat(timespec="seconds")
            command = recorded_command_line()
            self._asked.append({"at": now, "overrides": list(words), "command": command})
        jobs_json = [dataclasses.asdict(entry) for entry in self.entries.values()]
        content = {"asked": self._asked, "versions": versions(), "jobs": jobs_json}
        write_json(self.path / SWEEP_JSON, sealed(content), durable=True)
        return [self.entries[job.hash] for job in jobs]

    def _load(self, file: Path) -> None:
        try:
            content = read_sealed(file)
            self._asked = list(content["asked"])
            _ = self._asked[-1], [_words(earlier["overrides"]) for earlier in self._asked]
            for item in content["jobs"]:
                job, digest = item["job"], item["hash"]
                if not (isinstance(job, str) and _JOB.fullmatch(job) and isinstance(digest, str)):
                    raise ValueError(f"{str(job)[:80]!r} is not a job's folder, or has no hash")
                self.entries[digest] = JobEntry(job, digest, _words(item["overrides"]))
            names = {entry.job.lower() for entry in self.entries.values()}
            if not len(content["jobs"]) == len(self.entries) == len(names):
                raise ValueError("two jobs have one folder, or one hash")
        except (ValueError, LookupError, TypeError, AttributeError) as error:  # an `InputError` is one
            what = str(error) if isinstance(error, ValueError) else "a part is missing"
            what = what.removeprefix(f"{file}: ")
            raise InputError(
                f"{file}: damaged ({what}); put back a good copy, or choose another hydra.sweep.dir"
            ) from None


def open_sweep(path: Path) -> SweepFolder:
    """A sweep's folder, for reading. Raises `InputError` where there is none, or sweep.json is damaged."""
    if not os.path.lexists(path / SWEEP_JSON):
        reason = f"not a sweep's folder, it has no {SWEEP_JSON}" if path.exists() else "no such folder"
        raise InputError(f"{path}: {reason}; give the folder of a sweep, e.g. one in runs/")
    return SweepFolder(path)


def _words(value: Any) -> tuple[str, ...]:
    if not (isinstance(value, list) and all(isinstance(each, str) for each in value)):
        raise ValueError("overrides must be a command line's words")
    return tuple(value)
