"""Jobs in a worker's process, on a core of this machine or a node of a cluster.

The process gets Hydra's state once, in one piece; Hydra's own launchers send it with each job.
"""

from __future__ import annotations

import functools
import os
import pickle
import signal
import uuid
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from hydra.core.singleton import Singleton
from hydra.core.utils import JobReturn, JobStatus, setup_globals
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, open_dict

from gridworld.process.signals import exiting, handling, send_sigterm
from gridworld.storage.atomic_write import write_bytes
from gridworld.sweep.folder import STOP
from gridworld.sweep.hydra_job import job
from gridworld.sweep.job import StopSweep
from gridworld.training.together import Training, run_alone

_THIS_PROCESS = uuid.uuid4().hex  # a number would not do: on another machine it may be in use too


@dataclass(frozen=True)
class JobRunner:
    """Runs jobs with what Hydra gives to a launcher."""

    context: HydraContext
    task: TaskFunction
    config: DictConfig

    @property
    def sweep(self) -> Path:
        """The sweep's folder."""
        return Path(self.config.hydra.sweep.dir).absolute()

    def packed(self) -> bytes:
        """This runner and Hydra's state, for `unpack` in another process."""
        import cloudpickle  # here, since a sweep in one process needs none

        return bytes(cloudpickle.dumps((_THIS_PROCESS, os.getcwd(), Singleton.get_state(), self)))

    def run(self, overrides: Sequence[str], number: int) -> JobReturn:
        """Run a job, see `job`."""
        return run_alone(self.job(overrides, number))

    def job(
        self, overrides: Sequence[str], number: int, configures_logging: bool = True
    ) -> Training[JobReturn]:
        """Run a job.

        Args:
            overrides: the job's.
            number: the job's, `hydra.job.num`.
            configures_logging: as the settings have it; not for a job among others that are at work.

        Returns:
            What it came to; an `Exception` that it raised is in there.

        Raises:
            SystemExit: the job was interrupted.
            StopSweep: the job failed, and that is to stop the sweep.
        """
        config = self.context.config_loader.load_sweep_config(self.config, list(overrides))
        with open_dict(config):
            config.hydra.job.id = f"{config.hydra.job.name}_{number}"
            config.hydra.job.num = number
        return job(
            hydra_context=self.context,
            task_function=self.task,
            config=config,
            job_dir_key="hydra.sweep.dir",
            job_subdir_key="hydra.sweep.subdir",
            configures_logging=configures_logging,
        )


@functools.lru_cache(maxsize=1)
def unpack(state: bytes) -> JobRunner:
    """Make this process a worker of the sweep that `JobRunner.packed` is from; returns its runner."""
    origin, folder, singletons, runner = pickle.loads(state)
    if origin != _THIS_PROCESS:  # the same where a launcher runs a job itself
        os.chdir(folder)  # map files may be named from there
        setup_globals()
        Singleton.set_state(singletons)
    assert isinstance(runner, JobRunner)
    return runner


def run_in_turn(state: bytes, sweep: Path, jobs: Sequence[Sequence[str]], first: int) -> list[str]:
    """Run jobs one after the other on a node of a cluster.

    Args:
        state: what `JobRunner.packed` returned.
        sweep: the sweep's folder.
        jobs: the overrides of each.
        first: the first job's number.

    Returns:
        The error of each job, or "". There are fewer where the process or the sweep was told to stop.
    """
    errors: list[str] = []
    try:
        # While training is on, it handles SIGTERM itself. SIGUSR2 is Slurm's warning of its time limit.
        warning = {signal.SIGUSR2: send_sigterm} if hasattr(signal, "SIGUSR2") else {}
        with exiting(signal.SIGTERM), handling(warning):
            runner = unpack(state)
            for number, overrides in enumerate(jobs, first):
                if (sweep / STOP).exists():
                    break
                result = runner.run(overrides, number)
                errors.append("" if result.status is JobStatus.COMPLETED else str(result._return_value))
    except StopSweep:
        write_bytes(sweep / STOP, b"")  # for those that wait in a queue
    except (SystemExit, KeyboardInterrupt):
        pass
    return errors
