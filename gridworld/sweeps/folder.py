"""A sweep's folder: which jobs it has, how they stand, and the lock of the process that runs the sweep.

sweep.json      what was asked for, by which versions, and the jobs: folder, hash, overrides
jobs.csv        a row per job, made of the jobs' own folders
agent=dqn,seed=0/   a job's folder, an ordinary run's; error.txt in it says why it failed before it began
.lock           held by the process that runs the sweep; one in each job's folder, by the job's process
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import re
import shlex
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path, PurePath
from types import MappingProxyType
from typing import Any

from gridworld.base.atomic_write import check_no_links, is_locked, make_folder, write_json, write_text
from gridworld.base.console import recorded_command_line
from gridworld.base.errors import InputError
from gridworld.base.safe_read import LARGEST_JSON, csv_text, read_bytes, read_sealed, sealed
from gridworld.run.folder import ERROR_FILE, HYDRA, LOCK, MANIFEST, SWEEP_JSON, alone_in, check_writable
from gridworld.run.provenance import settings_hash, versions
from gridworld.run.reader import RunReader, check_is, find_run
from gridworld.sweeps.plan import Job

JOBS_CSV = "jobs.csv"
STATUSES = ("pending", "running", "done", "failed", "interrupted")
PENDING, RUNNING, DONE, FAILED, INTERRUPTED = STATUSES
_OF_A_RUN = {"finished": DONE, "failed": FAILED}  # by the manifest's status; any other was interrupted
_JOB = re.compile(r"[\w=+,-][\w.,=+-]*", re.ASCII)  # as `folder_name` makes them: no other folder
_LONGEST_NAME = 100  # characters of a job's folder
_HASH_SHOWN = 6  # characters of the hash in a name that needs it
_SEED = re.compile(r"\+*seed=")
_NONE: Mapping[str, Any] = MappingProxyType({})


@dataclass(frozen=True)
class JobEntry:
    """A job as sweep.json has it: its folder's name, its hash, its overrides."""

    job: str
    hash: str
    overrides: tuple[str, ...]


@dataclass(frozen=True)
class JobRow:
    """A job's row in jobs.csv."""

    job: str  # its folder
    overrides: str
    status: str = PENDING
    seconds: str = ""
    objective: str = ""  # the final greedy policy's regret
    error: str = ""  # why it failed or was interrupted, in one line


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
                f"{path}: has no {SWEEP_JSON}, but {used.parent} contains a run; choose another "
                "hydra.sweep.dir"
            )

    def check(self, jobs: Sequence[Job], extend: bool) -> None:
        """Raise `InputError` if the folder cannot be written, or is another sweep's and not to `extend`."""
        check_writable(self.path, "hydra.sweep.dir")
        common = [self.entries[job.hash] for job in jobs if job.hash in self.entries]
        for entry in common:  # other jobs get a folder of their own
            for names in ((), (HYDRA,)):
                check_no_links(self.path, entry.job, *names)
        if self.entries and not extend and not common:
            asked = shlex.join(self._asked[-1]["overrides"])
            raise InputError(
                f"{self.path}: contains the sweep '{asked}', which has no job in common with this one; "
                "choose another hydra.sweep.dir, or merge them with hydra.sweeper.extend=true"
            )

    @contextlib.contextmanager
    def at_work(self) -> Iterator[None]:
        """Make the folder, and keep other sweeps out of it. Raises `InputError` if one is there."""
        try:
            make_folder(self.path)
        except OSError as error:
            raise InputError(f"{self.path}: cannot be made ({error.strerror})") from None
        with alone_in(self.path, wait=1):
            yield

    def add(self, jobs: Sequence[Job], words: Sequence[str]) -> list[Job]:
        """Write to sweep.json what is asked for by the overrides `words`; returns the jobs with folders."""
        taken = {entry.job.lower() for entry in self.entries.values()}
        others = (each for each in self.path.iterdir() if each.is_symlink() or (each / MANIFEST).exists())
        taken |= {each.name.lower() for each in others}  # of no job
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
        here = self.path.absolute()
        return [dataclasses.replace(job, folder=here / self.entries[job.hash].job) for job in jobs]

    def rows(
        self, reasons: Mapping[str, str] = _NONE, ended: Mapping[str, JobRow] = _NONE
    ) -> dict[str, JobRow]:
        """The rows of all jobs as their folders have them, but for `reasons` that no folder has.

        Those that have `ended` cannot change, and are not made anew.
        """
        found = {}
        for entry in self.entries.values():
            row = ended.get(entry.job) or job_row(self.path / entry.job, entry)
            if row.status in (PENDING, INTERRUPTED) and not row.error:
                row = dataclasses.replace(row, error=reasons.get(entry.job, ""))
            found[entry.job] = row
        return found

    def write(self, rows: Mapping[str, JobRow]) -> None:
        """Write jobs.csv anew."""
        head = [field.name for field in dataclasses.fields(JobRow)]
        write_text(self.path / JOBS_CSV, csv_text([head, *map(dataclasses.astuple, rows.values())]))

    def _load(self, file: Path) -> None:
        content = read_sealed(file)
        try:
            self._asked = list(content["asked"])
            _ = self._asked[-1], [_words(earlier["overrides"]) for earlier in self._asked]
            for item in content["jobs"]:
                job, digest = item["job"], item["hash"]
                if not (isinstance(job, str) and _JOB.fullmatch(job) and isinstance(digest, str)):
                    raise ValueError(f"{str(job)[:80]!r} is not a job's folder, or has no hash")
                self.entries[digest] = JobEntry(job, digest, _words(item["overrides"]))
            names = {entry.job.lower() for entry in self.entries.values()}
            if not len(content["jobs"]) == len(self.entries) == len(names):
                raise ValueError("two jobs have the same folder or hash")
        except (ValueError, LookupError, TypeError, AttributeError) as error:
            raise InputError(
                f"{file}: damaged ({error}); restore a good copy, or choose another hydra.sweep.dir"
            ) from None


