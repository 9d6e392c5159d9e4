"""Jobs side by side on this machine, in joblib's worker processes.

hydra-joblib-launcher does the same, but sends the whole state of Hydra along with each job and looks for
plugins again before each: with runs this short it took 40 % more processor time. Here a worker gets the state
once.
"""

from __future__ import annotations

import functools
import gc
import os
import signal
from collections.abc import Sequence

import cloudpickle
from hydra.core.singleton import Singleton
from hydra.core.utils import JobReturn, run_job, setup_globals
from hydra.types import HydraContext, TaskFunction
from joblib import Parallel, delayed
from omegaconf import DictConfig, open_dict

from gridworld.process import end_with, parent_died


def launch(
    context: HydraContext,
    task: TaskFunction,
    config: DictConfig,
    n_jobs: int,
    jobs: Sequence[Sequence[str]],
    first: int,
) -> list[JobReturn]:
    """Run jobs, numbered from `first`, with `n_jobs` at a time; returns what each came to, in order."""
    state = cloudpickle.dumps((os.getpid(), Singleton.get_state(), context, task, config))
    return list(
        Parallel(n_jobs=n_jobs, backend="loky", batch_size=1)(
            delayed(_run)(state, list(overrides), number) for number, overrides in enumerate(jobs, first)
        )
    )


def _run(state: bytes, overrides: list[str], number: int) -> JobReturn:
    context, task, master = _arrive(state)
    config = context.config_loader.load_sweep_config(master, overrides)
    with open_dict(config):
        config.hydra.job.id = f"{config.hydra.job.name}_{number}"
        config.hydra.job.num = number
    try:
        result = run_job(
            hydra_context=context,
            task_function=task,
            config=config,
            job_dir_key="hydra.sweep.dir",
            job_subdir_key="hydra.sweep.subdir",
        )
    except SystemExit:
        if parent_died.is_set():
            os._exit(1)  # nobody is there to take the result; waiting for that would take seconds
        raise
    result.cfg = result.hydra_cfg = None  # nobody asks for them, and they would pile up
    _spare_the_collector()
    return result


@functools.cache
def _spare_the_collector() -> None:
    """Once, after the first job: loky collects garbage every second, which need not walk through torch."""
    gc.collect()
    gc.freeze()


@functools.lru_cache(maxsize=1)
def _arrive(state: bytes) -> tuple[HydraContext, TaskFunction, DictConfig]:
    """Make this process a worker of the sweep whose state this is."""
    parent, singletons, context, task, master = cloudpickle.loads(state)
    if parent != os.getpid():  # which it is when there is one worker only
        end_with(parent)
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the parent too, which knows what to do
        setup_globals()
        Singleton.set_state(singletons)
    return context, task, master
