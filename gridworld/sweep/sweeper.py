"""A sweep from its command line to its exit code, around whichever of Hydra's launchers runs the jobs."""

from __future__ import annotations

import errno
import os
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from hydra.core.utils import JobReturn, JobStatus
from hydra.plugins.launcher import Launcher
from omegaconf import DictConfig

from gridworld.config.composition.words import with_whole_numbers
from gridworld.config.sweep import SweepConfig
from gridworld.errors import EXIT_CODE, FolderLostError, InputError, reason
from gridworld.process.console.terminal import tell, tell_error
from gridworld.process.signals import exiting, signal_name
from gridworld.sweep import console
from gridworld.sweep.config_loader import Configurations, SweepLoader
from gridworld.sweep.folder import JobEntry, SweepFolder
from gridworld.sweep.job import StopSweep, mark_failed
from gridworld.sweep.job_table import (
    DONE,
    FAILED,
    INTERRUPTED,
    PENDING,
    RUNNING,
    JobRow,
    JobTable,
    one_line,
    run_status,
)
from gridworld.sweep.plan import Job, expand, plan
from gridworld.sweep.population import lines, may_fork, populations
from gridworld.sweep.progress import sweep_progress

_ORPHANS_END_WITHIN = 5.0  # seconds; workers of a sweep that was killed
_STOPPED_END_WITHIN = 2.5  # seconds; those of one that is being stopped
_POLL_SECONDS = 0.1
_MOST_NOTES = 4  # that are printed before the jobs begin
_STOP_WITHIN = 4.0  # seconds after a signal
_DISK_IS_FULL = (errno.ENOSPC, errno.EDQUOT)


def run_sweep(
    words: list[str],
    loader: SweepLoader,
    launcher: Launcher,
    master: DictConfig,
    settings: SweepConfig,
) -> None:
    """Run the jobs that are asked for and not done yet.

    Args:
        words: the command line's overrides.
        loader: composes the jobs' configurations.
        launcher: runs the jobs.
        master: the configuration of the sweep itself.
        settings: how to run it.

    Raises:
        InputError: a mistake on the command line; nothing was run or written.
        SystemExit: not all jobs are done.
    """
    folder = SweepFolder(Path(master.hydra.sweep.dir))

    def divided(by_name: dict[str, Job], to_do: list[JobEntry]) -> list[list[JobEntry]]:
        return populations([(entry, by_name[entry.job]) for entry in to_do], settings, master.hydra)

    words = [*_of_yaml(settings), *words]  # a word of the command line comes later, and counts
    jobs = plan(expand(words, loader, settings.max_jobs, settings.paired), Configurations(loader, master))
    _refuse_mistakes(jobs, settings)
    folder.check(jobs, settings.extend)
    populations([], settings, master.hydra)  # finds a mistake
    counts = Counter(note for job in jobs for note in job.notes)
    for note, count in counts.most_common(_MOST_NOTES):
        tell(f"{note} ({count} of {len(jobs)} jobs)")
    if len(counts) > _MOST_NOTES:
        tell(f"and {len(counts) - _MOST_NOTES} more notes on other jobs")
    try:
        with folder.at_work():
            entries = folder.add(jobs, words)
            mistakes = {e.job: job.mistake for e, job in zip(entries, jobs, strict=True) if job.mistake}
            by_name = {entry.job: job for entry, job in zip(entries, jobs, strict=True)}
            in_fork = may_fork(zip(entries, jobs, strict=True), settings, master.hydra)
            sweep = _Sweep(folder, entries, launcher, partial(divided, by_name), in_fork)
            code = sweep.run(mistakes, settings.retry_failed, any(job.progress for job in jobs))
    except ConnectionError:
        raise  # from a cluster, not from a disk
    except OSError as error:
        console.tell_stopped_by(error, folder.path)
        code = 1
    except FolderLostError as error:
        tell_error(str(error))
        code = EXIT_CODE
    if code:
        raise SystemExit(code)


def _of_yaml(settings: SweepConfig) -> list[str]:
    """`hydra.sweeper.params` as words of a command line, as Hydra's own sweeper reads it."""
    for key, value in settings.params.items():
        if not isinstance(value, str | int | float):
            raise InputError(
                f"hydra.sweeper.params.{key}: must be text as on the command line, such as 0,1 or range(3)"
            )
    return with_whole_numbers([f"{key}={value}" for key, value in settings.params.items()])


def _refuse_mistakes(jobs: Sequence[Job], settings: SweepConfig) -> None:
    mistaken = [job for job in jobs if job.mistake is not None]
    if len(mistaken) == len(jobs) or (mistaken and settings.stop_at_first_failure):
        count = f" ({len(mistaken)} of {len(jobs)} jobs cannot run)" if len(jobs) > 1 else ""
        raise InputError(f"{mistaken[0].mistake}{count}")


