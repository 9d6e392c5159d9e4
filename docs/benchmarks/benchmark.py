"""Measure the speed of this project and its peers in turn, in one run; only the ratios are comparable.

python docs/benchmarks/benchmark.py --quick --only stepping training
"""

from __future__ import annotations

import argparse
import os
import platform
import sys
from collections.abc import Iterator, Sequence
from importlib import import_module
from pathlib import Path

from gridworld.base.atomic_write import write_json
from gridworld.base.errors import InputError
from gridworld.run.folder import check_file, check_inside

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks import measure

# By the table's name on the command line: its module, imported where it is asked for.
_TABLES = {table: table for table in ("stepping", "training", "worlds", "population")}
_TABLES |= {"whole": "end_to_end", "files": "file_system"}


def main(arguments: Sequence[str]) -> None:
    """Print the tables as they are measured, and write them as JSON."""
    options = _parser().parse_args(arguments)
    check_inside(options.out, "--out")
    check_file(options.out, "--out")
    workload = measure.QUICK if options.quick else measure.FULL
    results: list[measure.ComparisonResult] = []

    def measured() -> Iterator[measure.ComparisonResult]:
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
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    option = parser.add_argument
    only = f"only these tables: {', '.join(_TABLES)}"
    option("--quick", action="store_true", help="one short repetition of everything, which takes minutes")
    option("--only", choices=list(_TABLES), nargs="+", metavar="TABLE", default=list(_TABLES), help=only)
    option("--out", type=Path, default=Path("runs/benchmark.json"), help="the JSON file to write")
    return parser


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except InputError as error:
        sys.exit(str(error))
