"""jobs.csv: a row per job, made of the jobs' own folders: their manifests and locks."""

from __future__ import annotations

import csv
import dataclasses
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from gridworld.errors import InputError
from gridworld.run.folder import ERROR_FILE, LOCK
from gridworld.run.provenance import settings_hash
from gridworld.run.reader import RunReader, find_run
from gridworld.storage.atomic_write import is_locked, write_text
from gridworld.storage.csv_text import csv_rows, csv_text
from gridworld.storage.safe_read import LARGEST_JSON, read_bytes, read_table
from gridworld.sweep.folder import JobEntry

JOBS_CSV = "jobs.csv"
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
    """A job's row in jobs.csv."""

    job: str  # its folder
    overrides: str
    status: str = PENDING
    seconds: str = ""
    objective: str = ""  # the final greedy policy's regret
    error: str = ""  # why it failed, in one line


_COLUMNS = [field.name for field in dataclasses.fields(JobRow)]


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

    def row(self, job: str) -> JobRow:
        """The row of one job as its folder has it."""
        return self._inspect(JobEntry(job, "", ()), None)

    def inspect(
        self,
        entries: Iterable[JobEntry],
        before: Mapping[str, JobRow],
        ended: Mapping[str, JobRow] | None = None,
    ) -> dict[str, JobRow]:
        """The rows as they should be; `before` has reasons that no folder has, `ended` what cannot change."""
        known = ended or {}
        return {e.job: known.get(e.job) or self._inspect(e, before.get(e.job)) for e in entries}

    def write(self, rows: Mapping[str, JobRow]) -> None:
        """Write the file anew."""
        write_text(self.file, csv_text([_COLUMNS, *map(dataclasses.astuple, rows.values())]))

    def _inspect(self, entry: JobEntry, before: JobRow | None) -> JobRow:
        folder = self.folder / entry.job
        row = JobRow(entry.job, one_line(" ".join(entry.overrides)))
        try:
            run = find_run(folder)
            status = PENDING if run is None else _OF_A_RUN.get(run.manifest["status"], INTERRUPTED)
            if status in (PENDING, INTERRUPTED) and is_locked(folder / LOCK):
                return dataclasses.replace(row, status=RUNNING)
            if run is None:
                reason = _first_line(folder / ERROR_FILE)
                if before is not None and not reason and before.status in (FAILED, PENDING):
                    return dataclasses.replace(row, status=before.status, error=before.error)
                return dataclasses.replace(row, status=FAILED if reason else PENDING, error=reason)
            row = dataclasses.replace(row, status=status, **_outcome(run))
            if status == DONE and (other := _other_job(run.manifest, entry)):
                return dataclasses.replace(row, status=FAILED, objective="", error=other)
        except InputError as damage:  # a damaged file counts as a failed run's
            return dataclasses.replace(row, status=FAILED, error=one_line(damage))
        keeps = before is not None and before.status == status and not row.error
        return dataclasses.replace(row, error=before.error) if before is not None and keeps else row


def _outcome(run: RunReader) -> dict[str, str]:
    """The seconds, objective and error of a run that ended, as far as it has them."""
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
        if entry.hash in ("", settings_hash(manifest["config"], "\n".join(manifest["layout"]))):
            return ""
        lengths = [again["total_timesteps"] for again in manifest["resumed"] if "total_timesteps" in again]
    except (KeyError, TypeError, AttributeError):
        lengths = []
    what = f"was made {lengths[-1]} steps long" if lengths else "has other settings than the job"
    return f"the run in {entry.job} {what}, so that it is not this job's result; move it to keep it"


def _first_line(file: Path) -> str:
    if not file.exists():
        return ""
    return one_line(read_bytes(file, LARGEST_JSON).decode(errors="replace").partition("\n")[0])


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
