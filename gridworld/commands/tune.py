"""Search an agent's settings for a task, and confirm the winner on seeds that the search has not seen.

Overrides compose the configuration to begin from, as for train.py. What is searched stands in a file:
{spaces}
Run the command again to continue the study. On several machines, with tune.storage=URL of a database that all
reach, they work on it together.
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib.util
import os
import shlex
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gridworld.commands.manual import choices
from gridworld.config.composition.conf_folder import conf_folder
from gridworld.config.composition.words import refuse_dashes
from gridworld.errors import InputError, install_command
from gridworld.process.console.command_line import as_called, command_line, program
from gridworld.process.console.terminal import printable, result_is_in_files, tell_error
from gridworld.storage.safe_read import check_yaml

if TYPE_CHECKING:
    from gridworld.tune.study_spec import StudySpec

_KINDS = ("job", "all")  # of --cfg
_EPILOG = """\
keys, beside all of train.py's (defaults in conf/tune.yaml):
  tune=NAME            another file of conf/tune, or of --config-dir's tune/
  tune.trials          how many, those of earlier calls included (100)
  tune.seeds           of a trial: seed, seed + 1, ... (3)
  tune.finalists       trials that go on (5) to more seeds, tune.final_seeds (10)
  tune.confirm_seeds   still others, for the winner and what the search began from (20)
  tune.study           its name, by which it is gone on with; tune.folder, its folder (runs/STUDY)
  tune.storage         any database URL of Optuna's (an SQLite file in the folder)
  tune.workers         processes (one on each core); tune.timeout, seconds
  tune.sampler         tpe, random; tune.pruner: median, hyperband, none

examples:
  python scripts/tune.py agent=ppo env=four_rooms
      a hundred trials of three seeds; then
  python scripts/train.py recipe=runs/tune_ppo_four_rooms
  python scripts/tune.py agent=ppo env=maze tune.trials=300 tune.study=maze
      begins from a recipe
  python scripts/tune.py agent=ppo tune=mine --config-dir my_conf
      a search space of your own, my_conf/tune/mine.yaml
  python scripts/report.py runs/tune_ppo_four_rooms
      the study as a page: its history, which settings mattered, the winner's runs
"""


def main(arguments: Sequence[str]) -> None:
    """Search, confirm the winner, and print the verdict."""
    conf = conf_folder()
    refuse_dashes(arguments)
    options = _parser(conf).parse_intermixed_args(_with_kind(arguments))
    if options.package is not None and not options.cfg:
        raise InputError(
            f"--package {options.package}: shows a part of the configuration; it goes with --cfg"
        )
    if importlib.util.find_spec("optuna") is None:
        raise InputError(f"{program('tune')}: optuna is not installed; {install_command('tune')}")
    if options.config_dir is not None and not options.config_dir.is_dir():
        raise InputError(f"--config-dir {options.config_dir}: no such folder")
    if options.config_dir is not None:
        check_yaml(options.config_dir)
    from gridworld.tune.study_spec import ConfFolders, compose_study

    folders = ConfFolders(conf, (options.config_dir,) if options.config_dir else ())
    spec = compose_study(folders, options.overrides)
    if options.cfg:
        _show(spec, options.cfg, options.package)
        return
    result_is_in_files()
    from gridworld.process.signals import Interrupted
    from gridworld.tune.search.worker_pool import SearchError
    from gridworld.tune.study import tune

    try:
        tune(spec)
    except SearchError as failure:
        tell_error(str(failure))
        sys.exit(1)
    except Interrupted as interruption:
        again = shlex.join(command_line())
        print(printable(f"{interruption}; nothing that ended is lost; go on with: {again}"), file=sys.stderr)
        sys.stderr.flush()
        os._exit(interruption.exit_code)  # finalising the interpreter would take seconds


def _parser(conf: Path) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=program("tune"),
        description=as_called(__doc__ or "").format(spaces="\n".join(choices(conf / "tune"))),
        epilog=as_called(_EPILOG),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("overrides", nargs="*", metavar="key=value", help=as_called("train.py's and tune.*"))
    parser.add_argument("--config-dir", type=Path, help="a folder of your own yaml files, beside conf/")
    parser.add_argument(
        *("--cfg", "-c"),
        choices=_KINDS,
        help="print the configuration and do nothing: what the search begins from (job), or that and how to "
        "search (all, also without a word)",
    )
    parser.add_argument("--package", "-p", help="with --cfg: only this part, such as agent or tune.space")
    return parser


def _with_kind(words: Sequence[str]) -> Iterator[str]:
    """The words with the kind of `--cfg` as a part of it, since what follows may also be a setting."""
    kind_is_next = False
    for word in words:
        if kind_is_next:
            kind_is_next = False
            if word in (*_KINDS, "hydra"):  # the last is train.py's
                yield f"--cfg={word}"
                continue
            yield f"--cfg={_KINDS[-1]}"
        if word in ("--cfg", "-c"):
            kind_is_next = True
        else:
            yield word
    if kind_is_next:
        yield f"--cfg={_KINDS[-1]}"


def _show(spec: StudySpec, kind: str, package: str | None) -> None:
    from omegaconf import OmegaConf

    shown: Any = OmegaConf.create(dataclasses.asdict(spec.base))
    if kind != "job":
        settings = dataclasses.replace(spec.settings, space={})
        shown.tune = dataclasses.asdict(settings) | {"space": spec.space.plain()}
    if package not in (None, "_global_"):
        shown = OmegaConf.select(shown, package)
        if shown is None:
            raise InputError(f"--package {package}: there is no such part of the configuration")
        print(f"# @package {package}")
    print(OmegaConf.to_yaml(shown).rstrip() if OmegaConf.is_config(shown) else shown)
