"""Populations on a Ray cluster, a task each. Ray keeps a worker's process, and with it its imports."""

from __future__ import annotations

import logging
import signal
import sys
from collections.abc import Mapping
from typing import Any

import ray
from ray.exceptions import RayError, TaskCancelledError

from gridworld.base.errors import InputError
from gridworld.base.processes import LostError
from gridworld.base.signals import handling
from gridworld.sweeps.job import Worker
from gridworld.sweeps.launchers import Launch, collect

_ENDED_WITHIN = 1.0  # seconds


def run(launch: Launch, settings: Mapping[str, Any]) -> None:
    """Run populations; see `run_groups`."""
    _connect(settings["init"])
    remote = ray.remote(**settings["remote"]) if settings["remote"] else ray.remote
    function, worker = remote(Worker.on_node), ray.put(launch.worker)
    tasks = {function.remote(worker, [list(jobs)]): jobs for jobs in launch.groups}
    try:
        collect(launch, tasks, lambda task: not _wait_for([task], 0), _result)
    except BaseException:
        left = _wait_for(list(tasks), 0)
        for task in left:
            ray.cancel(task)
        if left:
            _wait_for(left, _ENDED_WITHIN)
        print(f"ray: {len(left)} tasks cancelled", file=sys.stderr, flush=True)
        raise


def _result(task: Any) -> list[str]:
    try:
        errors: list[str] = ray.get(task)
    except TaskCancelledError:
        return []
    except RayError as error:
        raise LostError(type(error).__name__) from None
    return errors


def _wait_for(tasks: list[Any], seconds: float) -> list[Any]:
    """The tasks that have not ended within so many seconds."""
    return list(ray.wait(tasks, num_returns=len(tasks), timeout=seconds)[1])


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
            f"({first}); start one with 'ray start --head', or from the sweep with address=local"
        ) from None
