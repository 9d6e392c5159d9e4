"""Rows: workers are run, their policies scored exactly, and each result appended to one CSV, once."""

from __future__ import annotations

import csv
import json
import math
import os
import statistics
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from plan import LIBRARIES, ROOT, Job, World, python_of

from gridworld.base.errors import InputError
from gridworld.world.chain import one_hot_policy
from gridworld.world.evaluation import Score

ROWS = ROOT / "docs" / "data" / "atlas.csv"
_WORKER = Path(__file__).with_name("adapters.py")


@dataclass(frozen=True)
class Row:
    """A run, as the CSV has it.

    Attributes:
        done: environment steps that it took.
        certified_since: of the first evaluation after which no later one fails; "" if the last one fails.
        regret: of its last policy.
        cause: why it is not certified, by `diagnose`, where that was asked.
        curve: "step:regret" where the exact regret or the certificate changed, "*" where certified.
    """

    page: str
    library: str
    algorithm: str
    world: str
    seed: str
    digest: str
    versions: str
    done: int
    every: int
    seconds: float
    certified_since: str
    regret: float
    cause: str
    curve: str

    @property
    def key(self) -> tuple[str, ...]:
        return tuple(getattr(self, name) for name in _KEY)

    @property
    def steps_to_certified(self) -> float:
        return float(self.certified_since or math.inf)

    def regrets(self) -> np.ndarray:
        """The regret at every N steps and at the end, certified ones as 0."""
        points = [point.split(":") for point in self.curve.split()]
        steps = [int(step) for step, _ in points]
        values = np.array([0.0 if text.endswith("*") else float(text) for _, text in points])
        return values[np.searchsorted(steps, grid(self.done, self.every), side="right") - 1]


_KEY = ("page", "library", "algorithm", "world", "seed", "digest", "versions")


def grid(done: int, every: int) -> np.ndarray:
    """The steps at which a policy is read."""
    return np.unique([*range(0, done, every), done])


def read(path: Path) -> list[Row]:
    """All rows of a file, or none where there is no file."""
    if not path.exists():
        return []
    kinds: dict[str, Any] = {"done": int, "every": int, "seconds": float, "regret": float}
    with path.open(encoding="utf-8", newline="") as file:
        try:
            return [
                Row(**{name: kinds.get(name, str)(value) for name, value in row.items()})
                for row in csv.DictReader(file)
            ]
        except (TypeError, ValueError):
            raise InputError(f"{path}: has other columns or a line that is cut off; delete that line") from None


