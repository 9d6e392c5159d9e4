"""Check an implementation of an algorithm on small worlds with known answers.

The algorithm trains on each world for a few seconds; its values and actions are compared with the exact ones.
Exit code: 0 if all probes pass, 1 if not, 2 for a mistake on the command line.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence

from gridworld.base.console import coloured, printable
from gridworld.checking.function import OBSERVATIONS
from gridworld.checking.probes import PROBES
from gridworld.checking.run import check
from gridworld.checking.training import arguments
from gridworld.commands import parser_of, whole
from gridworld.commands.findings import add_file_options, check_files, write_files

_PROCESSES = 2
_FAILED = 1  # the exit code


def main(words: Sequence[str]) -> None:
    """Print a row per probe as it ends, and the verdict."""
    options = _parser().parse_args(words)
    check_files(options)
    result = check(
        options.algorithm,
        arguments(options.set),
        options.probe,
        options.seed,
        options.processes,
        observation=options.observation,
        steps=options.steps,
        worlds=options.world,
        on_finding=lambda finding: print(*map(printable, str(finding).splitlines()), sep="\n", flush=True),
    )
    print(coloured(printable(result.verdict()), result.passed))
    write_files(result, options)
    if not result.passed:
        sys.exit(_FAILED)


def _parser() -> argparse.ArgumentParser:
    probes = "\n".join(f"  {probe.name:<13}{probe.meaning}" for probe in PROBES)
    epilog = f"The probes, and what a failure means:\n{probes}"
    parser = parser_of("check", __doc__, example="my_agent:train --probe truncation", epilog=epilog)
    option = parser.add_argument
    kinds = "my_agent:train, a function; my_agents:MyPPO, a class like SB3's; or dqn, a shipped agent"
    option("algorithm", metavar="ALGORITHM", help=kinds)
    argument = "an argument for it, e.g. learning_rate=0.001; may be repeated"
    option("--set", action="append", default=[], metavar="NAME=VALUE", help=argument)
    option("--probe", action="append", default=[], metavar="NAME", help="only this probe; may be repeated")
    world = "a world of your own to be solved too, e.g. my_env:Tiny or four_rooms; may be repeated"
    option("--world", action="append", default=[], metavar="NAME", help=world)
    shown = "what a train function sees of a state: its number, or a vector (default state)"
    option("--observation", choices=tuple(OBSERVATIONS), default="state", help=shown)
    option("--steps", type=whole(1), help="environment steps of a training run (default: 6,400 to 25,600)")
    option("--seed", type=whole(0), default=0, help="the first of up to three seeds (default 0)")
    processes = min(_PROCESSES, os.cpu_count() or 1)
    option("--processes", type=whole(1), default=processes, help="how many runs train at a time")
    add_file_options(parser)
    return parser
