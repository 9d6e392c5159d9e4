"""One job of a sweep, in the process that the launcher chose for it."""

from __future__ import annotations

import math
import shutil
import sys
import time
import traceback
from dataclasses import replace
from pathlib import Path

from gridworld.config import TrainConfig
from gridworld.errors import InputError
from gridworld.files import write_json, write_text
from gridworld.lock import locked
from gridworld.resume import is_intact, train_or_go_on
from gridworld.run import LOCK, MANIFEST, Run
from gridworld.signals import Interrupted
from gridworld.sweep.table import DONE, FAILED, INTERRUPTED, RUNNING, Table, one_line, outcome, read_json

ERROR_FILE = "error.txt"  # the traceback of what nobody foresaw
_HYDRA_FOLDER = ".hydra"
_TO_GO_ON_WITH = ("running", "interrupted")  # statuses of runs that were stopped from outside


class JobError(Exception):
    """The job failed; its row says why."""


class StopSweep(BaseException):
    """The job failed, and the sweep is to stop at that. Launchers go on after an `Exception` only."""


def run_in_sweep(config: TrainConfig, folder: Path, overrides: list[str], stop_at_failure: bool) -> float:
    """Train in the job's folder, unless that is done or being done; returns the final regret.

    What was interrupted goes on from its checkpoint; what an attempt left that failed is replaced.
    Raises `JobError` or `StopSweep`, and `SystemExit` when interrupted.
    """
    table, job = Table(folder.parent), folder.name
    with locked(folder / LOCK, wait=1) as is_ours:
        status = read_json(folder / MANIFEST).get("status")
        if not is_ours or status == "finished":
            return math.nan
        if status not in _TO_GO_ON_WITH or not is_intact(folder):
            _clear(folder)
        table.set(job, status=RUNNING, seconds="", objective="", error="")
        started = time.monotonic()
        run = Run(folder)
        config = replace(config, logging=replace(config.logging, progress=False))  # the sweep has its own
        try:
            summary = train_or_go_on(config, run, overrides)
        except Interrupted as interruption:
            table.set(job, status=INTERRUPTED, **outcome(folder, run.manifest))
            sys.exit(interruption.exit_code)
        except Exception as error:
            reason = str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
            if not isinstance(error, InputError):
                write_text(folder / ERROR_FILE, traceback.format_exc())
            seconds = f"{time.monotonic() - started:.2f}"
            table.set(job, status=FAILED, seconds=seconds, error=one_line(reason))
            raise (StopSweep if stop_at_failure else JobError)(one_line(reason)) from None
        table.set(job, status=DONE, **outcome(folder, run.manifest))
    return float(summary["regret"])


def mark_failed(folder: Path, reason: str) -> None:
    """Say in the manifest, if the job came so far, what its own process could not."""
    manifest = read_json(folder / MANIFEST)
    if manifest:
        write_json(folder / MANIFEST, manifest | {"status": "failed", "error": reason})


def _clear(folder: Path) -> None:
    """Take away what an attempt left that came to no end, its manifest first."""
    (folder / MANIFEST).unlink(missing_ok=True)
    for path in folder.iterdir():
        if path.name in (LOCK, _HYDRA_FOLDER):
            continue
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink()
