"""A module per command, behind `gridworld` (`console.py`) and the files in `scripts/`.

A module has `main(arguments)`, which `run` calls with the command line's words. That of `train` has no
arguments, and reads `sys.argv` as Hydra does.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from gridworld.config.composition.words import digits
from gridworld.errors import EXIT_CODE, InputError, failure
from gridworld.process.console.terminal import prepare, printing, tell_error
from gridworld.process.early_signals import AtWork
from gridworld.process.garbage import collect_less_often

Main = Callable[[Sequence[str]], None]


def parser_for_a_run(prog: str, about: str | None) -> argparse.ArgumentParser:
    """A parser with the arguments that all commands on a finished run have.

    Args:
        prog: The command's name.
        about: What it does.
    """
    parser = argparse.ArgumentParser(prog=prog, description=about)
    parser.add_argument("run", type=Path, help="the run's folder, e.g. runs/2026-...")
    parser.add_argument(
        "--policy",
        choices=("greedy", "sampled"),
        default="greedy",
        help="the best action, or the distribution it explores with",
    )
    add_best(parser)
    parser.add_argument(
        "--trust",
        action="store_true",
        help="import the classes that the run names, wherever they are from, and let its environment draw",
    )
    return parser


def parser_for_runs(prog: str, about: str | None) -> argparse.ArgumentParser:
    """A parser for a command on many runs, with the folders that they are searched for in.

    Args:
        prog: The command's name.
        about: What it does, as it is laid out.
    """
    parser = argparse.ArgumentParser(
        prog=prog, description=about, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUNS", help="folders, searched for runs")
    return parser


def add_best(parser: argparse.ArgumentParser) -> None:
    """Add the option that chooses `best_model.zip`."""
    parser.add_argument(
        "--best",
        action="store_true",
        help="the model with the lowest exact regret on the way, not the last one",
    )


def whole_number(text: str) -> int:
    """The type of an option that takes a whole number, which may be written as 1e5.

    Raises:
        argparse.ArgumentTypeError: it is none.
    """
    try:
        return int(digits(text))
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be a whole number, not {text}") from None


def run(main: Main) -> None:
    """Call a command's `main`; a user's mistake ends the program with one sentence and no traceback.

    So does output that could not be written, whatever exit code `main` ends with.
    """
    collect_less_often()
    prepare()
    try:
        with AtWork(), printing():
            main(sys.argv[1:])
    except InputError as error:
        tell_error(str(error))
        sys.exit(EXIT_CODE)
    except OSError as error:
        tell_error(failure(error))
        sys.exit(EXIT_CODE)
    except KeyboardInterrupt:
        sys.exit(130)
