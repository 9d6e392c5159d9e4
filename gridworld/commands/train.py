"""`train`: Hydra composes the settings, and a run or a sweep starts with them as dataclasses."""

from __future__ import annotations

import contextlib
import os
import sys
import threading
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, cast

from hydra.core.hydra_config import HydraConfig
from hydra.core.utils import JobReturn
from hydra.errors import CompactHydraException
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gridworld.commands import run
from gridworld.commands.manual import manual
from gridworld.commands.output_folder import check_settings_of, check_sweep_folder, run_folder
from gridworld.config.composition.compose import register_schemas, to_config
from gridworld.config.composition.conf_folder import conf_folder, own_conf_folders
from gridworld.config.composition.hydra_errors import sentence, unreadable_file
from gridworld.config.composition.loader import run_hydra
from gridworld.config.composition.words import refuse_dashes
from gridworld.config.train import TrainConfig
from gridworld.errors import EXIT_CODE, FolderLostError, InputError
from gridworld.process.console.command_line import called_from
from gridworld.process.console.terminal import prepare, printable, printing, result_is_in_files, tell_error
from gridworld.process.early_signals import AtWork
from gridworld.process.memory_budget import collect_less_often
from gridworld.run.claim import claimed
from gridworld.run.folder import SWEEP_JSON, shown
from gridworld.storage.file_lock import check_ours
from gridworld.storage.safe_read import check_yaml
from gridworld.training.together import Training, run_alone

FULL_ERROR = "HYDRA_FULL_ERROR"
_job_started = threading.Event()  # set when this process starts its first job
_at_end = contextlib.ExitStack()  # lets go of a single run's folder, sums a sweep up


class JobError(CompactHydraException):
    """A job's mistake, which Hydra reports without a traceback."""


class RefuseUsedFolders(Callback):
    """Checks the output folder before Hydra writes to it, and ends the program if it cannot be used."""

    def on_job_end(self, config: DictConfig, job_return: JobReturn, **kwargs: Any) -> None:
        """Release the configurations, which a launcher would keep of every job until the sweep ends."""
        job_return.cfg = job_return.hydra_cfg = None

    def on_run_start(self, config: DictConfig, **kwargs: Any) -> None:
        result_is_in_files()
        _exit_on_error(lambda: _claim_run_folder(config))

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        result_is_in_files()
        _exit_on_error(lambda: check_sweep_folder(config))
        _at_end.push(partial(_sum_up, Path(config.hydra.sweep.dir)))


def _sum_up(sweep: Path, kind: object, error: BaseException | None, trace: object) -> None:
    """Write a sweep's curves over seeds for TensorBoard, unless the sweep was stopped or refused."""
    is_over = error is None or (isinstance(error, SystemExit) and error.code in (0, 1))
    if not is_over or not (sweep / SWEEP_JSON).exists():
        return
    from gridworld.report.writer import write_over_seeds

    if (folder := write_over_seeds(sweep, sweep)) is not None:
        print(f"  over seeds: {printable(shown(folder))}, beside the jobs in TensorBoard")


def _exit_on_error(check: Callable[[], None]) -> None:
    try:
        check()
    except (InputError, OSError, OmegaConfBaseException) as error:
        sys.exit(_tell(error))


def _claim_run_folder(config: DictConfig) -> None:
    _at_end.enter_context(run_folder(config))
    check_settings_of(config)


