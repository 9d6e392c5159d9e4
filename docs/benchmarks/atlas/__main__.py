"""The atlas of implementations: exact learning curves of libraries that everybody uses.

    python docs/benchmarks/atlas install sbx                    # a virtual environment of its own, pinned
    python docs/benchmarks/atlas implementations --seeds 5      # runs the rows that are not there yet
    python docs/benchmarks/atlas defaults --seeds 20 --estimate # says how long that would take
    python docs/benchmarks/atlas draw                           # the pages' tables and figures, of the CSV
    python docs/benchmarks/atlas check sb3                      # a saved model, played in Gymnasium's own world
    python docs/benchmarks/atlas repeat --rows 5                # some rows again from nothing

It can be stopped and started at any time; what docs/data/atlas.csv has is not run again.
"""

from __future__ import annotations

import argparse
import random
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).parents[3]))

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

        pages.draw(options.rows_file)
    elif options.what == "check":
        check(options.library, options.algorithm)
    elif options.what == "repeat":
        repeat(options.rows_file, options.rows, options.draw)
    else:
        given = (options.libraries, options.algorithms, options.worlds, options.seeds)
        todo = rows.missing(plan.jobs(options.what, *given), options.rows_file)
        if options.estimate:
            print(rows.estimate(todo, options.rows_file, options.jobs))
        elif failed := rows.run_all(todo, options.rows_file, options.jobs):
            raise InputError("\n".join([f"{len(failed)} rows failed:", *failed]))


def check(library: str, algorithm: str) -> None:
    """Train shortly, save, load and play FrozenLake-v1 as Gymnasium has it, against the exact return."""
    [job] = plan.jobs("implementations", [library], [algorithm], ["frozen_lake"], 1)
    known, score, told = {}, None, {}
    for line in rows.work(job, steps=10_240, play={"id": "FrozenLake-v1", "episodes": 2000}):
        told |= line
        if "actions" in line:
            score = rows.scored(job.world, line["actions"], known)
    if score is None or "played" not in told:
        raise InputError(f"check {library}: its models are not saved as files here")
    exact = score.outcome.expected_return
    print(
        f"{library} {algorithm}: exact return {exact:.4f}, 2,000 episodes of the saved model "
        f"{told['played']:.4f} ± {told['error']:.4f}"
    )
    if abs(exact - told["played"]) > 4 * told["error"] + 1e-12:
        raise InputError(f"check {library}: the two differ by more than 4 standard errors")


def repeat(path: Path, count: int, seed: int) -> None:
    """Train some rows, drawn at random, again from nothing."""
    known = {}
    for page in ("implementations", "defaults"):
        of_page = [row for row in rows.read(path) if row.page == page]
        seeds = 1 + max((int(row.seed) for row in of_page), default=-1)
        names = [sorted({getattr(row, name) for row in of_page}) for name in ("library", "algorithm", "world")]
        known |= {job.key: job for job in (plan.jobs(page, *names, seeds) if of_page else [])}
    there = [row for row in rows.read(path) if row.key in known]
    for row in random.Random(seed).sample(there, min(count, len(there))):
        again = rows.run(known[row.key])
        same = (again.curve, again.done, again.cause) == (row.curve, row.done, row.cause)
        print(f"{' '.join(row.key[:5])}: {'the same' if same else 'DIFFERENT'}", flush=True)
        if not same:
            raise InputError(f"repeat: the row has {row.curve}\nnow it is {again.curve}")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="atlas", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rows-file", type=Path, default=rows.ROWS, help="the CSV")
    commands = parser.add_subparsers(dest="what", required=True)
    pinned = [name for name, library in plan.LIBRARIES.items() if library.pins]
    commands.add_parser("install").add_argument("library", choices=pinned)
    commands.add_parser("draw")
    checked = commands.add_parser("check")
    checked.add_argument("library", choices=list(plan.LIBRARIES))
    checked.add_argument("algorithm", nargs="?", default="dqn", choices=list(plan.MATCHED))
    again = commands.add_parser("repeat")
    again.add_argument("--rows", type=int, default=5)
    again.add_argument("--draw", type=int, default=0, help="the seed by which rows are drawn")
    for page, seeds in (("implementations", 50), ("defaults", 20)):
        of_page = commands.add_parser(page)
        option = of_page.add_argument
        ours = ["sb3", "engine", "plain"]
        option("--libraries", nargs="+", default=ours, choices=list(plan.LIBRARIES))
        option("--algorithms", nargs="+", default=list(plan.MATCHED), choices=list(plan.MATCHED))
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
