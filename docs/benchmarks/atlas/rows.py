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
    kinds: dict[str, Any] = {"done": int, "every": int, "seconds": float, "regret": float}
    found = csv.DictReader(path.read_text("utf-8").splitlines() if path.exists() else [])
    try:
        return [Row(**{name: kinds.get(name, str)(row[name]) for name in Row._fields}) for row in found]
    except (KeyError, TypeError, ValueError):
        raise InputError(f"{path}: has other columns or half a line; delete that line") from None


def append(path: Path, row: Row) -> None:
    """Add a row, and before the first one the names of the columns."""
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = [row] if path.exists() else [Row._fields, row]
    with path.open("a", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(lines)


def work(jobs: list[Job], **more: Any) -> list[dict[str, Any]]:
    """What a worker writes for jobs that differ in their seeds; lines with actions have a `score`."""
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
    lines, found = work(jobs), []
    seconds = round((time.perf_counter() - started) / len(jobs), 1)
    for job in jobs:
        curve, since, last, text = [], "", {"cause": ""}, ""
        for line in (each for each in lines if each["seed"] == job.seed):
            last |= line
            if "regret" in line:
                since = (since or str(line["step"])) if line["certified"] else ""
                before, text = text, "0*" if line["certified"] else f"{line['regret']:.9g}"
                curve += [f"{line['step']}:{text}"] if text != before else []
        rest = seconds, since, float(text.rstrip("*")), last["cause"], " ".join(curve)
        found.append(Row(*job.key, last["step"], job.content["every"], *rest))
    return found


def estimate(jobs: list[Job], path: Path, processes: int) -> str:
    """How long the jobs take, by the rows that are there."""
    seconds, kinds = defaultdict(list), [job.key[:3] for job in jobs]
    for row in read(path):
        seconds[row[:3]].append(row.seconds)
    known = [statistics.median(seconds[kind]) for kind in kinds if kind in seconds]
    unknown = ", ".join(sorted({" ".join(kind[1:]) for kind in kinds if kind not in seconds}))
    text = f"{len(jobs)} rows to run; {len(known)} of them take {sum(known) / processes / 3600:.2f} hours"
    return text + (f"; no time is known of {unknown}" if unknown else "")


def run_all(jobs: list[Job], path: Path, processes: int) -> None:
    """Run jobs, so many processes at once, the engine's seeds as one population; says what failed."""
    failed, done, batches = [], 0, defaultdict(list)
    for job in jobs:
        batches[job.key[:4], None if job.library == "engine" else job.seed].append(job)
    with ThreadPoolExecutor(processes) as pool:
        futures = [pool.submit(run, batch) for batch in batches.values()]
        try:
            for future in as_completed(futures):
                if isinstance(error := future.exception(), InputError):
                    failed.append(str(error))
                    continue
                for done, row in enumerate(future.result(), done + 1):  # noqa: B020
                    append(path, row)
                    end = f"certified since {row.certified_since}" if row.certified_since else "not certified"
                    print(f"{done}/{len(jobs)} {' '.join(row[1:5])}: {end}, {row.seconds} s", flush=True)
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
    if failed:
        raise InputError("\n".join([f"{len(failed)} rows failed:", *failed]))


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