def main() -> None:
    """Run the command line in `sys.argv`."""
    conf = conf_folder()
    collect_less_often()
    prepare()
    if {"--help", "-h"} & set(sys.argv[1:]):
        run(lambda _: print(manual(conf)))
        return
    try:
        refuse_dashes(sys.argv[1:])
    except InputError as error:
        sys.exit(_tell(error))
    if any(word.startswith("resume=") for word in sys.argv[1:]):
        from gridworld.commands import resume

        run(resume.main)
        return
    register_schemas()
    asked_for_traceback = FULL_ERROR in os.environ
    os.environ[FULL_ERROR] = "1"  # so that Hydra raises its errors instead of printing them
    try:
        with AtWork(), printing(), _at_end:
            _expand_recipe()
            for folder in own_conf_folders(sys.argv[1:]):
                check_yaml(folder)
            run_hydra(run_job, conf)
    except Exception as error:
        # Until a job starts, whatever goes wrong is the command line's or a yaml file's fault.
        mistake = isinstance(error, CompactHydraException) or not _job_started.is_set()
        if asked_for_traceback or not mistake:
            raise
        if isinstance(error, UnicodeDecodeError | RecursionError):
            told = unreadable_file(error, [conf, *own_conf_folders(sys.argv[1:])])
            error = error if told is None else InputError(told)
        sys.exit(_tell(error))
    except KeyboardInterrupt:
        print("interrupted before training began", file=sys.stderr)
        sys.exit(130)


def _expand_recipe() -> None:
    """Replace `recipe=` on the command line by what it stands for, for Hydra and for the run's records."""
    if any(word.startswith("recipe=") for word in sys.argv[1:]):
        from gridworld.config.composition.recipe_file import with_recipe

        sys.argv[1:] = with_recipe(sys.argv[1:])


def run_job(settings: DictConfig) -> float:
    """Train once.

    Args:
        settings: The composed settings, without Hydra's.

    Returns:
        The final policy's regret, for sweepers.
    """
    return run_alone(training(settings))


def training(settings: DictConfig) -> Training[float]:
    """The same as a generator, for the jobs of a population."""
    with called_from(Path(HydraConfig.get().runtime.cwd)):  # hydra.job.chdir=true changes the current folder
        return (yield from _training(settings))


run_job.training = training  # type: ignore[attr-defined]  # where `sweep.hydra_job` finds it


def _training(settings: DictConfig) -> Training[float]:
    context = HydraConfig.get()
    _job_started.set()
    folder = Path(context.runtime.output_dir)
    overrides = cast("list[str]", OmegaConf.to_container(context.overrides.task))
    is_one_of_many = context.mode is RunMode.MULTIRUN
    try:
        config = to_config(settings)
        if is_one_of_many and (folder.parent / SWEEP_JSON).exists():
            from gridworld.sweep.job import run_in_sweep

            stop_at_failure = context.sweeper.stop_at_first_failure
            return (yield from run_in_sweep(config, folder, overrides, stop_at_failure))
        with claimed(folder) if is_one_of_many else contextlib.nullcontext():
            return _run_alone(config, folder, overrides)
    except (InputError, OSError, OmegaConfBaseException) as error:
        if is_one_of_many:
            _stop_if_lost(folder)
            print(printable(f"job {context.job.num} failed: {sentence(error)}"), file=sys.stderr)
            if isinstance(error, OSError):
                raise  # it did not even fail: the sweep tries it again
            raise JobError(sentence(error)) from None
        sys.exit(_tell(error))


def _stop_if_lost(folder: Path) -> None:
    """End the sweep if its folder is no longer this process's."""
    from gridworld.sweep.job import StopSweep

    try:
        check_ours(folder)
    except FolderLostError as error:
        raise StopSweep(str(error)) from None


def _run_alone(config: TrainConfig, folder: Path, overrides: list[str]) -> float:
    """Train, or resume the run, in a folder that this process holds; returns the final regret."""
    from gridworld.run.reader import is_started
    from gridworld.run.summary import Summary, train_and_tell
    from gridworld.training.train import train

    run: Callable[[], Summary] = partial(train, config, folder, overrides)
    if is_started(folder):
        from gridworld.restore.resume import unfinished_of

        run = unfinished_of(folder, config).resume
    return float(train_and_tell(folder, run, _advice)["regret"])


def _advice(folder: Path) -> list[str]:
    from gridworld.restore.advice import advice  # here, since most runs are certified

    return advice(folder)


def _tell(error: Exception) -> int:
    tell_error(sentence(error))
    return EXIT_CODE
