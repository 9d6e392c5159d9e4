"""The composition root: Hydra's side of `scripts/train.py`. Below here, settings are plain dataclasses."""

from __future__ import annotations

import re
import secrets
import shutil
import sys
from pathlib import Path
from typing import Any

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.errors import CompactHydraException
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gridworld.config import AGENT_SCHEMAS, TrainConfig
from gridworld.errors import EXIT_CODE, InputError
from gridworld.run import MANIFEST, Run, check_new

_LONGEST_NAME = 100  # characters of a job's folder


class JobError(CompactHydraException):
    """A job's mistake, which Hydra tells without a traceback."""


class RefuseUsedFolders(Callback):
    """Looks at the output folder before Hydra writes to it, and ends the program if it cannot be used."""

    def on_run_start(self, config: DictConfig, **kwargs: Any) -> None:
        self._refuse(lambda: check_new(Path(config.hydra.run.dir)))

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        folder = Path(config.hydra.sweep.dir)

        def check() -> None:
            check_new(folder)
            for manifest in sorted(folder.glob(f"*/{MANIFEST}")):
                check_new(manifest.parent)

        self._refuse(check)

    @staticmethod
    def _refuse(check: Any) -> None:
        try:
            check()
        except (InputError, OSError, OmegaConfBaseException) as error:
            sys.exit(_tell(error))


def main(conf: Path) -> None:
    """Run the command line; `conf` is the folder of the yaml files."""
    _register(conf)
    hydra.main(version_base="1.3", config_path=str(conf), config_name="train")(run_job)()


def run_job(settings: DictConfig) -> float:
    """One training run with its summary on standard output; returns the final regret, for sweepers."""
    context = HydraConfig.get()
    folder = Path(context.runtime.output_dir)
    overrides = list(context.overrides.task)
    try:
        config: TrainConfig = OmegaConf.to_object(settings)  # type: ignore[assignment]
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
            raise JobError(f"error: {_sentence(error)}") from None
        sys.exit(_tell(error))
    print(summary_text(summary, _shown(folder)))
    return float(summary["regret"])


def _register(conf: Path) -> None:
    store = ConfigStore.instance()
    store.store(name="train_schema", node=TrainConfig)
    for name, schema in AGENT_SCHEMAS.items():
        store.store(group="agent/schema", name=name, node=schema)
    OmegaConf.register_new_resolver("slug", _slug, replace=True)
    OmegaConf.register_new_resolver("token", lambda: secrets.token_hex(3), use_cache=True, replace=True)
    OmegaConf.register_new_resolver("manual", lambda: manual(conf), replace=True)


def _slug(text: Any) -> str:
    """Letters, digits and a few safe signs, of bounded length, for a folder's name."""
    name = re.sub(r"[^A-Za-z0-9_.,=+-]+", "-", Path(str(text)).stem if "/" in str(text) else str(text))
    return name.strip("-.")[:_LONGEST_NAME] or "run"


def manual(conf: Path) -> str:
    """The choices of every config group, each with the first comment of its file."""
    lines = []
    for group in sorted(folder for folder in conf.iterdir() if folder.is_dir()):
        lines.append(f"  {group.name}=")
        for file in sorted(group.glob("*.yaml")):
            comments = [line for line in file.read_text("utf-8").splitlines() if line.startswith("# ")]
            about = next((line[2:] for line in comments if "@package" not in line), "")
            lines.append(f"    {file.stem:<16} {about}")
    return "\n".join(lines)


def _sentence(error: Exception) -> str:
    lines = str(error).strip().splitlines()
    return lines[0] if lines else type(error).__name__


def _tell(error: Exception) -> int:
    print(f"error: {_sentence(error)}", file=sys.stderr)
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
