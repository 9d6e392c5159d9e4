"""Search an agent's settings for a task, and confirm the winner on seeds that the search has not seen.

Overrides compose the baseline configuration, as for train.py. The search space is one of:
{spaces}
Run the command again to continue the study. Several machines can work on one study through a shared database,
tune.storage=URL.
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib.util
import os
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gridworld.base.console import as_called, command_line, printable, program, tell_error
from gridworld.base.errors import InputError, install_command
from gridworld.commands import parser_of
from gridworld.commands.manual import choices
from gridworld.config.words import conf_folder, refuse_unclear

if TYPE_CHECKING:
    from gridworld.sweeps.tune.study_spec import StudySpec

_KINDS = ("job", "all")  # of --cfg
_EPILOG = """\
keys, in addition to train.py's (with their defaults: --cfg all):
  tune=NAME            another file of conf/tune, or of --config-dir's tune/
  tune.trials          number of trials, with earlier calls; tune.seeds: seeds of each (seed, seed + 1, ...)
  tune.finalists       trials to run on tune.final_seeds more seeds; tune.confirm_seeds: for the winner
  tune.study           name of the study, to resume it; tune.folder: its folder (runs/STUDY)
  tune.storage         any database URL that Optuna takes (default: an SQLite file in the folder)

examples:
  python scripts/tune.py agent=ppo env=four_rooms
      a hundred trials of three seeds
  python scripts/train.py recipe=runs/tune_ppo_four_rooms
      train with the settings that it found
  python scripts/tune.py agent=ppo tune=mine --config-dir my_conf
      a custom search space, my_conf/tune/mine.yaml
  python scripts/report.py runs/tune_ppo_four_rooms
      the study as a page: its history, the settings that mattered, the winner's runs
"""


def main(arguments: Sequence[str]) -> None:
    """Search, confirm the winner, and print the verdict."""
    refuse_unclear(arguments)
    parser = _parser(conf_folder())
    options = parser.parse_intermixed_args(arguments)
    if options.cfg not in (None, *_KINDS):
        if "=" not in options.cfg:
            parser.error(f"argument --cfg/-c: invalid choice: {options.cfg!r} (choose from job, all)")
        options.overrides.append(options.cfg)  # a setting
        options.cfg = _KINDS[-1]
    if options.package is not None and not options.cfg:
        raise InputError(f"--package {options.package}: shows a part of the configuration; use it with --cfg")
    if importlib.util.find_spec("optuna") is None:
        raise InputError(f"{program('tune')}: optuna is not installed; {install_command('tune')}")
    from gridworld.sweeps.tune.study_spec import compose_study

    spec = compose_study(options.overrides, tuple(map(Path, options.config_dir)))
    if options.cfg:
        _show(spec, options.cfg, options.package)
        return
    from gridworld.base.signals import Interrupted
    from gridworld.sweeps.tune.search import SearchError
    from gridworld.sweeps.tune.study import tune

    try:
        tune(spec)
    except SearchError as failure:
        tell_error(str(failure))
        sys.exit(1)
    except Interrupted as interruption:
        again = shlex.join(command_line())
        print(printable(f"{interruption}; finished trials are kept; resume with: {again}"), file=sys.stderr)
        sys.stderr.flush()
        os._exit(interruption.exit_code)  # finalising the interpreter would take seconds


def _parser(conf: Path) -> argparse.ArgumentParser:
    about = (__doc__ or "").format(spaces="\n".join(choices(conf / "tune")))
    parser = parser_of("tune", about, "--config-dir", epilog=_EPILOG)
    option = parser.add_argument
    option("overrides", nargs="*", metavar="key=value", help=as_called("settings of train.py and tune.*"))
    option(
        *("--cfg", "-c"),
        nargs="?",
        const=_KINDS[-1],
        metavar="{job,all}",
        help="print the configuration of the baseline (job), or of the search too (all), and exit",
    )
    option("--package", "-p", help="with --cfg: only this part, such as agent or tune.space")
    return parser


def _show(spec: StudySpec, kind: str, package: str | None) -> None:
    from omegaconf import OmegaConf

    shown: Any = OmegaConf.create(dataclasses.asdict(spec.base))
    del shown["recipe"]  # which no word can set
    if kind != "job":
        settings = dataclasses.replace(spec.settings, space={})
        shown.tune = dataclasses.asdict(settings) | {"space": spec.space.plain()}
    if package not in (None, "_global_"):
        shown = OmegaConf.select(shown, package)
        if shown is None:
            raise InputError(f"--package {package}: no such part of the configuration")
        print(f"# @package {package}")
    print(OmegaConf.to_yaml(shown).rstrip() if OmegaConf.is_config(shown) else shown)
