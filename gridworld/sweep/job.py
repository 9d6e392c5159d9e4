"""One job of a sweep, in the process that the launcher runs it in."""

from __future__ import annotations

import contextlib
import math
import sys
import time
import traceback
from dataclasses import replace
from pathlib import Path

from gridworld.config.train import TrainConfig
from gridworld.errors import FolderLostError, InputError, MachineError, reason
from gridworld.process.signals import Interrupted
from gridworld.restore.resume import unfinished_of
from gridworld.run.folder import ERROR_FILE, LOCK, MANIFEST
from gridworld.run.reader import find_run, is_started, read_run
from gridworld.run.writer import clear, record_failure
from gridworld.storage.atomic_write import write_text
from gridworld.storage.file_lock import locked
from gridworld.sweep.job_table import (
    DONE,
    FAILED,
    INTERRUPTED,
    PENDING,
    RUNNING,
    JobTable,
    one_line,
    outcome,
    run_status,
)
from gridworld.training.together import Training
from gridworld.training.train import training

_TO_GO_ON_WITH = ("running", "interrupted")  # statuses of runs that were stopped from outside


class JobError(Exception):
    """The job failed; its row says why."""


class StopSweep(BaseException):
    """The job failed, and the sweep is to stop. No `Exception`: after one, launchers go on."""


def run_in_sweep(
    config: TrainConfig, folder: Path, overrides: list[str], stop_at_failure: bool
) -> Training[float]:
    """Train in the job's folder, unless that is done or another process does it.

    An interrupted run goes on from its checkpoint; a failed one is replaced.

    Args:
        config: the job's configuration.
        folder: the job's, in the sweep's folder.
        overrides: the job's, for its manifest.
        stop_at_failure: whether a failure is to stop the sweep.

    Returns:
        The final policy's regret; NaN where there was nothing to do.

    Raises:
        JobError: the job failed.
        StopSweep: the job failed, and that is to stop the sweep.
        SystemExit: the job was interrupted.
        OSError: not even the table can be written.
    """
    table = JobTable(folder.parent)
    with locked(folder / LOCK, wait=1) as is_ours:
        if not is_ours or not _make_ready(folder, table):
            return math.nan
        table.set(folder.name, status=RUNNING, seconds="", objective="", error="")
        try:
            return (yield from _run(config, folder, overrides, table))
        except JobError as error:
            if stop_at_failure:
                raise StopSweep(str(error)) from None
            raise


def mark_failed(folder: Path, why: str) -> None:
    """Note in the manifest why the job failed, where it has one that says it is unfinished."""
    with contextlib.suppress(InputError):  # a damaged manifest is left as it is
        run = find_run(folder)
        if run is not None and run.manifest["status"] in _TO_GO_ON_WITH:
            record_failure(run, why)


def _make_ready(folder: Path, table: JobTable) -> bool:
    """Remove a run that cannot go on, its manifest first; False where the job is done.

    A finished run is replaced if the table has the job as failed: then it is another job's.
    """
    status = run_status(folder)
    row = table.row(folder.name)
    if status == "finished" and (row is None or row.status != FAILED):
        return False
    if status not in _TO_GO_ON_WITH:
        (folder / MANIFEST).unlink(missing_ok=True)
        clear(folder)
    return True


def _run(config: TrainConfig, folder: Path, overrides: list[str], table: JobTable) -> Training[float]:
    started, job = time.monotonic(), folder.name
    # The sweep has a progress line of its own.
    config = replace(config, logging=replace(config.logging, progress=False))
    try:
        if is_started(folder):
            summary = yield from unfinished_of(folder, config).resumption()
        else:
            summary = yield from training(config, folder, overrides)
    except Interrupted as interruption:
        table.set(job, status=INTERRUPTED, **outcome(read_run(folder)))
        sys.exit(interruption.exit_code)
    except (OSError, MachineError) as error:  # the job itself is right, and goes on later
        why = one_line(reason(error))
        table.set(job, status=INTERRUPTED if (folder / MANIFEST).exists() else PENDING, error=why)
        raise JobError(why) from None
    except Exception as error:
        why = one_line(reason(error))
        if not isinstance(error, InputError):
            with contextlib.suppress(OSError, FolderLostError):  # the reason is worth more than its traceback
                write_text(folder / ERROR_FILE, traceback.format_exc())
        with contextlib.suppress(FolderLostError):
            mark_failed(folder, why)  # a run that could not go on writes no reason itself
        table.set(job, status=FAILED, seconds=f"{time.monotonic() - started:.2f}", error=why)
        raise JobError(why) from None
    table.set(job, status=DONE, **outcome(read_run(folder)))
    return float(summary["regret"])
