"""Prove how good a finished run's policy is, with a certificate that anybody can check.

The certificate holds the world's rows, the policy, and bounds of what it and every policy are worth.
`python3 -I check_certificate.py FILE` checks it in exact fractions with Python alone.
Exit code: 0 if a bound is proven, 1 if none is, or not that a certified policy is optimal; 2 for a mistake.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from gridworld.base.console import printable, telling_if_slow
from gridworld.base.user_input import limited
from gridworld.commands import parser_of
from gridworld.training.saved_run import SavedRun
from gridworld.training.verify import proven

_NOT_PROVEN = 1  # the exit code


@limited()
def main(arguments: Sequence[str]) -> None:
    """Print what is proven, and write the certificate."""
    options = _parser().parse_args(arguments)
    with telling_if_slow(f"verifying {options.run}"):
        saved = SavedRun(options.run, options.trust, options.best)
        evaluator, claimed = saved.evaluator(), bool(saved.run.read_summary().get("certified"))
        verified = proven(evaluator, saved.snapshot().greedy)
    print(
        printable(f"{options.run} on {evaluator.mdp.name}, discount {evaluator.solution.gamma:g}: {verified}")
    )
    print(printable(f"  world: {evaluator.mdp.scope}"))
    if options.out is not None:
        verified.write(options.out)
        print(printable(f"  certificate: {options.out}"))
    if not verified.certificate or (claimed and not options.best and not verified.is_optimal):
        sys.exit(_NOT_PROVEN)


def _parser() -> argparse.ArgumentParser:
    parser = parser_of("verify", __doc__, "run", "--best", "--trust")
    out = "a file for the certificate, JSON; compressed if it ends with .gz"
    parser.add_argument("--out", type=Path, metavar="FILE", help=out)
    return parser
