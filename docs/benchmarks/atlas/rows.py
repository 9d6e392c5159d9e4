"""Rows: workers are run, their policies scored exactly, and each result appended to one CSV, once."""

from __future__ import annotations

import csv
import json
import os
import statistics
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from plan import LIBRARIES, ROOM, ROOT, Job, python_of

from gridworld.base.errors import InputError
from gridworld.world.chain import one_hot_policy
from gridworld.world.evaluation import Score

ROWS = ROOT / "docs" / "data" / "atlas.csv"
KEY = 7  # fields by which a row is known
_START = 5.0  # seconds until a worker trains


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
    seconds: float
    certified_since: str  # the first evaluation after which no later one fails; "" where the last one does
    regret: float  # of the last policy
    cause: str  # why it is not certified, where `diagnose` was asked
    curve: str  # "step:regret", with "*" where certified, wherever that changed

    def regrets(self) -> np.ndarray:
        """The regret at each point of `grid`, certified ones as 0."""
        points = [point.split(":") for point in self.curve.split()]
        values = np.array([0.0 if text.endswith("*") else float(text) for _, text in points])
        places = np.searchsorted([int(step) for step, _ in points], grid(self.done, self.every), side="right")
        return values[places - 1]


def grid(done: int, every: int) -> np.ndarray:
    """The steps at which a policy is read."""
    return np.unique([*range(0, done, every), done])


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
            raise InputError(
                f"{path}: has other columns or a line that is cut off; delete that line"
            ) from None
    return [Row(**line) for line in lines]


def append(path: Path, row: Row) -> None:
    """Add a row, and before the first one the names of the columns."""
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = [row] if path.exists() else [Row._fields, row]
    with path.open("a", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(lines)


def work(job: Job, **more: Any) -> Iterator[dict[str, Any]]:
    """The lines that a worker writes for a job; those with actions have their exact `score`."""
    task = {**job.content, "seed": job.seed, "world": job.world.tables, "room": str(ROOM), **more}
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONWARNINGS": "ignore"}
    if job.content["library"] == "engine":
        environment["PYTHONPATH"] = str(ROOT)
    command = [str(python_of(job.library)), str(Path(__file__).with_name("adapters.py"))]
    known: dict[str, Score] = {}
    with tempfile.TemporaryFile("w+", encoding="utf-8") as errors, subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors, text=True, env=environment
    ) as process:  # fmt: skip
        try:
            assert process.stdin
            assert process.stdout
            process.stdin.write(json.dumps(task) + "\n")
            process.stdin.close()
            for line in map(json.loads, process.stdout):
                if actions := line.pop("actions", None):
                    if str(actions) not in known:
                        policy = one_hot_policy(np.array(actions), job.world.mdp.num_actions)
                        known[str(actions)] = job.world.evaluator.score(policy)
                    score = line["score"] = known[str(actions)]
                    line |= {"regret": score.regret, "certified": score.certified}
                yield line
            if process.wait():
                errors.seek(0)
                last = (errors.read().strip() or "it ended without a word").splitlines()[-1]
                raise InputError(f"{' '.join(job.key[1:5])}: {last}")
        finally:
            process.kill()


def run(job: Job) -> Row:
    """Train a job, and make a row of it."""
    curve, since, before, last = [], "", "", {"cause": ""}
    for line in work(job):
        last |= line
        if "regret" in line:
            since = (since or str(line["step"])) if line["certified"] else ""
            text = f"{line['regret']:.9g}{'*' if line['certified'] else ''}"
            curve += [f"{line['step']}:{text}"] if text != before else []
            before = text
    regret = 0.0 if since else float(f"{last['regret']:.9g}")
    rest = (job.content["every"], round(last["seconds"], 1), since, regret, last["cause"], " ".join(curve))
    return Row(*job.key, last["step"], *rest)


def missing(jobs: list[Job], path: Path) -> list[Job]:
    """The jobs of which there is no row."""
    there = {row[:KEY] for row in read(path)}
    return [job for job in jobs if job.key not in there]


def estimate(jobs: list[Job], path: Path, processes: int) -> str:
    """How long the jobs take, by the rows that are there."""
    seconds = defaultdict(list)
    for row in read(path):
        seconds[row.page, row.library, row.algorithm].append(row.seconds + _START)
    kinds = [(job.page, job.library, job.algorithm) for job in jobs]
    known = [statistics.median(seconds[kind]) for kind in kinds if kind in seconds]
    unknown = ", ".join(sorted({" ".join(kind[1:]) for kind in kinds if kind not in seconds}))
    text = f"{len(jobs)} rows to run; {len(known)} of them take {sum(known) / processes / 3600:.2f} hours"
    return text + (f"; no time is known of {unknown}" if unknown else "")


def run_all(jobs: list[Job], path: Path, processes: int) -> list[str]:
    """Run jobs, so many at once; returns what failed."""
    failed = []
    with ThreadPoolExecutor(processes) as pool:
        futures = [pool.submit(run, job) for job in jobs]
        try:
            for count, future in enumerate(as_completed(futures), 1):
                if isinstance(error := future.exception(), InputError):
                    failed.append(str(error))
                    continue
                append(path, row := future.result())
                end = f"certified since {row.certified_since}" if row.certified_since else "not certified"
                print(f"{count}/{len(jobs)} {' '.join(row[1:5])}: {end}, {row.seconds} s", flush=True)
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
    return failed


def install(library: str) -> None:
    """Make a library's virtual environment of its pins, and fetch its source if it has one.

    The environment variable ATLAS_SOURCE names another copy of that repository, a folder or an address.
    """
    folder, (_, _, pins, (address, commit)) = ROOM / library, LIBRARIES[library]
    subprocess.run([sys.executable, "-m", "venv", folder], check=True)
    subprocess.run([folder / "bin" / "python", "-m", "pip", "install", "-q", *pins], check=True)
    if address and not (folder / "source").exists():
        address = os.environ.get("ATLAS_SOURCE", address)
        subprocess.run(["git", "clone", "-q", "-n", address, folder / "source"], check=True)
        subprocess.run(["git", "-C", folder / "source", "checkout", "-q", commit], check=True)
