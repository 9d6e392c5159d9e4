"""A module per command, behind `gridworld` (`console.py`) and the files in `scripts/`.

A module has `main(arguments)`, which `run` calls with the command line's words. That of `train` has no
arguments, and reads `sys.argv` as Hydra does.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from gridworld.bounds import Bounds
from gridworld.config.composition.words import digits
from gridworld.errors import EXIT_CODE, InputError, failure
from gridworld.process.console import prepare, printing, program, tell_error
from gridworld.process.signals import at_work

Main = Callable[[Sequence[str]], None]

_BEST = "the model with the lowest exact regret on the way, not the last one"
_TRUST = "import the classes that the run names, wherever they are from, and let its environment draw"
_POLICY = "the best action, or the distribution it explores with"
_SHARED: dict[str, dict[str, Any]] = {  # arguments that several commands have
    "run": {"type": Path, "help": "the run's folder, e.g. runs/2026-..."},
    "runs": {"type": Path, "nargs": "+", "metavar": "RUNS", "help": "folders, searched for runs"},
    "--policy": {"choices": ("greedy", "sampled"), "default": "greedy", "help": _POLICY},
    "--best": {"action": "store_true", "help": _BEST},
    "--trust": {"action": "store_true", "help": _TRUST},
}


def parser_of(
    command: str, about: str | None, *shared: str, epilog: str | None = None
) -> argparse.ArgumentParser:
    """The parser of a command that has these of the `_SHARED` arguments."""
    parser = argparse.ArgumentParser(
        prog=program(command),
        description=about,
        epilog=epilog,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    for name in shared:
        parser.add_argument(name, **_SHARED[name])
    return parser


def whole(low: float = -math.inf, high: float = math.inf) -> Callable[[str], int]:
    """The type of an option that takes a whole number, which may be written as 1e5, within bounds."""

    def number(text: str) -> int:
        try:
            found = int(digits(text))
        except ValueError:
            raise argparse.ArgumentTypeError(f"must be a whole number, not {text}") from None
        if not low <= found <= high:
            raise argparse.ArgumentTypeError(f"{text}: must be {Bounds(low, high)}")
        return found

    return number


def run(main: Main) -> None:
    """Call a command's `main`; a user's mistake ends the program with one sentence and no traceback.

    So does output that could not be written, whatever exit code `main` ends with.
    """
    prepare()
    try:
        with at_work(), printing():
            main(sys.argv[1:])
    except InputError as error:
        tell_error(str(error))
        sys.exit(EXIT_CODE)
    except OSError as error:
        tell_error(failure(error))
        sys.exit(EXIT_CODE)
    except KeyboardInterrupt:
        sys.exit(130)
