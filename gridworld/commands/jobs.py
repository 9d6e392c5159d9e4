"""Show how the jobs of a sweep stand, and put its jobs.csv right: after a kill, say."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from pathlib import Path

from gridworld.process.console import aligned, printable, program, telling_if_slow
from gridworld.process.user_input import limited
from gridworld.sweep.console import counts_text
from gridworld.sweep.folder import open_sweep
from gridworld.sweep.job_table import JOBS_CSV, STATUSES, JobRow, JobTable
from gridworld.world.metrics import regret_text


@limited()
def main(arguments: Sequence[str]) -> None:
    """Print a row per job, in the order in which they were asked for, and their number."""
    options = _parser().parse_args(arguments)
    folder = open_sweep(options.sweep)
    table = JobTable(folder.path)
    entries = folder.entries.values()
    with telling_if_slow(f"reading the jobs of {options.sweep}"):
        rows = table.inspect(entries, table.read())
        if os.access(folder.path, os.W_OK):
            table.write(rows)
    shown = [row for row in rows.values() if options.status in (None, row.status)]
    with_error = {row.job for row in shown if row.error}
    verified = table.inspect([entry for entry in entries if entry.job in with_error], {})
    cells = [_cells(row, verified.get(row.job)) for row in shown]
    for line in aligned(cells, ("<0", "<12", ">9", "<0")):
        print(printable(line))
    print(counts_text(rows.values()))


def _cells(row: JobRow, verified: JobRow | None) -> list[str]:
    """The columns of a job; an error that its own folder does not confirm is marked."""
    seconds = f"{row.seconds} s" if row.seconds else ""
    regret = f" regret {regret_text(float(row.objective))}" if row.objective else ""
    error = f" {row.error}" if row.error else ""
    if verified is not None and verified.error != row.error:
        error += f" (says {JOBS_CSV} alone)"
    return [row.job, f" {row.status}", seconds, f"{regret} {error}" if regret and error else regret + error]


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog=program("jobs"), description=__doc__)
    parser.add_argument("sweep", type=Path, help="the sweep's folder, e.g. runs/mine")
    parser.add_argument("--status", choices=STATUSES, help="only the jobs that stand like this")
    return parser
