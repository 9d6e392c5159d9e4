"""jobs.csv: a row per job. Whoever starts or ends a job rewrites the table, whole and under a lock.

A process that is killed cannot write its last row; so the table is repaired, by the jobs' manifests and
locks, whenever a sweep starts or ends and whenever it is shown.
"""

from __future__ import annotations

import csv
import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from gridworld.errors import InputError
from gridworld.run.folder import LOCK
from gridworld.run.provenance import settings_hash
from gridworld.run.reader import RunReader, find_run
from gridworld.storage.atomic_write import write_text
from gridworld.storage.csv_text import csv_rows, csv_text
from gridworld.storage.file_lock import is_locked, locked
from gridworld.storage.safe_read import read_table
from gridworld.sweep.folder import JobEntry

JOBS_CSV = "jobs.csv"
TABLE_LOCK = ".jobs.lock"
PENDING, RUNNING, DONE, FAILED, INTERRUPTED = STATUSES = (
    "pending",
    "running",
    "done",
    "failed",
    "interrupted",
)
_OF_A_RUN = {"finished": DONE, "failed": FAILED}  # by the manifest's status; any other was interrupted


@dataclass(frozen=True)
class JobRow:
    """How a job stands, as jobs.csv has it."""

    job: str  # its folder
    overrides: str
    status: str = PENDING
    seconds: str = ""
    objective: str = ""  # the final greedy policy's regret
    error: str = ""  # why it failed, in one line


class JobTable:
    """The rows of the sweep in `folder`, by job."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.file = folder / JOBS_CSV

    def read(self) -> dict[str, JobRow]:
        """The rows of the file; one that cannot be read counts as empty, since it can be made again."""
        try:
            lines = list(csv_rows(read_table(self.file)))
        except (InputError, csv.Error):
            return {}
        if not lines or lines[0] != _COLUMNS:
            return {}
        return {line[0]: JobRow(*line) for line in lines[1:] if len(line) == len(_COLUMNS)}

    def row(self, job: str) -> JobRow | None:
        """The job's row in the file."""
        found = self._find(job)
        return self.read().get(job) if found is None else found[1]

    def set(self, job: str, **changes: str) -> None:
        """Change fields of a job's row. Other rows are copied unread: reading ten thousand takes 0.1 s."""
        with locked(self.folder / TABLE_LOCK):
            found = self._find(job)
            if found is not None:
                text, row, place = found
                line = csv_text([dataclasses.astuple(dataclasses.replace(row, **changes))])
                write_text(self.file, text[: place.start] + line + text[place.stop :])
                return
            rows = self.read()
            rows[job] = dataclasses.replace(rows.get(job, JobRow(job, "")), **changes)
            self._write(rows.values())

    def _find(self, job: str) -> tuple[str, JobRow, slice] | None:
        """(the file's text, the job's row, where in the text its line is); None if it is not that simple."""
        try:
            text = read_table(self.file)
            start = text.find("\n" + csv_text([[job, ""]])[:-1]) + 1
            stop = text.find("\n", start) + 1
            fields = next(csv_rows(text[start:stop]), [])
        except (InputError, csv.Error):
            return None
        if not start or not stop or not text.startswith(csv_text([_COLUMNS])) or len(fields) != len(_COLUMNS):
            return None
        return text, JobRow(*fields), slice(start, stop)

    def repair(self, entries: Iterable[JobEntry]) -> dict[str, JobRow]:
        """Write the rows of these jobs anew, as `inspect` returns them."""
        with locked(self.folder / TABLE_LOCK):
            rows = self.inspect(entries)
            self._write(rows.values(), durable=True)
        return rows

    def inspect(self, entries: Iterable[JobEntry], by_folders_alone: bool = False) -> dict[str, JobRow]:
        """The rows as they should be.

        Args:
            entries: the jobs.
            by_folders_alone: leave out what only the file says, such as the error of a job that never began.

        Returns:
            Each job's row, by its folder's name.
        """
        before = {} if by_folders_alone else self.read()
        return {entry.job: self._inspect(entry, before.get(entry.job)) for entry in entries}

    def _inspect(self, entry: JobEntry, before: JobRow | None) -> JobRow:
        folder = self.folder / entry.job
        row = JobRow(entry.job, one_line(" ".join(entry.overrides)))
        try:
            run = find_run(folder)
            status = PENDING if run is None else _OF_A_RUN.get(run.manifest["status"], INTERRUPTED)
            if status in (PENDING, INTERRUPTED) and is_locked(folder / LOCK):
                return dataclasses.replace(row, status=RUNNING)
            if run is not None:
                row = dataclasses.replace(row, status=status, **outcome(run))
            elif before is not None and before.status == FAILED:  # it never came to a manifest
                return dataclasses.replace(row, status=FAILED, seconds=before.seconds, error=before.error)
            if status == DONE and run is not None and (error := _other_job(run.manifest, entry)):
                return dataclasses.replace(row, status=FAILED, objective="", error=error)
        except InputError as error:  # a damaged file counts as a failed run's
            return dataclasses.replace(row, status=FAILED, error=one_line(error))
        if before is not None and before.status == status and not row.error:
            return dataclasses.replace(row, error=before.error)  # the disk was too full for the manifest
        return row

    def _write(self, rows: Iterable[JobRow], durable: bool = False) -> None:
        write_text(self.file, csv_text([_COLUMNS, *map(dataclasses.astuple, rows)]), durable)


_COLUMNS = [field.name for field in dataclasses.fields(JobRow)]


def outcome(run: RunReader) -> dict[str, str]:
    """The seconds, objective and error of a run that ended, as far as it has them, for its row."""
    found = {"error": one_line(run.manifest.get("error", ""))}
    try:
        started, ended = (datetime.fromisoformat(run.manifest[key]) for key in ("started", "ended"))
        found["seconds"] = f"{(ended - started).total_seconds():.2f}"
    except (KeyError, TypeError, ValueError):
        pass  # it was killed
    if run.is_finished:
        regret = run.read_summary().get("regret")
        if isinstance(regret, int | float):
            found["objective"] = repr(regret)
    return found


def _other_job(manifest: dict[str, Any], entry: JobEntry) -> str:
    """Why a finished run in the job's folder is not the job's result; "" if it is."""
    try:
        if settings_hash(manifest["config"], "\n".join(manifest["layout"])) == entry.hash:
            return ""
        lengths = [again["total_timesteps"] for again in manifest["resumed"] if "total_timesteps" in again]
    except (KeyError, TypeError, AttributeError):
        lengths = []
    what = f"was made {lengths[-1]} steps long" if lengths else "has other settings than the job"
    return f"the run in {entry.job} {what}, so that it is not this job's result; move it to keep it"


def run_status(folder: Path) -> str:
    """The status of the run in a folder: "" where none has begun, "failed" for a damaged manifest."""
    try:
        run = find_run(folder)
    except InputError:
        return "failed"
    return "" if run is None else str(run.manifest["status"])


def one_line(text: Any) -> str:
    """The text without line breaks or other control characters, for a table."""
    return " ".join("".join(c if c.isprintable() else " " for c in str(text)).split())
