"""Prove how good the policies of finished runs are, by certificates that anybody can check.

A certificate holds the world's rows, the policy, and bounds of what it and every policy are worth.
`python3 -I check_certificate.py FILE` checks it in exact fractions with Python alone.
Exit code: 0 if a bound is proven of every run; 1 if there is none of one, or a certified policy is not proven
optimal; 2 for a mistake.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from gridworld.base.console import coloured, printable, tell_error, telling_if_slow
from gridworld.base.errors import EXIT_CODE, InputError
from gridworld.base.user_input import limited
from gridworld.commands import parser_of
from gridworld.report.evidence import find_runs
from gridworld.training.saved_run import SavedRun
from gridworld.training.verify import Verified, check_certificate_file, proven

_NOT_PROVEN = 1  # the exit code


def main(arguments: Sequence[str]) -> None:
    """Print what is proven of each run, and write the certificate of one."""
    options = _parser().parse_args(arguments)
    folders, problems = find_runs(options.runs)
    if problems:
        raise InputError(problems[0])
    if options.out is not None:
        if len(folders) > 1:
            raise InputError(f"--out {options.out}: is for one run, and there are {len(folders)}")
        check_certificate_file(options.out)
    proofs, mistakes = list[tuple[Verified, bool]](), 0
    for folder in folders:
        try:
            proofs.append(_verified(folder, options))
        except InputError as error:
            if len(folders) == 1:
                raise
            mistakes += 1
            tell_error(str(error))
    claimed = [verified for verified, is_certified in proofs if is_certified]
    optimal = sum(verified.is_optimal for verified in claimed)
    if len(proofs) > 1:
        unread = f"; {mistakes} could not be read" if mistakes else ""
        in_all = f"of {len(proofs)} in all{unread}"
        print(f"{optimal} of {len(claimed)} certified runs are proven optimal, {in_all}")
    if options.out is not None:
        proofs[0][0].write(options.out)
        print(printable(f"  certificate: {options.out}"))
    if mistakes:
        sys.exit(EXIT_CODE)
    if optimal < len(claimed) or not all(verified.certificate for verified, _ in proofs):
        sys.exit(_NOT_PROVEN)


@limited()
def _verified(folder: Path, options: argparse.Namespace) -> tuple[Verified, bool]:
    """What is proven of a run, which is printed, and whether it says that it is certified."""
    with telling_if_slow(f"verifying {folder}"):
        saved = SavedRun(folder, options.trust, options.best)
        evaluator = saved.evaluator()
        verified = proven(evaluator, saved.snapshot().greedy)
    is_certified = saved.run.read_summary()["certified"] and not options.best
    mdp, gamma = evaluator.mdp, evaluator.solution.gamma
    shown = coloured(printable(str(verified)), verified.is_optimal)
    print(f"{printable(f'{folder} on {mdp.name}, discount {gamma:g}')}: {shown}")
    print(printable(f"  world: {mdp.scope}"), flush=True)
    return verified, is_certified


def _parser() -> argparse.ArgumentParser:
    parser = parser_of(
        "verify", __doc__, "runs", "--best", "--trust", example="runs/mine --out certificate.json"
    )
    out = "a file for the certificate of the only run, JSON; compressed if it ends with .gz"
    parser.add_argument("--out", type=Path, metavar="FILE", help=out)
    return parser
