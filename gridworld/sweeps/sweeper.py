"""A sweep from its command line to its exit code."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import signal
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra.types import HydraContext
from omegaconf import DictConfig, open_dict, read_write

from gridworld.base.atomic_write import inside, write_text
from gridworld.base.console import ProgressLine, tell, tell_error, time_left
from gridworld.base.errors import InputError, reason
from gridworld.base.processes import LostError
from gridworld.base.signals import exiting, signal_name
from gridworld.config.sweep import SweepConfig
from gridworld.config.words import prepared
from gridworld.run.folder import ERROR_FILE, shell_path
from gridworld.sweeps import console
from gridworld.sweeps.folder import DONE, FAILED, INTERRUPTED, PENDING, RUNNING, JobRow, SweepFolder
from gridworld.sweeps.job import Worker, mark_failed, run_status
from gridworld.sweeps.launchers import Group, Launch, launcher_settings, run_groups
from gridworld.sweeps.plan import Configurations, Job, expand, largest_population, plan, populations

_ORPHANS_END_WITHIN = 5.0  # seconds; workers of a sweep that was killed
_POLL_SECONDS = 0.1
_SECONDS_BETWEEN_LOOKS = 0.5
_MOST_NOTES = 4  # that are printed before the jobs begin
_SHARE_OF_TIME = 30  # looking after the jobs takes at most one thirtieth of it


def run_sweep(words: list[str], context: HydraContext, master: DictConfig, settings: SweepConfig) -> None:
    """Run the jobs that are asked for and not done yet."""
    folder = SweepFolder(Path(master.hydra.sweep.dir))
    launcher, own = launcher_settings(master)
    if master.hydra.job.chdir:
        raise InputError("hydra.job.chdir=true: is for a single run; the jobs of a sweep train together")
    most = largest_population(settings.population)
    words = [*_of_yaml(settings), *words]  # a word of the command line comes later, and counts
    loader = context.config_loader
    jobs = plan(expand(words, loader, settings.max_jobs, settings.paired), Configurations(loader, master))
    mistaken = [job for job in jobs if job.mistake is not None]
    if len(mistaken) == len(jobs):
        share = f" ({len(mistaken)} of {len(jobs)} jobs cannot run)" if len(jobs) > 1 else ""
        raise InputError(f"{mistaken[0].mistake}{share}")
    folder.check(jobs, settings.extend)
    for note, count in Counter(note for job in jobs for note in job.notes).most_common(_MOST_NOTES):
        tell(f"{note} ({count} of {len(jobs)} jobs)")
    try:
        with folder.at_work():
            here = folder.path.absolute()
            with read_write(master.hydra.runtime), open_dict(master.hydra.runtime):
                master.hydra.runtime.output_dir = str(here)  # for `hydra.job_logging`
            worker = Worker(here, os.getcwd(), master)
            code = _Sweep(folder, jobs, words, worker, launcher, own).run(most, settings.retry_failed)
    except ConnectionError:
        raise  # from a cluster, not from a disk
    except OSError as error:
        again = console.resume_command(folder.path)
        where = shell_path(folder.path)
        tell_error(f"{where}: {reason(error)}; fix that, then resume with: {again}")
        code = 1
    if code:
        raise SystemExit(code)


def _of_yaml(settings: SweepConfig) -> list[str]:
    """`hydra.sweeper.params` as words of a command line, as Hydra's own sweeper reads it."""
    for key, value in settings.params.items():
        if not isinstance(value, str | int | float):
            raise InputError(
                f"hydra.sweeper.params.{key}: must be text as on the command line, such as 0,1 or range(3)"
            )
    return prepared([f"{key}={value}" for key, value in settings.params.items()], of_many=True)


