"""jobs.csv: a row per job. Whoever starts or ends a job rewrites the table, whole and under a lock.

A process that is killed cannot write its last row; so the table is put right, from the jobs' manifests and
locks, whenever a sweep starts or ends and whenever it is looked at.
"""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import math
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from gridworld.errors import InputError
from gridworld.files import write_text
from gridworld.lock import is_locked, locked
from gridworld.recovery import manifest_of
from gridworld.run import LOCK, SUMMARY
from gridworld.sweep.folder import Entry
from gridworld.sweep.plan import settings_hash

JOBS_CSV = "jobs.csv"
TABLE_LOCK = ".jobs.lock"
PENDING, RUNNING, DONE, FAILED, INTERRUPTED = STATUSES = (
    "pending",
    "running",
    "done",
    "failed",
    "interrupted",
)
_OF_A_RUN = {"finished": DONE, "failed": FAILED}  # a run's own words; else it was interrupted


@dataclass(frozen=True)
class Row:
    """How a job stands."""

    job: str  # its folder
    overrides: str
    status: str = PENDING
    seconds: str = ""
    objective: str = ""  # the final greedy policy's regret
    error: str = ""  # why it failed, in one line


class Table:
    """The rows of the sweep in `folder`, by job."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.file = folder / JOBS_CSV

    def read(self) -> dict[str, Row]:
        """As the file has them; one that cannot be read counts as empty, since it can be made again."""
        try:
            lines = list(csv.reader(io.StringIO(self.file.read_text("utf-8"))))
        except (FileNotFoundError, UnicodeDecodeError, csv.Error):
            return {}
        if not lines or lines[0] != _COLUMNS:
            return {}
        return {line[0]: Row(*line) for line in lines[1:] if len(line) == len(_COLUMNS)}

    def row(self, job: str) -> Row | None:
        """The job's row as the file has it."""
        found = self._find(job)
        return self.read().get(job) if found is None else found[1]

    def set(self, job: str, **changes: str) -> None:
        """Change a job's row. Other rows are copied as they stand: reading ten thousand takes 0.1 s."""
        with locked(self.folder / TABLE_LOCK):
            found = self._find(job)
            if found is not None:
                text, row, place = found
                line = _line(dataclasses.astuple(dataclasses.replace(row, **changes)))
                write_text(self.file, text[: place.start] + line + text[place.stop :])
                return
            rows = self.read()
            rows[job] = dataclasses.replace(rows.get(job, Row(job, "")), **changes)
            self._write(rows.values())

    def _find(self, job: str) -> tuple[str, Row, slice] | None:
        """(the file's text, the job's row, where in the text its line is); None if it is not that simple."""
        try:
            text = self.file.read_text("utf-8")
        except (FileNotFoundError, UnicodeDecodeError):
            return None
        start = text.find("\n" + _line([job, ""])[:-1]) + 1
        stop = text.find("\n", start) + 1
        fields = next(csv.reader([text[start:stop]]), [])
        if not start or not stop or not text.startswith(_line(_COLUMNS)) or len(fields) != len(_COLUMNS):
            return None
        return text, Row(*fields), slice(start, stop)

    def put_right(self, entries: Iterable[Entry]) -> dict[str, Row]:
        """Write the rows of these jobs anew, as their folders have it."""
        with locked(self.folder / TABLE_LOCK):
            rows = self.look(entries)
            self._write(rows.values(), durable=True)
        return rows

    def look(self, entries: Iterable[Entry]) -> dict[str, Row]:
        """The same without writing."""
        before = self.read()
        return {entry.job: self._look_at(entry, before.get(entry.job)) for entry in entries}

    def _look_at(self, entry: Entry, before: Row | None) -> Row:
        folder = self.folder / entry.job
        row = Row(entry.job, one_line(" ".join(entry.overrides)))
        manifest = read_manifest(folder)
        status = _OF_A_RUN.get(manifest.get("status", ""), INTERRUPTED if manifest else PENDING)
        if status in (PENDING, INTERRUPTED) and is_locked(folder / LOCK):
            return dataclasses.replace(row, status=RUNNING)
        if status == PENDING and before is not None and before.status == FAILED:
            return dataclasses.replace(before, overrides=row.overrides)  # it never came to a manifest
        row = dataclasses.replace(row, status=status, **outcome(folder, manifest))
        if status == DONE and (error := _other_job(manifest, entry)):
            return dataclasses.replace(row, status=FAILED, objective="", error=error)
        if before is not None and before.status == status and not row.error:
            return dataclasses.replace(row, error=before.error)  # the disk was too full for the manifest
        return row

    def _write(self, rows: Iterable[Row], durable: bool = False) -> None:
        lines = [_line(_COLUMNS), *(_line(dataclasses.astuple(row)) for row in rows)]
        write_text(self.file, "".join(lines), durable)


_COLUMNS = [field.name for field in dataclasses.fields(Row)]


def _line(fields: Iterable[str]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerow(fields)
    return text.getvalue()


def outcome(folder: Path, manifest: dict[str, Any]) -> dict[str, str]:
    """Seconds, objective and error of a run that ended, as far as it has them."""
    found = {"error": one_line(manifest.get("error", ""))}
    try:
        started, ended = (datetime.fromisoformat(manifest[key]) for key in ("started", "ended"))
        found["seconds"] = f"{(ended - started).total_seconds():.2f}"
    except (KeyError, TypeError, ValueError):
        pass  # it was killed
    regret = read_json(folder / SUMMARY).get("regret")
    if isinstance(regret, int | float) and math.isfinite(regret):
        found["objective"] = repr(regret)
    return found


def _other_job(manifest: dict[str, Any], entry: Entry) -> str:
    """What of a finished run in the job's folder makes it another job's; "" if it is the job's own."""
    try:
        if settings_hash(manifest["config"], "\n".join(manifest["layout"])) == entry.hash:
            return ""
        lengths = [again["total_timesteps"] for again in manifest["resumed"] if "total_timesteps" in again]
    except (KeyError, TypeError, AttributeError):
        lengths = []
    what = f"was made {lengths[-1]} steps long" if lengths else "has other settings than the job"
    return f"the run in {entry.job} {what}, so that it is not this job's result; move it to keep it"


def read_manifest(folder: Path) -> dict[str, Any]:
    """A run's manifest, or a checkpoint's copy of it; empty where there is none.

    One that is damaged, without a copy, counts as that of a failed run.
    """
    try:
        return manifest_of(folder)
    except InputError as error:
        return {"status": "failed", "error": str(error)}


def one_line(text: Any) -> str:
    """Without line breaks or other control characters, for a table."""
    return " ".join("".join(c if c.isprintable() else " " for c in str(text)).split())


def read_json(file: Path) -> dict[str, Any]:
    """The object in a file; empty where there is none."""
    try:
        content = json.loads(file.read_text("utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}
