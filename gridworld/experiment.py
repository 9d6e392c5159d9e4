"""The composition root: Hydra's side of `scripts/train.py`. Below here, settings are plain dataclasses."""

from __future__ import annotations

import os
import re
import secrets
import shlex
import shutil
import sys
import threading
from pathlib import Path
from typing import Any, cast

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn
from hydra.errors import CompactHydraException
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gridworld.config import AGENT_SCHEMAS, JoblibConfig, SearchConfig, SweepConfig, TrainConfig
from gridworld.errors import EXIT_CODE, InputError
from gridworld.hydra_errors import refuse_added_keys, sentence
from gridworld.manual import manual
from gridworld.run import MANIFEST, SWEEP_JSON, Run, check_new

FULL_ERROR = "HYDRA_FULL_ERROR"
_job_begun = threading.Event()  # set once this process has come to a job
_LONGEST_NAME = 100  # characters of a job's folder


class JobError(CompactHydraException):
    """A job's mistake, which Hydra tells without a traceback."""


class RefuseUsedFolders(Callback):
    """Looks at the output folder before Hydra writes to it, and ends the program if it cannot be used."""

    def on_job_end(self, config: DictConfig, job_return: JobReturn, **kwargs: Any) -> None:
        """Let go of the configurations that a launcher would keep of every job until the sweep ends."""
        job_return.cfg = job_return.hydra_cfg = None

    def on_run_start(self, config: DictConfig, **kwargs: Any) -> None:
        try:
            check_new(Path(config.hydra.run.dir))
        except (InputError, OSError, OmegaConfBaseException) as error:
            sys.exit(_tell(error))


def main(conf: Path) -> None:
    """Run the command line; `conf` is the folder of the yaml files."""
    if {"--help", "-h"} & set(sys.argv[1:]):
        print(manual(conf))
        return
    register_schemas()
    asked_for_traceback = FULL_ERROR in os.environ
    os.environ[FULL_ERROR] = "1"  # so that Hydra raises its errors instead of printing them
    try:
        hydra.main(version_base="1.3", config_path=str(conf), config_name="train")(run_job)()
    except Exception as error:
        # Until a job begins, whatever goes wrong is the command line's or a yaml file's fault.
        mistake = isinstance(error, CompactHydraException) or not _job_begun.is_set()
        if asked_for_traceback or not mistake:
            raise
        sys.exit(_tell(error))
    except KeyboardInterrupt:
        print("interrupted before training began", file=sys.stderr)
        sys.exit(130)


def compose(conf: Path, overrides: list[str]) -> TrainConfig:
    """The configuration that the command line would give to a run."""
    register_schemas()
    with hydra.initialize_config_dir(version_base="1.3", config_dir=str(conf)):
        settings = hydra.compose(config_name="train", overrides=overrides)
    return to_config(settings)


def to_config(settings: DictConfig) -> TrainConfig:
    """Hydra's settings as the dataclasses that everything below here takes. Raises `InputError`."""
    refuse_added_keys(settings)
    return cast(TrainConfig, OmegaConf.to_object(settings))


def run_job(settings: DictConfig) -> float:
    """One training run with its summary on standard output; returns the final regret, for sweepers."""
    context = HydraConfig.get()
    _job_begun.set()
    folder = Path(context.runtime.output_dir)
    overrides = cast("list[str]", OmegaConf.to_container(context.overrides.task))
    try:
        config = to_config(settings)
        if context.mode is RunMode.MULTIRUN and (folder.parent / SWEEP_JSON).exists():
            from gridworld.sweep.job import run_in_sweep

            return run_in_sweep(config, folder, overrides, context.sweeper.stop_at_first_failure)
        from gridworld.summary import summary_text
        from gridworld.training import Interrupted, train

        try:
            summary = train(config, Run(folder), overrides)
        except Interrupted as interruption:
            print(f"{interruption}; {_shown(folder)} holds what there was until then", file=sys.stderr)
            sys.exit(interruption.exit_code)
    except (InputError, OmegaConfBaseException) as error:
        _discard(folder)
        if context.mode is RunMode.MULTIRUN:
            print(f"job {context.job.num} failed: {sentence(error)}", file=sys.stderr)
            raise JobError(sentence(error)) from None
        sys.exit(_tell(error))
    except KeyboardInterrupt:
        _discard(folder)
        raise
    _say(summary_text(summary, shlex.quote(_shown(folder))))
    return float(summary["regret"])


def register_schemas() -> None:
    """Tell Hydra the schemas of `config.py`, and OmegaConf the functions that `conf/` uses."""
    store = ConfigStore.instance()
    store.store(name="train_schema", node=TrainConfig)
    store.store(name="tune_schema", node=SearchConfig)
    store.store(group="hydra/sweeper", name="gridworld", node=SweepConfig)
    Plugins.instance()  # looks for plugins first, so that ours is `joblib` even beside hydra-joblib-launcher
    store.store(group="hydra/launcher", name="joblib", node=JoblibConfig)
    for name, schema in AGENT_SCHEMAS.items():
        store.store(group="agent/schema", name=name, node=schema)
    OmegaConf.register_new_resolver("slug", slug, replace=True)
    OmegaConf.register_new_resolver("token", lambda: secrets.token_hex(3), use_cache=True, replace=True)


def slug(text: Any) -> str:
    """Letters, digits and a few safe signs, of bounded length, for a folder's name."""
    name = re.sub(r"[^A-Za-z0-9_.,=+-]+", "-", Path(str(text)).stem if "/" in str(text) else str(text))
    return name.strip("-.")[:_LONGEST_NAME] or "run"


def _say(text: str) -> None:
    """Print it, if anybody still reads: with `| head`, a reader may have left. The files are written."""
    try:
        print(text, flush=True)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _tell(error: Exception) -> int:
    print(f"error: {sentence(error)}", file=sys.stderr)
    return EXIT_CODE


def _discard(folder: Path) -> None:
    """Take away what Hydra wrote for a run that never began; anything else in the folder stays."""
    if not (folder / MANIFEST).exists():
        shutil.rmtree(folder / ".hydra", ignore_errors=True)
        try:
            folder.rmdir()
        except OSError:
            return


def _shown(folder: Path) -> str:
    """The folder as a user would type it from here."""
    try:
        return str(folder.relative_to(Path.cwd()))
    except ValueError:
        return str(folder)
