"""Measure how fast this is beside named peers, in turn in the same run; only ratios are worth quoting."""

from __future__ import annotations

import argparse
import os
import platform
from collections.abc import Iterator, Sequence
from importlib import import_module
from pathlib import Path

from gridworld.benchmark.measure import FULL, QUICK, ComparisonResult, Workload, lines
from gridworld.errors import InputError
from gridworld.process.console.command_line import program
from gridworld.run.claim import check_inside, check_writable
from gridworld.storage.atomic_write import write_json

# By the table's name on the command line: its module, imported where it is asked for.
_TABLES = {table: table for table in ("stepping", "training", "worlds", "population")}
_TABLES |= {"whole": "end_to_end", "files": "file_system"}


def main(arguments: Sequence[str]) -> None:
    """Print the tables as they are measured, and write them as JSON."""
    options = _parser().parse_args(arguments)
    check_inside(options.out, "--out")
    if not options.out.parent.is_dir():
        raise InputError(f"--out {options.out}: there is no folder {options.out.parent}")
    if options.out.is_dir():
        raise InputError(f"--out {options.out}: is a folder; name a file in it")
    check_writable(options.out.parent, "--out")
    workload = QUICK if options.quick else FULL
    results: list[ComparisonResult] = []
    print(
        f"medians of {workload.repetitions}, one torch thread, {platform.machine()}, {os.cpu_count()} cores"
    )
    for line in lines(_kept(_measured(workload, options.only), results)):
        print(line, flush=True)
    write_json(options.out, {"scale": vars(workload), "results": [vars(result) for result in results]})


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog=program("benchmark"), description=__doc__)
    parser.add_argument("--quick", action="store_true", help="minutes: one short repetition of everything")
    parser.add_argument(
        "--only", choices=list(_TABLES), nargs="+", default=list(_TABLES), help="some of the tables"
    )
    parser.add_argument("--out", type=Path, default=Path("runs/benchmark.json"), help="where the JSON goes")
    return parser


def _measured(workload: Workload, tables: Sequence[str]) -> Iterator[ComparisonResult]:
    for table in (known for known in _TABLES if known in tables):
        for comparison in import_module(f"gridworld.benchmark.{_TABLES[table]}").comparisons(workload):
            yield comparison.measure(workload.repetitions)


def _kept(results: Iterator[ComparisonResult], where: list[ComparisonResult]) -> Iterator[ComparisonResult]:
    for result in results:
        where.append(result)
        yield result