def open_sweep(path: Path) -> SweepFolder:
    """A sweep's folder, for reading. Raises `InputError` where there is none, or sweep.json is damaged."""
    check_is(path, SWEEP_JSON)
    return SweepFolder(path)


def _words(value: Any) -> tuple[str, ...]:
    if not (isinstance(value, list) and all(isinstance(each, str) for each in value)):
        raise ValueError("overrides must be a command line's words")
    return tuple(value)


def job_row(folder: Path, entry: JobEntry | None = None) -> JobRow:
    """The row of the job in a folder; with its entry, whether the run is this job's is checked too."""
    row = JobRow(folder.name, one_line(" ".join(entry.overrides if entry else ())))
    try:
        run = find_run(folder)
        status = PENDING if run is None else _OF_A_RUN.get(run.manifest["status"], INTERRUPTED)
        if status in (PENDING, INTERRUPTED) and is_locked(folder / LOCK):
            return dataclasses.replace(row, status=RUNNING)
        if run is None:
            file = folder / ERROR_FILE
            text = read_bytes(file, LARGEST_JSON).decode(errors="replace") if file.exists() else ""
            error = one_line(text.partition("\n")[0])
            return dataclasses.replace(row, status=FAILED if error else PENDING, error=error)
        if status == DONE and entry is not None and (other := _other_job(run.manifest, entry)):
            return dataclasses.replace(row, status=FAILED, error=other)
        return dataclasses.replace(row, status=status, **_outcome(run))
    except InputError as damage:  # a damaged file counts as a failed run's
        return dataclasses.replace(row, status=FAILED, error=one_line(damage))


def _outcome(run: RunReader) -> dict[str, str]:
    """The seconds, objective and error of a run that ended, as far as it has them."""
    found = {"error": one_line(run.manifest.get("error", ""))}
    with contextlib.suppress(KeyError, TypeError, ValueError):  # it was killed
        started, ended = (datetime.fromisoformat(run.manifest[key]) for key in ("started", "ended"))
        found["seconds"] = f"{(ended - started).total_seconds():.2f}"
    if run.is_finished:
        regret = run.read_summary()["regret"]
        found["objective"] = "" if regret is None else repr(regret)
    return found


def _other_job(manifest: dict[str, Any], entry: JobEntry) -> str:
    """Why a finished run in the job's folder is not the job's result; "" if it is."""
    try:
        if entry.hash == settings_hash(manifest["config"], "\n".join(manifest["layout"])):
            return ""
        lengths = [again["total_timesteps"] for again in manifest["resumed"] if "total_timesteps" in again]
    except (KeyError, TypeError, AttributeError):
        lengths = []
    what = f"was made {lengths[-1]} steps long" if lengths else "has different settings from the job"
    return f"the run in {entry.job} {what}, so it is not this job's result; move it to keep it"


def one_line(text: Any) -> str:
    """The text without line breaks or other control characters, for a table."""
    return " ".join("".join(c if c.isprintable() else " " for c in str(text)).split())


def folder_name(job: Job, taken: Collection[str], common: Collection[str] = ()) -> str:
    """A name for the job's folder, of the overrides in which it differs from other jobs.

    It is of the swept overrides, or else of all but the common ones; where neither is short enough and free,
    it ends with a part of the hash. The seed is always in it.
    """
    for lines in (job.swept or job.overrides, [line for line in job.overrides if line not in common]):
        name = ",".join(map(_slug, lines)) or "job"
        if len(name) <= _LONGEST_NAME and name.lower() not in taken:
            return name
    lines = job.swept or job.overrides
    seed = [_slug(line) for line in lines if _SEED.match(line)]
    head = ",".join(_slug(line) for line in lines if not _SEED.match(line))
    for characters in (_HASH_SHOWN, len(job.hash)):
        ending = ",".join([*seed, job.hash[:characters]])
        name = ",".join(filter(None, [head[: _LONGEST_NAME - len(ending) - 1].rstrip(",.-"), ending]))
        if name.lower() not in taken:
            break
    return name


def _slug(override: str) -> str:
    """The override in letters, digits and a few safe signs; of a path, its last part."""
    key, equals, value = override.partition("=")
    if "/" in value:
        value = PurePath(value.strip("'\"")).stem
    return re.sub(r"[^A-Za-z0-9_.=+-]+", "-", key + equals + value).strip("-.+~")
