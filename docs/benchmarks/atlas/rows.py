"""Rows: workers are run, their policies scored exactly, and each result appended to one CSV, once."""

import csv
import json
import os
import statistics
import subprocess
import sys
import time
from collections import defaultdict
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from plan import LIBRARIES, ROOM, ROOT, Job, evaluator, python_of

from gridworld.base.errors import InputError
from gridworld.world.chain import one_hot_policy

ROWS = ROOT / "docs" / "data" / "atlas.csv"


class Row(NamedTuple):
    """A run, as the CSV has it."""

    page: str
    library: str
    algorithm: str
    world: str
    seed: str
    digest: str  # of settings, steps and the world's tables
    versions: str
    done: int  # environment steps
    every: int
    seconds: float  # until the worker has ended, a run
    certified_since: str  # the first evaluation after which no later one fails; "" where the last one does
    regret: float  # of the last policy
    cause: str  # why it is not certified, where `diagnose` was asked
    curve: str  # "step:regret" wherever it changed; where certified, "step:0*"

    def points(self) -> tuple[np.ndarray, np.ndarray]:
        """The steps at which its policy was read, and the regret there."""
        steps = np.unique([*range(0, self.done, self.every), self.done])
        changes = [point.split(":") for point in self.curve.split()]
        places = np.searchsorted([int(step) for step, _ in changes], steps, side="right") - 1
        return steps, np.array([float(text.rstrip("*")) for _, text in changes])[places]


def read(path: Path) -> list[Row]:
    """All rows of a file; none where there is no file."""
    if not path.exists():
        return []
    kinds: dict[str, Any] = {"done": int, "every": int, "seconds": float, "regret": float}
    with path.open(encoding="utf-8", newline="") as file:
        try:
            found = list(csv.DictReader(file))
            lines = [{name: kinds.get(name, str)(row[name]) for name in Row._fields} for row in found]
        except (KeyError, TypeError, ValueError):
            raise InputError(f"{path}: has other columns or half a line; delete that line") from None
    return [Row(**line) for line in lines]


def append(path: Path, row: Row) -> None:
    """Add a row, and before the first one the names of the columns."""
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = [row] if path.exists() else [Row._fields, row]
    with path.open("a", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(lines)


def work(jobs: list[Job], **more: Any) -> list[dict[str, Any]]:
    """The lines that a worker writes for jobs that differ in their seeds; those with actions have a `score`."""
    job, seeds = jobs[0], [each.seed for each in jobs]
    task = {**job.content, "seeds": seeds, "world": job.world.tables, "room": str(ROOM), **more}
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONWARNINGS": "ignore", "PYTHONPATH": str(ROOT)}
    command = [str(python_of(job.library)), str(Path(__file__).with_name("adapters.py"))]
    done = subprocess.run(command, input=json.dumps(task), capture_output=True, text=True, env=environment)
    if done.returncode:
        last = (done.stderr.strip() or "it ended without a word").splitlines()[-1]
        raise InputError(f"{' '.join(job.key[1:5])}: {last}")
    lines, known = [json.loads(line) for line in done.stdout.splitlines()], {}
    for line in lines:
        if actions := tuple(line.pop("actions", ())):
            if actions not in known:
                policy = one_hot_policy(np.array(actions), job.world.mdp.num_actions)
                known[actions] = evaluator(job.world, job.gamma).score(policy)
            score = line["score"] = known[actions]
            line |= {"regret": score.regret, "certified": score.certified}
    return lines


def run(jobs: list[Job]) -> list[Row]:
    """Train jobs that differ in their seeds, and make a row of each."""
    started = time.perf_counter()
    lines = work(jobs)
    seconds = round((time.perf_counter() - started) / len(jobs), 1)
    return [_row(job, [line for line in lines if line["seed"] == job.seed], seconds) for job in jobs]


def _row(job: Job, lines: list[dict[str, Any]], seconds: float) -> Row:
    curve, since, before, last = [], "", "", {"cause": ""}
    for line in lines:
        last |= line
        if "regret" in line:
            since = (since or str(line["step"])) if line["certified"] else ""
            text = "0*" if line["certified"] else f"{line['regret']:.9g}"
            curve += [f"{line['step']}:{text}"] if text != before else []
            before = text
    regret = float(before.rstrip("*"))
    rest = last["step"], job.content["every"], seconds, since, regret, last["cause"], " ".join(curve)
    return Row(*job.key, *rest)


def estimate(jobs: list[Job], path: Path, processes: int) -> str:
    """How long the jobs take, by the rows that are there."""
    seconds = defaultdict(list)
    for row in read(path):
        seconds[row.page, row.library, row.algorithm].append(row.seconds)
    kinds = [(job.page, job.library, job.algorithm) for job in jobs]
    known = [statistics.median(seconds[kind]) for kind in kinds if kind in seconds]
    unknown = ", ".join(sorted({" ".join(kind[1:]) for kind in kinds if kind not in seconds}))
    text = f"{len(jobs)} rows to run; {len(known)} of them take {sum(known) / processes / 3600:.2f} hours"
    return text + (f"; no time is known of {unknown}" if unknown else "")


def run_all(jobs: list[Job], path: Path, processes: int) -> list[str]:
    """Run jobs, so many processes at once, the engine's seeds as one population; returns what failed."""
    failed, count, batches = [], 0, defaultdict(list)
    for job in jobs:
        batches[job.key[:4], None if job.library == "engine" else job.seed].append(job)
    with ThreadPoolExecutor(processes) as pool:
        futures = [pool.submit(run, batch) for batch in batches.values()]
        try:
            for future in as_completed(futures):
                if isinstance(error := future.exception(), InputError):
                    failed.append(str(error))
                    continue
                for count, row in enumerate(future.result(), count + 1):
                    append(path, row)
                    end = f"certified since {row.certified_since}" if row.certified_since else "not certified"
                    print(f"{count}/{len(jobs)} {' '.join(row[1:5])}: {end}, {row.seconds} s", flush=True)
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
    return failed


def install(library: str) -> None:
    """Make a library's virtual environment of its pins, and fetch its source if it has one.

    The environment variable ATLAS_SOURCE names another copy of that repository, a folder or an address.
    """
    folder, (_, _, pins, (address, commit), _) = ROOM / library, LIBRARIES[library]
    subprocess.run([sys.executable, "-m", "venv", folder], check=True)
    subprocess.run([folder / "bin" / "python", "-m", "pip", "install", "-q", *pins.split()], check=True)
    if address and not (folder / "source").exists():
        address = os.environ.get("ATLAS_SOURCE", address)
        subprocess.run(["git", "clone", "-q", "-n", address, folder / "source"], check=True)
        subprocess.run(["git", "-C", folder / "source", "checkout", "-q", commit], check=True)