class _Sweep:
    """The jobs that are asked for in this folder, and what is known of them."""

    def __init__(
        self,
        folder: SweepFolder,
        jobs: Sequence[Job],
        words: Sequence[str],
        worker: Worker,
        launcher: str,
        own: Mapping[str, Any],
    ) -> None:
        self._folder, self._jobs, self._worker = folder, folder.add(jobs, words), worker
        self._launcher, self._own = launcher, own  # and its settings
        # Why jobs do not go on, as far as their folders do not say it: a full disk, a mistake.
        self._reasons = {job.folder.name: job.mistake for job in self._jobs if job.mistake}
        self._rows: dict[str, JobRow] = {}  # by the names of their folders
        self._line = ProgressLine(any(job.config.logging.progress for job in jobs))
        self._started = self._due = time.monotonic()
        self._ended_before = 0

    def run(self, most: int | None, retry_failed: bool) -> int:
        """Run the jobs to do, at most so many as one, and print how they ended; returns the exit code."""
        for name, mistake in self._reasons.items():
            folder = inside(self._folder.path, name)
            if not run_status(folder):
                folder.mkdir(exist_ok=True)
                write_text(folder / ERROR_FILE, f"{mistake}\n")
        self._look()
        statuses = {PENDING, INTERRUPTED} | ({FAILED} if retry_failed else set())
        to_do = [job for job in self._jobs if not job.mistake and self._row(job).status in statuses]
        self._ended_before = len(self._jobs) - len(to_do)
        console.tell_start(self._folder.path, [self._row(job) for job in self._jobs], len(to_do))
        stopped, code = "", 0
        received: list[int] = []  # signals; Ray may change the exception that one raises
        try:
            with exiting(signal.SIGINT, signal.SIGTERM, first=received.append):
                groups = populations(to_do, most, self._launcher, self._own)
                if groups and (lost := self._launch(groups)):
                    self._run_lost([job for job in to_do if job.hash in lost])
        except SystemExit as end:
            code = 128 + received[0] if received else end.code if isinstance(end.code, int) else 1
            stopped = f"stopped by {signal_name(code - 128)}" if code > 128 else "stopped"
        finally:
            self._line.clear()
        self._look()
        rows = [self._row(job) for job in self._jobs]
        seconds = time.monotonic() - self._started
        mistaken = [job.folder.name for job in self._jobs if job.mistake]
        console.tell_end(self._folder.path, rows, seconds, stopped, mistaken)
        return code or int(any(row.status != DONE for row in rows))

    def _run_lost(self, jobs: Sequence[Job]) -> None:
        """Run again, each by itself, what was at work in a lost process; what is lost again has failed."""
        self._look()
        lost = self._launch([[job] for job in jobs if self._row(job).status in (PENDING, INTERRUPTED)])
        self._look()
        for job in jobs:
            if job.hash in lost and self._row(job).status in (PENDING, INTERRUPTED):
                mark_failed(job.folder, f"its process died ({lost[job.hash]})")

    def _launch(self, groups: Sequence[Sequence[Job]]) -> dict[str, str]:
        """Run populations; returns why a process was lost, by the hashes of its jobs."""
        lost: dict[str, str] = {}

        def ended(jobs: Group, errors: list[str] | LostError) -> None:
            if isinstance(errors, LostError):
                lost.update(dict.fromkeys([job.hash for job in jobs], str(errors)))
                return
            for job, error in zip(jobs, errors, strict=False):  # there are fewer where it was told to stop
                self._reasons[job.folder.name] = error

        def begun(job: Job) -> Job:
            return dataclasses.replace(job, replaces=self._rows.pop(job.folder.name).status == FAILED)

        found = [list(map(begun, group)) for group in groups]
        run_groups(Launch(self._worker, found, ended, self._tick), self._launcher, self._own)
        return lost

    def _row(self, job: Job) -> JobRow:
        return self._rows[job.folder.name]

    def _look(self) -> None:
        """Write the table once workers that lost their sweep have ended, if they do soon."""
        end = time.monotonic() + _ORPHANS_END_WITHIN
        self._rows = self._folder.rows(self._reasons)
        while time.monotonic() < end and any(row.status == RUNNING for row in self._rows.values()):
            time.sleep(_POLL_SECONDS)
            self._rows = self._folder.rows(self._reasons)
        self._folder.write(self._rows)

    def _tick(self) -> None:
        """Write the table anew, and the line on the terminal, once in a while."""
        began = time.monotonic()
        if began < self._due:
            return
        ended = {job: row for job, row in self._rows.items() if row.status in (DONE, FAILED)}
        with contextlib.suppress(OSError):
            rows = self._folder.rows(self._reasons, ended)
            if rows != self._rows:
                self._folder.write(rows)
            self._rows = rows
            counts = Counter(self._row(job).status for job in self._jobs)
            self._line.show(lambda: self._text(counts))
        self._due = time.monotonic() + max(
            _SECONDS_BETWEEN_LOOKS, _SHARE_OF_TIME * (time.monotonic() - began)
        )

    def _text(self, counts: Counter[str]) -> str:
        jobs, ended = len(self._jobs), counts[DONE] + counts[FAILED]
        failed = f", {counts[FAILED]} failed" if counts[FAILED] else ""
        left = time_left(ended - self._ended_before, jobs - ended, time.monotonic() - self._started)
        return f"sweep: {counts[DONE]} of {jobs} jobs done, {counts[RUNNING]} running{failed}{left}"
