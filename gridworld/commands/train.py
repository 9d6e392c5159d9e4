"""`train`: Hydra composes the settings, and a run or a sweep starts with them as dataclasses.

With `resume=RUN` a run is resumed with its own settings.
"""

from __future__ import annotations

import contextlib
import copy
import os
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
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

from gridworld.bounds import digits
from gridworld.commands import run
from gridworld.commands.manual import manual
from gridworld.config.compose import VERSION_BASE, completed, register_schemas, to_config, without_hydra
from gridworld.config.train import TrainConfig
from gridworld.config.words import conf_folder, own_conf_folders, refuse_dashes, sentence, unreadable_file
from gridworld.errors import EXIT_CODE, InputError
from gridworld.process.console import (
    called_from,
    prepare,
    printable,
    printing,
    tell_error,
)
from gridworld.process.memory_budget import limited
from gridworld.process.signals import at_work
from gridworld.run.folder import MANIFEST, SWEEP_JSON, alone_in, check_inside, claimed, shown
from gridworld.run.reader import check_free, check_is_run, is_started
from gridworld.storage.atomic_write import check_no_links

FULL_ERROR = "HYDRA_FULL_ERROR"
_RESUME, _STEPS = "resume", "total_timesteps"
_SWITCHES = {"logging.progress": "true", "trust": "false", "anyway": "false"}  # with their defaults
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
        run(resume)
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
        mistake = isinstance(error, CompactHydraException | InputError) or not _job_started.is_set()
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
        from gridworld.config.recipe_file import with_recipe

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


def run_folder(config: DictConfig) -> AbstractContextManager[None]:
    """Check the folder of a single run, and return the block in which this process holds it."""
    folder = Path(config.hydra.run.dir)
    check_inside(folder, "hydra.run.dir")
    _check_names(config)
    check_free(folder)
    if config.hydra.output_subdir is not None:
        check_no_links(folder, config.hydra.output_subdir)  # Hydra writes through them
    return claimed(folder.absolute())  # a job may change the current folder


def check_settings_of(config: DictConfig) -> None:
    """Check that an unfinished run in the folder has the settings of `config`."""
    folder = Path(config.hydra.run.dir).absolute()
    if not (folder / MANIFEST).exists():
        return
    from gridworld.restore.resume import unfinished_of  # here, since it takes a second to import

    # An interpolation may need what Hydra knows only in the job, where the settings are compared again.
    with contextlib.suppress(OmegaConfBaseException):
        if is_started(folder):
            unfinished_of(folder, without_hydra(copy.deepcopy(config)))


def check_sweep_folder(config: DictConfig) -> None:
    """Check the folder of a sweep, as far as it can be done without its jobs."""
    check_inside(Path(config.hydra.sweep.dir), "hydra.sweep.dir")
    _check_names(config)


def _check_names(config: DictConfig) -> None:
    """Refuse names by which Hydra would write outside the output folder."""
    for key, name in (
        ("hydra.output_subdir", config.hydra.output_subdir),
        ("hydra.job.name", config.hydra.job.name),  # of its log file
    ):
        if name is not None and (os.sep in name or name in ("", os.curdir, os.pardir)):
            raise InputError(f"{key}={name}: must be a plain name, without {os.sep}")


@limited()
def resume(arguments: Sequence[str]) -> None:
    """Resume `resume=RUN`, and print the result as a new run does.

    `total_timesteps=N` makes it longer, `logging.progress=false` hides its progress. `trust=true` imports
    classes from anywhere, `anyway=true` accepts other versions or another processor.
    """
    words = _resume_words(arguments)
    total_timesteps = _step_count(words[_STEPS]) if _STEPS in words else None
    progress, trust, anyway = ((words.get(name) or usual) == "true" for name, usual in _SWITCHES.items())
    folder = Path(words[_RESUME])
    check_inside(folder, _RESUME)
    check_is_run(folder)  # before anything is written there
    if not os.access(folder, os.W_OK | os.X_OK):
        raise InputError(f"{folder}: is read-only; copy the run to where you may write and resume= the copy")

    from gridworld.restore.advice import advice
    from gridworld.restore.resume import open_unfinished  # here, since it takes a second to import
    from gridworld.run.summary import train_and_tell

    with alone_in(folder):
        unfinished = open_unfinished(folder, trust)
        train_and_tell(folder, lambda: unfinished.resume(total_timesteps, anyway, progress), advice)


def _resume_words(arguments: Sequence[str]) -> dict[str, str]:
    words: dict[str, str] = {}
    for argument in arguments:
        key, _, text = argument.partition("=")
        if key not in (_RESUME, _STEPS, *_SWITCHES):
            raise InputError(
                f"{argument}: a run goes on with the settings that it began with; beside {_RESUME}=RUN there "
                f"are {', '.join([_STEPS, *_SWITCHES])}"
            )
        if key in words:
            raise InputError(f"{argument}: {key} is given already; give it once")
        if key in _SWITCHES and text not in ("true", "false"):
            raise InputError(f"{argument}: must be true or false")
        if key == _RESUME and not text:
            raise InputError(f"{argument}: must be the folder of a run, e.g. one in runs/")
        words[key] = text
    return words


def _step_count(text: str) -> int:
    try:
        count = int(digits(text))  # 1e5
        if 1 <= count < 10**18:
            return count
    except ValueError:
        pass
    raise InputError(f"{_STEPS}={text}: must be a number of environment steps")