def append(path: Path, row: Row) -> None:
    """Add a row in one write, so that a kill leaves whole lines."""
    path.parent.mkdir(parents=True, exist_ok=True)
    is_new = not path.exists()
    with path.open("a", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        if is_new:
            writer.writerow([field.name for field in fields(Row)])
        writer.writerow(asdict(row).values())


def work(job: Job, **more: Any) -> Iterator[dict[str, Any]]:
    """The lines that a worker writes for a job."""
    told = {**job.content, "seed": job.seed, "world": job.world.tables, **more}
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONWARNINGS": "ignore"}
    if job.content["library"] == "engine":
        environment["PYTHONPATH"] = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    with tempfile.TemporaryFile("w+", encoding="utf-8") as errors:
        process = subprocess.Popen(
            [str(python_of(job.library)), str(_WORKER)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors, text=True, env=environment,
        )  # fmt: skip
        try:
            assert process.stdin
            assert process.stdout
            process.stdin.write(json.dumps(told) + "\n")
            process.stdin.close()
            yield from map(json.loads, process.stdout)
            if process.wait():
                errors.seek(0)
                last = (errors.read().strip() or "it said nothing").splitlines()[-1]
                where = f"{job.library} {job.algorithm} {job.world.name}, seed {job.seed}"
                raise InputError(f"{where}: {last}")
        finally:
            process.kill()
            process.wait()


def scored(world: World, actions: list[int], known: dict[bytes, Score]) -> Score:
    """The exact score of the actions that a library takes in all states."""
    table = np.array(actions)
    if table.tobytes() not in known:
        known[table.tobytes()] = world.evaluator.score(one_hot_policy(table, world.mdp.num_actions))
    return known[table.tobytes()]


def run(job: Job) -> Row:
    """Train a job, and make a row of it."""
    points, known, told = [], {}, {"cause": ""}
    for line in work(job):
        told |= line
        if "actions" in line:
            score = scored(job.world, line["actions"], known)
            points.append((line["step"], score.regret, score.certified))
        elif "regret" in line:
            points.append((line["step"], line["regret"], line["certified"]))
    since, curve, before = "", [], None
    for step, regret, certified in points:
        since = (since or str(step)) if certified else ""
        text = f"{regret:.9g}{'*' if certified else ''}"
        if text != before:
            curve.append(f"{step}:{text}")
        before = text
    regret = 0.0 if points[-1][2] else float(f"{points[-1][1]:.9g}")
    rest = (points[-1][0], job.content["every"], round(told["seconds"], 1), since, regret, told["cause"])
    return Row(*job.key, *rest, " ".join(curve))


def missing(jobs: Iterable[Job], path: Path) -> list[Job]:
    """The jobs of which there is no row."""
    there = {row.key for row in read(path)}
    return [job for job in jobs if job.key not in there]


def estimate(jobs: list[Job], path: Path, processes: int) -> str:
    """How long the jobs take, by the rows that are there."""
    seconds = defaultdict(list)
    for row in read(path):
        seconds[row.page, row.library, row.algorithm].append(row.seconds)
    kinds = [(job.page, job.library, job.algorithm) for job in jobs]
    unknown = sorted({" ".join(kind[1:]) for kind in kinds if kind not in seconds})
    total = sum(statistics.median(seconds[kind]) + 5 for kind in kinds if kind in seconds)  # 5 s to start
    known = sum(kind in seconds for kind in kinds)
    text = f"{len(jobs)} rows to run; {known} of them take about {total / processes / 3600:.1f} hours"
    return text + (f"; no time is known of: {', '.join(unknown)}" if unknown else "")


def run_all(jobs: list[Job], path: Path, processes: int) -> list[str]:
    """Run what is missing, so many at once; returns what failed."""
    for library in {job.library for job in jobs}:
        python_of(library)
    failed = []
    with ThreadPoolExecutor(processes) as pool:
        futures = [pool.submit(run, job) for job in jobs]
        try:
            for count, future in enumerate(as_completed(futures), 1):
                try:
                    row = future.result()
                except InputError as error:
                    failed.append(str(error))
                    continue
                append(path, row)
                end = f"certified since {row.certified_since}" if row.certified_since else "not certified"
                name = f"{row.library} {row.algorithm} {row.world} {row.seed}"
                print(f"{count}/{len(jobs)} {name}: {end}, {row.seconds} s", flush=True)
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
    return failed


def install(library: str) -> None:
    """Make a library's virtual environment of its pins, and fetch its source if it has one.

    The environment variable ATLAS_SOURCE names another copy of that repository, a folder or an address.
    """
    from plan import ROOM

    pins, source = LIBRARIES[library].pins, LIBRARIES[library].source
    if not pins:
        raise InputError(f"install {library}: is part of this environment")
    folder = ROOM / library
    subprocess.run([sys.executable, "-m", "venv", folder], check=True)
    subprocess.run([folder / "bin" / "python", "-m", "pip", "install", "-q", *pins], check=True)
    if source is not None:
        address, commit = os.environ.get("ATLAS_SOURCE", source[0]), source[1]
        if not (folder / "source").exists():
            subprocess.run(["git", "clone", "-q", "-n", address, folder / "source"], check=True)
        subprocess.run(["git", "-C", folder / "source", "checkout", "-q", commit], check=True)
