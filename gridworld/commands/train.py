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

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import CompactHydraException
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gridworld.commands import run
from gridworld.commands.manual import manual
from gridworld.commands.output_folder import check_settings_of, check_sweep_folder, run_folder
from gridworld.config.composition.compose import VERSION_BASE, completed, register_schemas, to_config
from gridworld.config.composition.conf_folder import conf_folder, own_conf_folders
from gridworld.config.composition.hydra_errors import sentence, unreadable_file
from gridworld.config.composition.words import refuse_dashes
from gridworld.config.train import TrainConfig
from gridworld.errors import EXIT_CODE, InputError
from gridworld.process.console import (
    called_from,
    prepare,
    printable,
    printing,
    tell_error,
)
from gridworld.process.signals import at_work
from gridworld.run.folder import SWEEP_JSON, claimed, shown

FULL_ERROR = "HYDRA_FULL_ERROR"
_job_started = threading.Event()  # set when this process starts its first job
_at_end = contextlib.ExitStack()  # lets go of a single run's folder, sums a sweep up


class RefuseUsedFolders(Callback):
    """Checks the output folder before Hydra writes to it, and ends the program if it cannot be used."""

    def on_run_start(self, config: DictConfig, **kwargs: Any) -> None:
        _exit_on_error(lambda: _claim_run_folder(config))

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
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
    prepare()
    if {"--help", "-h"} & set(sys.argv[1:]):
        run(lambda _: print(manual(conf)))
        return
    if any(word.startswith("resume=") for word in sys.argv[1:]):
        from gridworld.commands import resume

        run(resume.main)
        return
    register_schemas()
    asked_for_traceback = FULL_ERROR in os.environ
    os.environ[FULL_ERROR] = "1"  # so that Hydra raises its errors instead of printing them
    try:
        with at_work(), printing(), _at_end:
            _prepare_command_line(conf)
            hydra.main(version_base=VERSION_BASE, config_path=str(conf), config_name="train")(run_job)()
    except Exception as error:
        # Until a job starts, whatever goes wrong is the fault of the command line or a yaml file.
        mistake = isinstance(error, CompactHydraException) or not _job_started.is_set()
        if asked_for_traceback or not mistake:
            raise
        if isinstance(error, UnicodeDecodeError | RecursionError):
            found = unreadable_file(error, [conf, *own_conf_folders(sys.argv[1:])])
            error = error if found is None else InputError(found)
        sys.exit(_tell(error))
    except KeyboardInterrupt:
        print("interrupted before training began", file=sys.stderr)
        sys.exit(130)


def _prepare_command_line(conf: Path) -> None:
    """Write `sys.argv` as Hydra takes it: with the words of a recipe and a preset, and plain numbers."""
    refuse_dashes(sys.argv[1:])
    if any(word.startswith("recipe=") for word in sys.argv[1:]):
        from gridworld.config.composition.recipe_file import with_recipe

        sys.argv[1:] = with_recipe(sys.argv[1:])
    sys.argv[1:] = completed(sys.argv[1:], conf)


def run_job(settings: DictConfig) -> float:
    """Train once with the composed settings; returns the final policy's regret, for other sweepers."""
    context = HydraConfig.get()
    _job_started.set()
    folder = Path(context.runtime.output_dir)
    overrides = cast("list[str]", OmegaConf.to_container(context.overrides.task))
    is_one_of_many = context.mode is RunMode.MULTIRUN
    with called_from(Path(context.runtime.cwd)):  # hydra.job.chdir=true changes the current folder
        try:
            with claimed(folder) if is_one_of_many else contextlib.nullcontext():
                return _run_alone(to_config(settings), folder, overrides)
        except (InputError, OSError, OmegaConfBaseException) as error:
            sys.exit(_tell(error))


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
