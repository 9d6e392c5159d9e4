"""The atlas of implementations: exact learning curves of libraries that everybody uses.

    python docs/benchmarks/atlas install sbx                     # in a virtual environment of its own
    python docs/benchmarks/atlas implementations --seeds 5       # runs the rows that are not there yet
    python docs/benchmarks/atlas defaults --seeds 20 --estimate  # says how long that would take
    python docs/benchmarks/atlas draw                            # the pages' tables and figures
    python docs/benchmarks/atlas check sb3 --algorithms ppo      # plays saved models in FrozenLake-v1
    python docs/benchmarks/atlas repeat --seeds 5                # so many rows again from nothing

It can be stopped and started at any time; what docs/data/atlas.csv has is not run again.
"""

import argparse
import random
import sys
from pathlib import Path

import pages
import plan
import rows

from gridworld.base.errors import InputError


def main(words: list[str]) -> None:
    """Do what the command line says."""
    parser = argparse.ArgumentParser("atlas", usage=__doc__)
    option = parser.add_argument
    option("what", choices=("install", "implementations", "defaults", "draw", "check", "repeat"))
    ours = [name for name, library in plan.LIBRARIES.items() if not library.pins]
    option("libraries", nargs="*", help=f"of {', '.join(plan.LIBRARIES)}; default: {', '.join(ours)}")
    option("--algorithms", nargs="+", default=list(plan.MATCHED), choices=plan.MATCHED)
    option("--worlds", nargs="+", default=[], help="default: all of the page")
    option("--seeds", type=int, help="0 to N - 1; default: 50, of defaults 20")
    option("--jobs", type=int, default=2, help="processes at once")
    option("--estimate", action="store_true", help="run nothing, say how long it would take")
    option("--rows", type=Path, default=rows.ROWS, help="the CSV")
    options = parser.parse_args(words)
    if unknown := [name for name in options.libraries if name not in plan.LIBRARIES]:
        raise InputError(f"{unknown[0]}: must be among {', '.join(plan.LIBRARIES)}")
    libraries = options.libraries or ours
    if options.what == "install":
        for library in options.libraries:
            rows.install(library)
    elif options.what == "draw":
        pages.draw(rows.read(options.rows))
    elif options.what == "check":
        for job in plan.jobs("implementations", libraries, options.algorithms, ["frozen_lake"], 1):
            check(job)
    elif options.what == "repeat":
        repeat(rows.read(options.rows), options.seeds or 5)
    else:
        seeds = options.seeds or {"implementations": 50, "defaults": 20}[options.what]
        there = {row[: plan.KEY] for row in rows.read(options.rows)}
        wanted = plan.jobs(options.what, libraries, options.algorithms, options.worlds, seeds)
        todo = [job for job in wanted if job.key not in there]
        if options.estimate:
            print(rows.estimate(todo, options.rows, options.jobs))
        else:
            rows.run_all(todo, options.rows, options.jobs)


def check(job: plan.Job) -> None:
    """Train shortly, save, load and play FrozenLake-v1 as Gymnasium has it, against the exact return."""
    name, play = f"{job.library} {job.algorithm}", {"id": "FrozenLake-v1", "episodes": 2000}
    *_, before, last = rows.work([job], steps=10_240, play=play)
    if "played" not in last:
        print(f"{name}: saves no model of its own")
        return
    exact, played, error = before["score"].outcome.expected_return, last["played"], last["error"]
    print(f"{name}: exact {exact:.4f}, 2,000 episodes of the saved model {played:.4f} ± {error:.4f}")
    if abs(exact - played) > 4 * error + 1e-12:
        raise InputError(f"{name}: the two differ by more than 4 standard errors")


def repeat(found: list[rows.Row], count: int) -> None:
    """Train some rows, drawn at random, again from nothing."""
    pairs = [(row, plan.Job(*row[:3], w, int(row.seed))) for row in found for w in plan.worlds_of(row.page)]
    known = [(row, job) for row, job in pairs if job.key == row[: plan.KEY]]
    for row, job in random.sample(known, min(count, len(known))):
        [again] = rows.run([job])
        if again._replace(seconds=row.seconds) != row:
            raise InputError(f"repeat: the row is {row}\nand now {again}")
        print(f"{' '.join(row[:5])}: the same", flush=True)


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except InputError as error:
        sys.exit(str(error))
