"""A sweep from its command line to its exit code."""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path

from hydra.types import HydraContext
from omegaconf import DictConfig

from gridworld.config.sweep import SweepConfig
from gridworld.config.words import prepared
from gridworld.errors import InputError
from gridworld.process.console import ProgressLine, tell, time_left
from gridworld.process.processes import LostError, worker_count
from gridworld.process.signals import exiting, signal_name
from gridworld.run.folder import MANIFEST
from gridworld.sweep import console
from gridworld.sweep.configurations import Configurations
from gridworld.sweep.folder import STOP, SweepFolder
from gridworld.sweep.job import StopSweep, SweepJob, Worker, mark_failed, shared_part
from gridworld.sweep.job_table import DONE, FAILED, INTERRUPTED, PENDING, RUNNING, JobRow, JobTable
from gridworld.sweep.launchers import Group, Launch, launcher_settings, local
from gridworld.sweep.plan import Job, expand, plan, populations, runs_in_turn

_ORPHANS_END_WITHIN = 5.0  # seconds; workers of a sweep that was killed
_POLL_SECONDS = 0.1
_SECONDS_BETWEEN_LOOKS = 0.5
_MOST_NOTES = 4  # that are printed before the jobs begin
_OURS = 1  # of Hydra's callbacks
_SHARE_OF_TIME = 30  # looking after the jobs takes at most one thirtieth of it


def run_sweep(words: list[str], context: HydraContext, master: DictConfig, settings: SweepConfig) -> None:
    """Run the jobs that are asked for and not done yet."""
    folder = SweepFolder(Path(master.hydra.sweep.dir))
    launcher, own = launcher_settings(master)
    divide = partial(populations, settings=settings, launcher=launcher, own=own, hydra=master.hydra)
    divide([])  # finds a mistake
    words = [*_of_yaml(settings), *words]  # a word of the command line comes later, and counts
    loader = context.config_loader
    jobs = plan(expand(words, loader, settings.max_jobs, settings.paired), Configurations(loader, master))
    mistaken = [job for job in jobs if job.mistake is not None]
    if len(mistaken) == len(jobs) or (mistaken and settings.stop_at_first_failure):
        share = f" ({len(mistaken)} of {len(jobs)} jobs cannot run)" if len(jobs) > 1 else ""
        raise InputError(f"{mistaken[0].mistake}{share}")
    folder.check(jobs, settings.extend)
    counts = Counter(note for job in jobs for note in job.notes)
    for note, count in counts.most_common(_MOST_NOTES):
        tell(f"{note} ({count} of {len(jobs)} jobs)")
    if len(counts) > _MOST_NOTES:
        tell(f"and {len(counts) - _MOST_NOTES} more notes on other jobs")
    try:
        with folder.at_work():
            callbacks = context.callbacks if len(master.hydra.callbacks) > _OURS else None
            here = folder.path.absolute()
            worker = Worker(here, os.getcwd(), shared_part(master, here), callbacks)
            in_turn = callbacks is not None or runs_in_turn(settings, master.hydra)
            in_processes = launcher == "joblib" and not settings.stop_at_first_failure
            may_fork = {job.hash for job in jobs if job.in_fork and not in_turn and launcher == "forks"}

            def run(launch: Launch, is_second: bool) -> None:
                if launcher in ("slurm", "ray"):
                    import_module(f"gridworld.sweep.launchers.{launcher}").run(launch, own)
                    return
                local.run(
                    launch,
                    worker_count(own.get("n_jobs", 1)),
                    launcher == "forks",
                    lambda group: in_processes or group[0].hash in may_fork,
                    least=1 if is_second or in_processes else 2,
                )

            code = _Sweep(folder, jobs, words, worker).run(run, divide, settings.retry_failed)
    except ConnectionError:
        raise  # from a cluster, not from a disk
    except OSError as error:
        console.tell_stopped_by(error, folder.path)
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
    return prepared([f"{key}={value}" for key, value in settings.params.items()])


