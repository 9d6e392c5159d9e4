"""`train`: Hydra composes the settings, and a run or a sweep starts with them as dataclasses.

With `resume=RUN` a run is resumed with its own settings.
"""

from __future__ import annotations

import contextlib
import copy
import os
import re
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
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

from gridworld.base.atomic_write import check_no_links
from gridworld.base.bounds import digits
from gridworld.base.console import tell, tell_error
from gridworld.base.errors import EXIT_CODE, InputError
from gridworld.base.user_input import called_from, limited
from gridworld.base.workarounds import let_hydra_parse
from gridworld.commands.manual import manual
from gridworld.config.compose import VERSION_BASE, completed, refuse_unused, register_schemas, to_config
from gridworld.config.messages import sentence
from gridworld.config.recipes import Chosen
from gridworld.config.train import TrainConfig, check
from gridworld.config.words import conf_folder, own_conf_folders, refuse_unclear
from gridworld.config.worlds import each_once
from gridworld.run.folder import MANIFEST, SWEEP_JSON, alone_in, check_inside, claimed, shell_path
from gridworld.run.reader import check_free, check_is, is_started

FULL_ERROR = "HYDRA_FULL_ERROR"
_RESUME, _STEPS = "resume", "total_timesteps"
_SWITCHES = {"logging.progress": "true", "trust": "false", "anyway": "false"}  # with their defaults
_MOST_STEPS = 10**18
_world = each_once()  # compiled for the choice of a recipe, and to train in
_job_started = threading.Event()  # set when this process starts its first job
_at_end = contextlib.ExitStack()  # lets go of a single run's folder, sums a sweep up


def main(words: Sequence[str]) -> None:
    """Train, resume a run, or run a sweep."""
    if {"--help", "-h"} & set(words):
        print(manual())
    elif any(word.startswith(f"{_RESUME}=") for word in words):
        resume(words)
    else:
        _call_hydra()


def _call_hydra() -> None:
    """Have Hydra compose what `sys.argv` says, and call `run_job` or the sweeper with it."""
    register_schemas()
    let_hydra_parse()
    asked_for_traceback = FULL_ERROR in os.environ
    os.environ[FULL_ERROR] = "1"  # so that Hydra raises its errors instead of printing them
    try:
        with _at_end:
            refuse_unclear(sys.argv[1:])
            sys.argv[1:] = completed(sys.argv[1:], _world)
            hydra.main(version_base=VERSION_BASE, config_path=str(conf_folder()), config_name="train")(
                run_job
            )()
    except Exception as error:
        # Until a job starts, whatever goes wrong is the fault of the command line or a yaml file.
        mistake = isinstance(error, CompactHydraException | InputError) or not _job_started.is_set()
        if asked_for_traceback:
            traceback.print_exc()
            sys.exit(1)
        if not mistake:
            raise
        if isinstance(error, UnicodeDecodeError | RecursionError):
            raise InputError(_unreadable(error, sys.argv[1:])) from None
        raise InputError(sentence(error)) from None
    except KeyboardInterrupt:
        print("interrupted before training began", file=sys.stderr)
        raise


def _unreadable(error: Exception, words: Sequence[str]) -> str:
    """A sentence on the yaml file that raises an error like this one, for which Hydra names no file."""
    what = "is not UTF-8 text, or it contains itself"
    for file in (file for folder in own_conf_folders(words) for file in sorted(folder.rglob("*.yaml"))):
        try:
            OmegaConf.load(file)
        except type(error):
            return f"{file}: {what}"
        except Exception:
            continue  # which would name its file itself
    return f"a yaml file {what}"


@contextlib.contextmanager
def _exiting_on_mistake() -> Iterator[None]:
    """End the program with a sentence: about an exception, Hydra would print more, or continue."""
    try:
        yield
    except (InputError, OSError, OmegaConfBaseException) as error:
        tell_error(sentence(error))
        sys.exit(EXIT_CODE)


