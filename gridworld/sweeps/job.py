"""The jobs of a sweep in the process that they run in: one job, and a population of them."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import signal
import sys
import traceback
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import yaml
from hydra.core.utils import configure_log
from omegaconf import DictConfig

from gridworld.base.atomic_write import locked, write_text
from gridworld.base.console import prepare
from gridworld.base.errors import FolderLostError, InputError, MachineError, reason
from gridworld.base.signals import Interrupted, exiting, handling, send_sigterm
from gridworld.base.together import mixing
from gridworld.base.user_input import called_from
from gridworld.config.train import AUTO
from gridworld.run.folder import ERROR_FILE, LOCK, MANIFEST
from gridworld.run.reader import find_run, is_started, read_run
from gridworld.run.writer import clear, record_failure
from gridworld.sweeps.folder import one_line
from gridworld.sweeps.plan import Job
from gridworld.training.resume import unfinished_of
from gridworld.training.together import Training, run_together
from gridworld.training.train import training

_Dumper = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
_UNFINISHED = ("running", "interrupted")  # statuses of runs that were stopped from outside


def run_in_sweep(job: Job) -> Training[None]:
    """Train in the job's folder, unless that is done or another process does it.

    An interrupted run goes on from its checkpoint; a failed one is replaced. Raises why the job failed, which
    its folder has too, or could not go on.
    """
    folder, config = job.folder, job.config
    quiet = replace(config, logging=replace(config.logging, progress=False))  # the sweep has its own line
    try:
        with locked(folder / LOCK, wait=1) as is_ours:
            if not is_ours or ((status := run_status(folder)) == "finished" and not job.replaces):
                return
            if status not in _UNFINISHED:
                (folder / MANIFEST).unlink(missing_ok=True)
                clear(folder)
            if is_started(folder):
                yield from unfinished_of(folder, quiet).resumption()
            else:
                yield from training(quiet, folder, list(job.overrides))
    except Interrupted as interruption:
        sys.exit(interruption.exit_code)
    except (OSError, MachineError, FolderLostError):
        raise  # the job itself is right, and goes on later
    except Exception as error:
        trace = "" if isinstance(error, InputError) else traceback.format_exc()
        with contextlib.suppress(OSError):
            mark_failed(folder, one_line(reason(error)), trace)
        raise


def run_status(folder: Path) -> str:
    """The status of the run in a folder: "" where none has begun, "failed" for a damaged manifest."""
    try:
        run = find_run(folder)
    except InputError:
        return "failed"
    return "" if run is None else str(run.manifest["status"])


def mark_failed(folder: Path, why: str, trace: str = "") -> None:
    """Note why the job failed, unless its run did: in the manifest, or where there is none in a file."""
    status = run_status(folder)
    if status in _UNFINISHED:
        record_failure(read_run(folder), why)
    elif not status:
        write_text(folder / ERROR_FILE, f"{why}\n{trace}")


@dataclass(frozen=True)
class Worker:
    """Runs populations."""

    sweep: Path  # its folder
    where: str  # the folder that the command was typed in
    master: DictConfig  # the configuration of the sweep itself

    def __call__(self, jobs: Sequence[Job]) -> list[str]:
        """Run the jobs of a population; returns the error of each, or ""."""
        prepare()
        os.environ.update(self.master.hydra.job.env_set)
        configure_log(self.master.hydra.job_logging, self.master.hydra.verbose)
        config = jobs[0].config  # all have one device
        asked = self.master.hydra.sweeper.population != AUTO and len(jobs) > 1
        depend = asked and not config.agent.on_processor(config.device)
        with mixing({job.folder.name: job.hash for job in jobs} if depend else {}):
            results = run_together([self._run(job) for job in jobs])
        return [one_line(reason(result)) if isinstance(result, Exception) else "" for result in results]

    def on_node(self, groups: Sequence[Sequence[Job]]) -> list[str]:
        """Run populations one after the other on a node of a cluster."""
        errors: list[str] = []
        # SIGUSR2 is Slurm's warning of its time limit. While training is on, it handles SIGTERM itself.
        warning = {signal.SIGUSR2: send_sigterm}
        try:
            with exiting(signal.SIGTERM), handling(warning), contextlib.chdir(self.where):
                for jobs in groups:
                    errors += self(jobs)
        except (SystemExit, KeyboardInterrupt):
            pass
        return errors

    def _run(self, job: Job) -> Training[None]:
        subfolder = self.master.hydra.output_subdir
        job.folder.mkdir(parents=True, exist_ok=True)
        if subfolder is not None:
            _save(job, job.folder / subfolder)
        with called_from(Path(self.where)):
            yield from run_in_sweep(job)


def _save(job: Job, folder: Path) -> None:
    """Write the job's settings and overrides, as Hydra does for a single run."""
    folder.mkdir(exist_ok=True)
    for name, content in (("config", dataclasses.asdict(job.config)), ("overrides", list(job.overrides))):
        text = yaml.dump(content, Dumper=_Dumper, sort_keys=False, allow_unicode=True)
        (folder / f"{name}.yaml").write_text(text, encoding="utf-8")
