"""Check an implementation of an algorithm on small worlds with known answers.

It trains on each world for seconds. What it has learnt is compared with the exact values and the optimal
actions. The exit code is 0 if everything holds, 1 if not, 2 for a mistake on the command line.
"""

from __future__ import annotations

import argparse
import os
import sys
import textwrap
from collections.abc import Sequence

from gridworld.checking.probes import PROBES
from gridworld.checking.run import Finding, check
from gridworld.checking.settings import arguments
from gridworld.commands import whole_number
from gridworld.errors import InputError
from gridworld.process.console.command_line import program
from gridworld.process.console.terminal import printable

_PROCESSES = 2
_FAILED = 1  # the exit code


def main(words: Sequence[str]) -> None:
    """Print a row per probe as it ends, and the verdict.

    Raises:
        InputError: no such implementation, probe or argument.
        SystemExit: with code 1 where a probe fails.
    """
    options = _parser().parse_args(words)
    for name, least in (("processes", 1), ("seed", 0)):
        if getattr(options, name) < least:
            raise InputError(f"--{name} {getattr(options, name)}: must be at least {least}")
    result = check(
        options.algorithm,
        arguments(options.set),
        options.probe,
        options.seed,
        options.processes,
        on_finding=_print,
    )
    print(printable(result.verdict()))
    if not result.passed:
        sys.exit(_FAILED)


def _print(finding: Finding) -> None:
    for line in str(finding).splitlines():
        print(printable(line), flush=True)


def _parser() -> argparse.ArgumentParser:
    probes = "\n".join(
        textwrap.fill(f"  {probe.name:<13}{probe.meaning}", 100, subsequent_indent=" " * 15)
        for probe in PROBES
    )
    parser = argparse.ArgumentParser(
        prog=program("check"),
        description=__doc__,
        epilog=f"The probes, and what it means where one fails:\n{probes}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "algorithm",
        help="the import path of a class of SB3's kind, e.g. my_package.MyPPO; or a shipped agent, e.g. dqn",
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="an argument for the class, e.g. learning_rate=0.001; may be repeated",
    )
    parser.add_argument(
        "--probe", action="append", default=[], metavar="NAME", help="only this probe; may be repeated"
    )
    parser.add_argument(
        "--seed", type=whole_number, default=0, help="the first of the three that a probe may take"
    )
    parser.add_argument(
        "--processes",
        type=whole_number,
        default=min(_PROCESSES, os.cpu_count() or 1),
        help="how many train at a time",
    )
    return parser