class _Sweep:
    """The jobs that are asked for in this folder, and the launcher that runs them."""

    def __init__(
        self,
        folder: SweepFolder,
        entries: list[JobEntry],
        launcher: Launcher,
        divided: Callable[[list[JobEntry]], list[list[JobEntry]]],
        in_fork: set[str],
    ) -> None:
        self._folder = folder
        self._entries = entries
        self._launcher = launcher
        self._divided = divided  # into populations
        self._in_fork = in_fork  # the jobs that may run in a fork
        self._table = JobTable(folder.path)
        self._launcher_failed = False  # before any job had begun

    def _to_do(self, mistakes: dict[str, str], retry_failed: bool) -> list[JobEntry]:
        """The jobs to run now. Those with a mistake are noted as failed."""
        rows = self._repair()
        for job, mistake in mistakes.items():
            if rows[job].status != DONE:
                self._table.set(job, status=FAILED, error=mistake)
        statuses = {PENDING, INTERRUPTED} | ({FAILED} if retry_failed else set())
        return [e for e in self._entries if rows[e.job].status in statuses and e.job not in mistakes]

    def run(self, mistakes: dict[str, str], retry_failed: bool, progress: bool) -> int:
        """Launch the jobs to do, and print how they ended; returns the exit code."""
        to_do = self._to_do(mistakes, retry_failed)
        started = time.monotonic()
        names = [entry.job for entry in self._entries]
        rows = self._table.inspect(self._entries)
        console.tell_start(self._folder.path, [rows[name] for name in names], len(to_do))
        stopped, code = "", 0
        received: list[int] = []  # signals; Ray may change the exception that one raises

        def end_soon(number: int) -> None:
            received.append(number)
            _exit_within(_STOP_WITHIN, 128 + number)

        try:
            with (
                exiting(signal.SIGINT, signal.SIGTERM, first=end_soon),
                sweep_progress(self._table, names, len(names) - len(to_do), progress),
            ):
                self._launch(to_do)
        except StopSweep:
            stopped = "stopped at the first failure"
        except SystemExit as end:
            code = 128 + received[0] if received else end.code if isinstance(end.code, int) else 1
            stopped = f"stopped by {signal_name(code - 128)}" if code > 128 else "stopped"
            _exit_within(_STOP_WITHIN, code)
        rows = self._repair(_STOPPED_END_WITHIN if stopped else _ORPHANS_END_WITHIN)
        asked = [rows[name] for name in names]
        console.tell_end(self._folder.path, asked, time.monotonic() - started, stopped, mistakes)
        return code or int(any(row.status != DONE for row in asked))

    def _launch(self, to_do: list[JobEntry]) -> None:
        """Run the jobs; where the launcher loses one's process, it is launched again for the others."""
        batches, count = [to_do], 0
        while batches:
            batch = batches.pop(0)
            if not batch:
                continue
            groups = self._divided(batch)
            try:
                jobs = lines(self._folder.path, groups, count, self._in_fork)
                results = self._launcher.launch(jobs, count)
            except Exception as error:
                batches = self._after_a_crash(batch, error) + batches
            else:
                self._settle(groups, results)
            count += len(batch)

    def _after_a_crash(self, batch: list[JobEntry], error: Exception) -> list[list[JobEntry]]:
        """The batches left to launch: first what had not begun, then, one by one, what was running.

        One of the latter ended its process, and perhaps the others'. Run alone, it shows which.
        """
        rows = self._repair()
        pending = [entry for entry in batch if rows[entry.job].status == PENDING]
        died = [entry for entry in batch if rows[entry.job].status == INTERRUPTED]
        if isinstance(error, OSError) and error.errno in _DISK_IS_FULL:
            raise error
        if len(batch) == 1:
            for entry in pending + died:
                self._fail(entry, f"its process was lost ({type(error).__name__})")
            return []
        if len(pending) == len(batch):
            if self._launcher_failed or isinstance(error, InputError):
                raise error  # the launcher itself does not work
            self._launcher_failed = True  # perhaps one worker was killed before its first job
            return [pending]
        return [pending, *([entry] for entry in died)]

    def _settle(self, groups: list[list[JobEntry]], results: Sequence[JobReturn]) -> None:
        """Note the launcher's results of jobs that could write none themselves.

        A job that was told to stop, or did not come to its turn, stays as it is for the next start.
        """
        rows = self._repair()  # the table itself may have been edited meanwhile, or deleted
        of_jobs = ((entry, result) for group, result in zip(groups, results, strict=True) for entry in group)
        for entry, result in of_jobs:
            row = rows[entry.job]
            if row.status not in (PENDING, INTERRUPTED):
                continue
            if isinstance(result._return_value, OSError):
                self._table.set(entry.job, error=one_line(reason(result._return_value)))
            elif result.status is not JobStatus.UNKNOWN:
                if not row.error:
                    self._fail(entry, f"it did not run ({result._return_value})")
            elif run_status(self._folder.path / entry.job) == "running":
                self._fail(entry, f"its process was lost ({result._return_value})")

    def _fail(self, entry: JobEntry, reason: str) -> None:
        mark_failed(self._folder.path / entry.job, reason)
        self._table.set(entry.job, status=FAILED, error=reason)

    def _repair(self, within: float = _ORPHANS_END_WITHIN) -> dict[str, JobRow]:
        """Repair the table once workers that lost their sweep have ended, `within` so many seconds."""
        end = time.monotonic() + within
        entries = self._folder.entries.values()
        while True:
            rows = self._table.repair(entries)
            if time.monotonic() >= end or all(row.status != RUNNING for row in rows.values()):
                return rows
            time.sleep(_POLL_SECONDS)


def _exit_within(seconds: float, code: int) -> None:
    timer = threading.Timer(seconds, os._exit, (code,))
    timer.daemon = True
    timer.start()
