"""Measure the speed of this project and its peers in turn, in one run; only the ratios are comparable."""

from __future__ import annotations

import argparse
import os
import platform
import sys
from collections.abc import Iterator, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

from gridworld.base.atomic_write import write_json
from gridworld.base.console import program
from gridworld.base.errors import InputError
from gridworld.commands import parser_of
from gridworld.run.folder import check_file, check_inside

_DOCS = Path(__file__).resolve().parents[2] / "docs"  # where the measurements are, in the source
# By the table's name on the command line: its module, imported where it is asked for.
_TABLES = {table: table for table in ("stepping", "training", "worlds", "population")}
_TABLES |= {"whole": "end_to_end", "files": "file_system"}


def main(arguments: Sequence[str]) -> None:
    """Print the tables as they are measured, and write them as JSON."""
    options = _parser().parse_args(arguments)
    check_inside(options.out, "--out")
    check_file(options.out, "--out")
    if not (_DOCS / "benchmarks").is_dir():
        raise InputError(f"{program('benchmark')}: needs docs/benchmarks of a source checkout")
    sys.path.insert(0, str(_DOCS))
    measure = import_module("benchmarks.measure")
    workload = measure.QUICK if options.quick else measure.FULL
    results: list[Any] = []

    def measured() -> Iterator[Any]:
        for table in (known for known in _TABLES if known in options.only):
            for comparison in import_module(f"benchmarks.{_TABLES[table]}").comparisons(workload):
                results.append(comparison.measure(workload.repetitions))
                yield results[-1]

    machine = f"{platform.machine()}, {os.cpu_count()} cores"
    print(f"medians of {workload.repetitions}, one torch thread, {machine}")
    for line in measure.lines(measured()):
        print(line, flush=True)
    write_json(options.out, {"scale": vars(workload), "results": [vars(result) for result in results]})


def _parser() -> argparse.ArgumentParser:
    parser = parser_of("benchmark", __doc__)
    option = parser.add_argument
    option("--quick", action="store_true", help="one short repetition of everything, which takes minutes")
    option("--only", choices=list(_TABLES), nargs="+", default=list(_TABLES), help="only these tables")
    option("--out", type=Path, default=Path("runs/benchmark.json"), help="the JSON file to write")
    return parser
