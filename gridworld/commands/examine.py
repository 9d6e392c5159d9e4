"""Examine an environment of Gymnasium: what it is, and what keeps an agent from learning in it.

Exit code: 0 without findings, 1 with, 2 for a mistake on the command line.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from gridworld.base.console import printable
from gridworld.commands import parser_of, whole
from gridworld.commands.findings import add_file_options, check_files, write_files
from gridworld.examining.examine import examine

_FOUND = 1  # the exit code


def main(words: Sequence[str]) -> None:
    """Print the page."""
    options = _parser().parse_args(words)
    check_files(options)
    result = examine(options.env, options.gamma, steps=options.steps, seed=options.seed)
    print(*map(printable, str(result).splitlines()), sep="\n")
    write_files(result, options)
    if not result.passed:
        sys.exit(_FOUND)


def _parser() -> argparse.ArgumentParser:
    parser = parser_of("examine", __doc__, example="my_env:Tiny --gamma 0.9")
    option = parser.add_argument
    option(
        "env",
        metavar="WORLD",
        help="an id of Gymnasium, module:NAME of a class or function, or a world, e.g. cliff",
    )
    option("--gamma", type=float, default=0.99, help="the discount that an agent will have (default 0.99)")
    option("--steps", type=whole(100), default=20_000, help="how many steps to sample (default 20000)")
    option("--seed", type=whole(0), default=0, help="of all that is drawn (default 0)")
    add_file_options(parser)
    return parser
