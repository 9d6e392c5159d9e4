"""The jobs of a sweep in the process that they run in: one job, and a population of them."""

from __future__ import annotations

import contextlib
import dataclasses
import math
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
from gridworld.config.train import AUTO, TrainConfig
from gridworld.run.folder import ERROR_FILE, LOCK, MANIFEST
from gridworld.run.reader import find_run, is_started
from gridworld.run.writer import clear, record_failure
from gridworld.sweeps.folder import one_line
from gridworld.sweeps.plan import Job
from gridworld.training.resume import unfinished_of
from gridworld.training.together import Training, run_together
from gridworld.training.train import training

_Dumper = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
_UNFINISHED = ("running", "interrupted")  # statuses of runs that were stopped from outside


class JobError(Exception):
    """The job failed, or could not go on; its folder says which."""


def run_in_sweep(
    config: TrainConfig, folder: Path, overrides: list[str], replaces: bool = False
) -> Training[float]:
    """Train in the job's folder, unless that is done or another process does it.

    An interrupted run goes on from its checkpoint; a failed one is replaced.
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
        with contextlib.suppress(OSError):
            mark_failed(folder, why, "" if isinstance(error, InputError) else traceback.format_exc())
        raise JobError(why) from None


def run_status(folder: Path) -> str:
    """The status of the run in a folder: "" where none has begun, "failed" for a damaged manifest."""
    try:
        run = find_run(folder)
    except InputError:
        return "failed"
    return "" if run is None else str(run.manifest["status"])


def mark_failed(folder: Path, why: str, trace: str = "") -> None:
    """Note why the job failed, unless its run did: in the manifest, or where there is none in a file."""
    run = None
    with contextlib.suppress(InputError):  # a damaged manifest is left as it is
        run = find_run(folder)
        if run is not None and run.manifest["status"] in _UNFINISHED:
            record_failure(run, why)
    if run is None:
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

    def _run(self, job: Job) -> Training[float]:
        subfolder = self.master.hydra.output_subdir
        job.folder.mkdir(parents=True, exist_ok=True)
        if subfolder is not None:
            _save(job, job.folder / subfolder)
        with called_from(Path(self.where)):
            return (yield from run_in_sweep(job.config, job.folder, list(job.overrides), job.replaces))


def _save(job: Job, folder: Path) -> None:
    """Write the job's settings and overrides, as Hydra does for a single run."""
    folder.mkdir(exist_ok=True)
    for name, content in (("config", dataclasses.asdict(job.config)), ("overrides", list(job.overrides))):
        text = yaml.dump(content, Dumper=_Dumper, sort_keys=False, allow_unicode=True)
        (folder / f"{name}.yaml").write_text(text, encoding="utf-8")