class _Sweep:
    """The jobs that are asked for in this folder, and what is known of them."""

    def __init__(
        self, folder: SweepFolder, jobs: Sequence[Job], words: Sequence[str], worker: Worker
    ) -> None:
        self._folder = folder
        self._jobs = jobs
        self._worker = worker
        self._names = {entry.hash: entry.job for entry in folder.add(jobs, words)}
        self._table = JobTable(folder.path)
        self._line = ProgressLine(any(job.config.logging.progress for job in jobs))
        self._rows: dict[str, JobRow] = {}
        # Rows with what no folder says: mistakes in the settings, a full disk.
        self._before = {job: row for job, row in self._table.read().items() if row.status == FAILED}
        for job in jobs:
            if job.mistake:
                self._before[self._names[job.hash]] = JobRow("", "", FAILED, error=job.mistake)
        self._lost: dict[str, str] = {}  # why a process was lost, by the hashes of its jobs
        self._begun = 0
        self._started = self._due = time.monotonic()
        self._ended_before = 0

    def run(
        self,
        run: Callable[[Launch, bool], None],
        divide: Callable[[Sequence[Job]], list[list[Job]]],
        retry_failed: bool,
    ) -> int:
        """Run the jobs to do, and print how they ended; returns the exit code."""
        self._look(_ORPHANS_END_WITHIN)
        statuses = {PENDING, INTERRUPTED} | ({FAILED} if retry_failed else set())
        to_do = [job for job in self._jobs if not job.mistake and self._row(job).status in statuses]
        self._ended_before = len(self._jobs) - len(to_do)
        console.tell_start(self._folder.path, [self._row(job) for job in self._jobs], len(to_do))
        stopped, code = "", 0
        received: list[int] = []  # signals; Ray may change the exception that one raises
        try:
            with exiting(signal.SIGINT, signal.SIGTERM, first=received.append):
                if to_do:
                    run(self._launch(divide(to_do)), False)
                if self._lost:
                    self._run_lost(run, to_do)
        except StopSweep:
            stopped = "stopped at the first failure"
        except SystemExit as end:
            code = 128 + received[0] if received else end.code if isinstance(end.code, int) else 1
            stopped = f"stopped by {signal_name(code - 128)}" if code > 128 else "stopped"
        finally:
            self._line.clear()
        self._look(_ORPHANS_END_WITHIN)
        rows = {self._names[job.hash]: self._row(job) for job in self._jobs}
        seconds = time.monotonic() - self._started
        mistaken = [self._names[job.hash] for job in self._jobs if job.mistake]
        console.tell_end(self._folder.path, list(rows.values()), seconds, stopped, mistaken)
        return code or int(any(row.status != DONE for row in rows.values()))

    def _run_lost(self, run: Callable[[Launch, bool], None], to_do: Sequence[Job]) -> None:
        """Run again, each by itself, what was at work in a lost process; what is lost again has failed."""
        self._look(_ORPHANS_END_WITHIN)
        lost, self._lost = self._lost, {}
        again = [job for job in to_do if job.hash in lost and self._row(job).status in (PENDING, INTERRUPTED)]
        run(self._launch([[job] for job in again]), True)
        self._look(_ORPHANS_END_WITHIN)
        for job in again:
            if job.hash in self._lost and self._row(job).status in (PENDING, INTERRUPTED):
                why = f"its process was lost ({self._lost[job.hash]})"
                mark_failed(self._folder.path / self._names[job.hash], why)

    def _launch(self, groups: Sequence[Sequence[Job]]) -> Launch:
        folder = self._folder.path.absolute()
        found: list[list[SweepJob]] = []
        for group in groups:
            found.append([])
            for job in group:
                row = self._rows.pop(self._names[job.hash])
                self._before.pop(row.job, None)
                replaces = row.status == FAILED
                path = folder / row.job
                own = SweepJob(path, self._begun, job.hash, job.config, job.overrides, replaces)
                found[-1].append(own)
                self._begun += 1
        return Launch(self._worker, found, folder / STOP, self._note, self._tick)

    def _note(self, jobs: Group, errors: list[str] | LostError) -> None:
        if isinstance(errors, LostError):
            self._lost |= dict.fromkeys([job.hash for job in jobs], str(errors))
            return
        for job, error in zip(jobs, errors, strict=False):  # there are fewer where it was told to stop
            if error:
                status = INTERRUPTED if (job.folder / MANIFEST).exists() else PENDING
                self._before[job.folder.name] = JobRow("", "", status, error=error)

    def _row(self, job: Job) -> JobRow:
        return self._rows[self._names[job.hash]]

    def _look(self, within: float) -> None:
        """Write the table once workers that lost their sweep have ended, `within` so many seconds."""
        end = time.monotonic() + within
        while True:
            self._rows = self._table.inspect(self._folder.entries.values(), self._before)
            if time.monotonic() >= end or all(row.status != RUNNING for row in self._rows.values()):
                break
            time.sleep(_POLL_SECONDS)
        self._table.write(self._rows)

    def _tick(self) -> None:
        """Write the table anew, and the line on the terminal, once in a while."""
        began = time.monotonic()
        if began < self._due:
            return
        ended = {job: row for job, row in self._rows.items() if row.status in (DONE, FAILED)}
        with contextlib.suppress(OSError):
            rows = self._table.inspect(self._folder.entries.values(), self._before, ended)
            if rows != self._rows:
                self._table.write(rows)
            self._rows = rows
            counts = Counter(self._row(job).status for job in self._jobs)
            self._line.show(lambda: self._text(counts))
        self._due = time.monotonic() + max(
            _SECONDS_BETWEEN_LOOKS, _SHARE_OF_TIME * (time.monotonic() - began)
        )

    def _text(self, counts: Counter[str]) -> str:
        ended = counts[DONE] + counts[FAILED]
        failed = f", {counts[FAILED]} failed" if counts[FAILED] else ""
        left = time_left(
            ended - self._ended_before, len(self._jobs) - ended, time.monotonic() - self._started
        )
        return (
            f"sweep: {counts[DONE]} of {len(self._jobs)} jobs done, {counts[RUNNING]} running{failed}{left}"
        )