class RefuseUsedFolders(Callback):
    """Checks the output folder before Hydra writes to it, and ends the program if it cannot be used."""

    @_exiting_on_mistake()
    def on_run_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Hold the run's folder; an unfinished run in it must have the same settings."""
        _check_place(config, "run")
        for word in config.hydra.overrides.hydra:
            if re.match(r"\+*hydra[./](launcher|sweeper)\b", word):
                raise InputError(f"{word}: applies to sweeps only; add -m, or leave it out")
        refuse_unused(config.hydra)
        folder = Path(config.hydra.run.dir).absolute()  # a job may change the current folder
        check_free(Path(config.hydra.run.dir))
        if config.hydra.output_subdir is not None:
            # Hydra writes through links.
            check_no_links(Path(config.hydra.run.dir), config.hydra.output_subdir)
        _at_end.enter_context(claimed(folder))
        if (folder / MANIFEST).exists() and is_started(folder):
            from gridworld.training.resume import unfinished_of  # here, since it takes a second to import

            # An interpolation may need what Hydra knows only in the job, where settings are compared again.
            with contextlib.suppress(OmegaConfBaseException):
                unfinished_of(folder, to_config(copy.deepcopy(config)), _world)

    @_exiting_on_mistake()
    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Check the folder of a sweep, as far as it can be done without its jobs."""
        _check_place(config, "sweep")
        _at_end.push(partial(_sum_up, Path(config.hydra.sweep.dir)))


def _check_place(config: DictConfig, kind: str) -> None:
    """Refuse a folder that is not below the current one, and names that lead out of it."""
    check_inside(Path(config.hydra[kind].dir), f"hydra.{kind}.dir")
    for key, name in (
        ("hydra.output_subdir", config.hydra.output_subdir),
        ("hydra.job.name", config.hydra.job.name),  # of its log file
    ):
        if name is not None and (os.sep in name or name in ("", os.curdir, os.pardir)):
            raise InputError(f"{key}={name}: must be a plain name, without {os.sep}")


def _sum_up(sweep: Path, kind: object, error: BaseException | None, trace: object) -> None:
    """Write a sweep's curves over seeds for TensorBoard, unless the sweep was stopped or refused."""
    is_over = error is None or (isinstance(error, SystemExit) and error.code in (0, 1))
    if not is_over or not (sweep / SWEEP_JSON).exists():
        return
    from gridworld.report.writer import write_over_seeds

    if (folder := write_over_seeds(sweep, sweep)) is not None:
        print(f"  curves over seeds: tensorboard --logdir {shell_path(folder)}")


def run_job(settings: DictConfig) -> float:
    """Train once with the composed settings; returns the final policy's regret, for other sweepers."""
    context = HydraConfig.get()
    _job_started.set()
    folder = Path(context.runtime.output_dir)
    overrides = cast("list[str]", OmegaConf.to_container(context.overrides.task))
    held = claimed(folder) if context.mode is RunMode.MULTIRUN else contextlib.nullcontext()
    # hydra.job.chdir=true changes the current folder
    with called_from(Path(context.runtime.cwd)), _exiting_on_mistake(), held:
        return _train(Chosen.of(context).settle(to_config(settings), overrides), folder, overrides)


def _train(config: TrainConfig, folder: Path, overrides: list[str]) -> float:
    """Train, or resume the run, in a folder that this process holds; returns the final regret."""
    check(config)
    config.agent.check(config)
    if config.logging.progress and not is_started(folder):  # at once, since torch takes seconds to import
        _world(config.env)
        world, steps = config.env.name, config.total_timesteps
        tell(f"training {config.agent.name} on {world}, seed {config.seed}, for {steps:,} steps")
    from gridworld.run.console import Summary, train_and_tell
    from gridworld.training.train import train

    run: Callable[[], Summary] = partial(train, config, folder, overrides, _world)
    if is_started(folder):
        from gridworld.training.resume import unfinished_of

        run = unfinished_of(folder, config, _world).resume
    return float(train_and_tell(folder, run, partial(_advice, trust=True))["regret"])


def _advice(folder: Path, trust: bool) -> list[str]:
    from gridworld.training.advice import advice  # here, since most runs are certified

    return advice(folder, trust)


@limited()
def resume(words: Sequence[str]) -> None:
    """Resume `resume=RUN`, and print the result as a new run does.

    `total_timesteps=N` makes it longer, `logging.progress=false` hides its progress. `trust=true` imports
    classes from anywhere, `anyway=true` accepts other versions or another processor.
    """
    given = _resume_words(words)
    steps = _step_count(given[_STEPS]) if _STEPS in given else None
    progress, trust, anyway = (given.get(name, usual) == "true" for name, usual in _SWITCHES.items())
    folder = Path(given[_RESUME])
    check_inside(folder, _RESUME)
    check_is(folder)  # before anything is written there
    if not os.access(folder, os.W_OK | os.X_OK):
        raise InputError(f"{folder}: is read-only; copy the run to a writable folder and resume the copy")

    from gridworld.run.console import train_and_tell
    from gridworld.training.resume import open_unfinished  # here, since it takes a second to import

    with alone_in(folder):
        unfinished = open_unfinished(folder, trust)
        train_and_tell(
            folder, lambda: unfinished.resume(steps, anyway, progress), partial(_advice, trust=trust)
        )


def _resume_words(arguments: Sequence[str]) -> dict[str, str]:
    words: dict[str, str] = {}
    for argument in arguments:
        key, _, text = argument.partition("=")
        if key not in (_RESUME, _STEPS, *_SWITCHES):
            raise InputError(
                f"{argument}: a run is resumed with its own settings; besides {_RESUME}=RUN give only "
                f"{', '.join([_STEPS, *_SWITCHES])}"
            )
        if key in words:
            raise InputError(f"{argument}: {key} is given twice; give it once")
        if key in _SWITCHES and text not in ("true", "false"):
            raise InputError(f"{argument}: must be true or false")
        if key == _RESUME and not text:
            raise InputError(f"{argument}: must be the folder of a run, e.g. one in runs/")
        words[key] = text
    return words


def _step_count(text: str) -> int:
    with contextlib.suppress(ValueError):
        if 1 <= (count := int(digits(text))) < _MOST_STEPS:  # 1e5
            return count
    raise InputError(f"{_STEPS}={text}: must be a number of environment steps")
