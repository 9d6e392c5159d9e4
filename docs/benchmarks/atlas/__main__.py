"""The atlas of implementations: exact learning curves of libraries that everybody uses.

    python docs/benchmarks/atlas install sbx                     # in a virtual environment of its own
    python docs/benchmarks/atlas implementations --seeds 5       # runs the rows that are not there yet
    python docs/benchmarks/atlas defaults --seeds 20 --estimate  # says how long that would take
    python docs/benchmarks/atlas draw                            # the pages' tables and figures
    python docs/benchmarks/atlas check sb3                       # plays a saved model in FrozenLake-v1
    python docs/benchmarks/atlas repeat --count 5                # some rows again from nothing

It can be stopped and started at any time; what docs/data/atlas.csv has is not run again.
"""

from __future__ import annotations

import argparse
import random
import sys
from pathlib import Path

import plan
import rows

from gridworld.base.errors import InputError


def main(words: list[str]) -> None:
    """Do what the command line says."""
    options = _parser().parse_args(words)
    if options.what == "install":
        rows.install(options.library)
    elif options.what == "draw":
        import pages

        pages.draw(rows.read(options.rows))
    elif options.what == "check":
        check(options.library, options.algorithm)
    elif options.what == "repeat":
        repeat(options.rows, options.count, options.draw)
    else:
        given = (options.libraries, options.algorithms, options.worlds, options.seeds)
        todo = rows.missing(plan.jobs(options.what, *given), options.rows)
        if options.estimate:
            print(rows.estimate(todo, options.rows, options.jobs))
        elif failed := rows.run_all(todo, options.rows, options.jobs):
            raise InputError("\n".join([f"{len(failed)} rows failed:", *failed]))


def check(library: str, algorithm: str) -> None:
    """Train shortly, save, load and play FrozenLake-v1 as Gymnasium has it, against the exact return."""
    last = {}
    for job in plan.jobs("implementations", [library], [algorithm], ["frozen_lake"], 1):
        for line in rows.work(job, steps=10_240, play={"id": "FrozenLake-v1", "episodes": 2000}):
            last |= line
    if "played" not in last:
        raise InputError(f"check {library} {algorithm}: saves no model of its own")
    exact, played, error = last["score"].outcome.expected_return, last["played"], last["error"]
    print(f"{library} {algorithm}: exact {exact:.4f}, 2,000 episodes played {played:.4f} ± {error:.4f}")
    if abs(exact - played) > 4 * error + 1e-12:
        raise InputError(f"check {library}: the two differ by more than 4 standard errors")


def repeat(path: Path, count: int, seed: int) -> None:
    """Train some rows, drawn at random, again from nothing."""
    found = {row[: rows.KEY]: row for row in rows.read(path)}
    seeds = 1 + max((int(row.seed) for row in found.values()), default=-1)
    every = [sorted({row[column] for row in found.values()}) for column in (1, 2)]  # libraries, algorithms
    known = [job for page in ("implementations", "defaults") for job in plan.jobs(page, *every, [], seeds)]
    there = [job for job in known if job.key in found]
    for job in random.Random(seed).sample(there, min(count, len(there))):
        row, again = found[job.key], rows.run(job)
        is_same = again._replace(seconds=row.seconds) == row
        print(f"{' '.join(row[:5])}: {'the same' if is_same else 'different'}", flush=True)
        if not is_same:
            raise InputError(f"repeat: the row is {row}\nand now {again}")


def _parser() -> argparse.ArgumentParser:
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser("atlas", description=__doc__, formatter_class=raw)
    parser.add_argument("--rows", type=Path, default=rows.ROWS, help="the CSV")
    commands = parser.add_subparsers(dest="what", required=True)
    pinned = [name for name, library in plan.LIBRARIES.items() if library.pins]
    commands.add_parser("install").add_argument("library", choices=pinned)
    commands.add_parser("draw")
    checked = commands.add_parser("check")
    checked.add_argument("library", choices=plan.LIBRARIES)
    checked.add_argument("algorithm", nargs="?", default="dqn", choices=plan.MATCHED)
    again = commands.add_parser("repeat")
    again.add_argument("--count", type=int, default=5)
    again.add_argument("--draw", type=int, default=0, help="the seed by which rows are drawn")
    for page, seeds in (("implementations", 50), ("defaults", 20)):
        option = commands.add_parser(page).add_argument
        ours = [name for name in plan.LIBRARIES if name not in pinned]
        option("--libraries", nargs="+", default=ours, choices=plan.LIBRARIES)
        option("--algorithms", nargs="+", default=list(plan.MATCHED), choices=plan.MATCHED)
        option("--worlds", nargs="+", default=[], help="default: all of the page")
        option("--seeds", type=int, default=seeds, help="0 to N - 1")
        option("--jobs", type=int, default=2, help="processes at once")
        option("--estimate", action="store_true", help="run nothing, say how long it would take")
    return parser


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except InputError as error:
        sys.exit(str(error))
