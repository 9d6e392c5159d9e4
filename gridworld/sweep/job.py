"""One job of a sweep, in the process that it runs in."""

from __future__ import annotations

import contextlib
import math
import sys
import traceback
from dataclasses import replace
from pathlib import Path

from gridworld.config.train import TrainConfig
from gridworld.errors import FolderLostError, InputError, MachineError, reason
from gridworld.process.signals import Interrupted
from gridworld.restore.resume import unfinished_of
from gridworld.run.folder import ERROR_FILE, LOCK, MANIFEST
from gridworld.run.reader import find_run, is_started
from gridworld.run.writer import clear, record_failure
from gridworld.storage.atomic_write import locked, write_text
from gridworld.sweep.job_table import one_line, run_status
from gridworld.training.together import Training
from gridworld.training.train import training

_UNFINISHED = ("running", "interrupted")  # statuses of runs that were stopped from outside


class JobError(Exception):
    """The job failed, or could not go on; its folder says which."""


class StopSweep(BaseException):
    """The job failed, and the sweep is to stop. Not an `Exception`: after one, others continue."""


def run_in_sweep(
    config: TrainConfig, folder: Path, overrides: list[str], stop_at_failure: bool, replaces: bool = False
) -> Training[float]:
    """Train in the job's folder, unless that is done or another process does it.

    An interrupted run goes on from its checkpoint; a failed one is replaced.

    Args:
        config: the job's configuration.
        folder: the job's, in the sweep's folder.
        overrides: the job's, for its manifest.
        stop_at_failure: whether a failure is to stop the sweep.
        replaces: whether a finished run is replaced too.

    Returns:
        The final policy's regret; NaN where there was nothing to do.

    Raises:
        JobError: the job failed, or the machine has to be put right first.
        StopSweep: the job failed, and that is to stop the sweep.
        SystemExit: the job was interrupted.
    """
    try:
        with locked(folder / LOCK, wait=1) as is_ours:
            if not is_ours or ((status := run_status(folder)) == "finished" and not replaces):
                return math.nan
            if status not in _UNFINISHED:
                (folder / MANIFEST).unlink(missing_ok=True)
                clear(folder)
            # The sweep has a progress line of its own.
            quiet = replace(config, logging=replace(config.logging, progress=False))
            is_begun = is_started(folder)
            run = (
                unfinished_of(folder, quiet).resumption() if is_begun else training(quiet, folder, overrides)
            )
            return float((yield from run)["regret"])
    except Interrupted as interruption:
        sys.exit(interruption.exit_code)
    except (OSError, MachineError, FolderLostError) as error:  # the job itself is right, and goes on later
        raise JobError(one_line(reason(error))) from None
    except Exception as error:
        why = one_line(reason(error))
        with contextlib.suppress(OSError, FolderLostError):
            mark_failed(folder, why, "" if isinstance(error, InputError) else traceback.format_exc())
        if stop_at_failure:
            raise StopSweep(why) from None
        raise JobError(why) from None


def mark_failed(folder: Path, why: str, trace: str = "") -> None:
    """Note why the job failed: in its manifest, and with the traceback or without a manifest in a file."""
    run = None
    with contextlib.suppress(InputError):  # a damaged manifest is left as it is
        run = find_run(folder)
        if run is not None and run.manifest["status"] in _UNFINISHED:
            record_failure(run, why)
    if trace or run is None:
        write_text(folder / ERROR_FILE, f"{why}\n{trace}")
