"""Populations on a Ray cluster, a task each. Ray keeps a worker's process, and with it its imports."""

from __future__ import annotations

import logging
import signal
import sys
from collections.abc import Mapping
from typing import Any

import ray
from ray.exceptions import RayError, TaskCancelledError

from gridworld.errors import InputError
from gridworld.process.processes import LostError
from gridworld.process.signals import handling
from gridworld.sweep.job import StopSweep, SweepJob, Worker
from gridworld.sweep.launchers import Group, Launch, Task, collect

_POLL_SECONDS = 1.0
_ENDED_WITHIN = 1.0  # seconds


class RayTask:
    """A population's task."""

    def __init__(self, reference: Any) -> None:
        self.reference = reference

    def done(self) -> bool:
        """See `Task`."""
        return bool(ray.wait([self.reference], timeout=0)[0])

    def result(self) -> list[str]:
        """See `Task`."""
        try:
            errors: list[str] = ray.get(self.reference)
        except TaskCancelledError:
            return []
        except RayError as error:
            raise LostError(type(error).__name__) from None
        return errors


def run(launch: Launch, settings: Mapping[str, Any]) -> None:
    """Run populations. Raises as `launchers.local.run`, and `InputError` where there is no Ray."""
    _connect(settings["init"])
    remote = ray.remote(**settings["remote"]) if settings["remote"] else ray.remote
    function, worker = remote(_run), ray.put(launch.worker)
    own = [RayTask(function.remote(worker, list(jobs))) for jobs in launch.groups]
    tasks: dict[Task, Group] = dict(zip(own, launch.groups, strict=True))
    try:
        collect(launch, tasks, _POLL_SECONDS)
    except StopSweep:
        # Tasks that wait see the file and end by themselves. Ray's own process is aborted where a task is
        # cancelled in the moment in which it ends.
        _cancel(_not_ended(own))
        raise
    except BaseException:
        _cancel([task.reference for task in own if not task.done()])
        raise


def _run(worker: Worker, jobs: list[SweepJob]) -> list[str]:
    return worker.on_node([jobs])


def _not_ended(tasks: list[RayTask]) -> list[Any]:
    references = [task.reference for task in tasks]
    return list(ray.wait(references, num_returns=len(references), timeout=_ENDED_WITHIN)[1])


def _cancel(references: list[Any]) -> None:
    for reference in references:
        ray.cancel(reference)
    if references:
        ray.wait(references, num_returns=len(references), timeout=_ENDED_WITHIN)
    print(f"ray: {len(references)} tasks cancelled", file=sys.stderr, flush=True)


def _connect(arguments: dict[str, Any]) -> None:
    if ray.is_initialized():
        return
    try:
        own = signal.getsignal(signal.SIGTERM)  # in whose place Ray puts another
        with handling({signal.SIGTERM: own}):
            ray.init(**{"logging_level": logging.WARNING, "log_to_driver": False, **arguments})
    except (ConnectionError, RuntimeError, ValueError, TypeError) as error:
        first = (str(error).strip().splitlines() or [type(error).__name__])[0].rstrip(".")
        raise InputError(
            f"hydra/launcher=ray: no Ray at hydra.launcher.init.address={arguments.get('address')} "
            f"({first}); start one with 'ray start --head', or let the sweep do it with address=local"
        ) from None
