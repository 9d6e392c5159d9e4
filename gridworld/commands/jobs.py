"""Show the status of a sweep's jobs, and update its jobs.csv, which is out of date after a kill."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from pathlib import Path

from gridworld.base.console import aligned, printable, telling_if_slow
from gridworld.base.user_input import limited
from gridworld.commands import parser_of
from gridworld.sweeps.console import counts_text
from gridworld.sweeps.folder import STATUSES, JobRow, open_sweep
from gridworld.world.metrics import regret_text


@limited()
def main(arguments: Sequence[str]) -> None:
    """Print a row per job, in the order in which they were asked for, and their number."""
    options = _parser().parse_args(arguments)
    sweep = open_sweep(options.sweep)
    with telling_if_slow(f"reading the jobs of {options.sweep}"):
        rows = sweep.rows()
        if os.access(sweep.path, os.W_OK):
            sweep.write(rows)
    cells = [_cells(row) for row in rows.values() if options.status in (None, row.status)]
    for line in aligned(cells, ("<0", "<12", ">9", "<0")):
        print(printable(line))
    print(counts_text(rows.values()))


def _cells(row: JobRow) -> list[str]:
    seconds = f"{row.seconds} s" if row.seconds else ""
    regret = f" regret {regret_text(float(row.objective))}" if row.objective else ""
    error = f" {row.error}" if row.error else ""
    return [row.job, f" {row.status}", seconds, f"{regret} {error}" if regret and error else regret + error]


def _parser() -> argparse.ArgumentParser:
    parser = parser_of("jobs", __doc__, example="runs/mine --status failed")
    parser.add_argument("sweep", type=Path, metavar="SWEEP", help="the sweep's folder, e.g. runs/mine")
    only = f"only jobs with this status: {', '.join(STATUSES)}"
    parser.add_argument("--status", choices=STATUSES, metavar="STATUS", help=only)
    return parser
