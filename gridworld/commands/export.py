"""Export finished runs to Weights & Biases, MLflow, the Hugging Face Hub, or their worlds to Storm.

RUNS are folders of runs or sweeps, or any above them. Nothing is uploaded by default: W&B writes offline runs
(unless WANDB_MODE is set), MLflow a local database (unless MLFLOW_TRACKING_URI is set). Runs exported before
are skipped. Exit code: 0 if every run is exported whole, 1 if some are not, or lack a file, 2 if none is.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from gridworld.base.console import printable, telling_if_slow
from gridworld.base.errors import InputError, reason
from gridworld.base.safe_read import check_no_link
from gridworld.base.user_input import limited
from gridworld.commands import parser_of
from gridworld.report.evidence import find_runs
from gridworld.report.export.exported_run import read
from gridworld.report.export.targets import TARGETS, check_installed
from gridworld.run.folder import alone_in, check_inside, check_writable

_LONGEST_WAIT = 600.0  # seconds for another export to the same folder


@limited()
def main(arguments: Sequence[str]) -> None:
    """Export the runs, and print where they are."""
    options = _parser().parse_args(arguments)
    out: Path = options.out or Path("runs/export") / options.to
    if options.out is not None:
        check_inside(out, "--out")
    check_installed(options.to)
    check_no_link(out)
    check_writable(out, "--out")
    folders, problems = find_runs(options.runs)
    place = None
    with telling_if_slow("exporting the runs"):
        for folder in folders:
            try:
                place, damage = _export(folder, options.to, out, options.project)
                problems += damage
                print(printable(f"{folder}: {place}"), flush=True)
            except InputError as error:
                problems.append(str(error))
    if place is None:
        raise InputError(problems[0])
    for problem in problems:
        print(f"warning: {printable(problem)}", file=sys.stderr)
    if "://" not in place or place.startswith("sqlite"):
        then = TARGETS[options.to].then.format(out=shlex.quote(str(out)), place=shlex.quote(place))
        print(printable(f"next: {then}"))
    if problems:
        sys.exit(1)


def _export(folder: Path, to: str, out: Path, project: str) -> tuple[str, tuple[str, ...]]:
    """Where the run is now, and a sentence for each of its files that it lacks there."""
    with TemporaryDirectory(prefix="gridworld-") as copies:
        run = read(folder, Path(copies))
        out.mkdir(parents=True, exist_ok=True)
        try:
            with alone_in(out, _LONGEST_WAIT):  # two at once would make one database, or remove each other's
                return TARGETS[to].write(run, out, project), run.evidence.damage
        except (InputError, OSError):
            raise
        except Exception as error:  # of packages that are not ours
            why = " ".join(reason(error).split())[:500]
            raise InputError(f"{folder}: --to {to} failed: {why}") from error


def _parser() -> argparse.ArgumentParser:
    parser = parser_of("export", __doc__, "runs", example="runs/mine --to hub")
    option = parser.add_argument
    option("--to", choices=tuple(TARGETS), required=True, help="wandb and mlflow need the extra of that name")
    option("--out", type=Path, help="the folder to write to (default runs/export/TARGET)")
    option("--project", default="gridworld", help="W&B's project, MLflow's experiment (default: gridworld)")
    return parser
