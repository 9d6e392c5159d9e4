"""The winner beside the configuration that the search began from, on seeds that no trial has seen.

The best of many trials on a few seeds owes something to luck. These runs are ordinary ones, with a folder
each; what is there already is kept.
"""

from __future__ import annotations

import dataclasses
import json
import math
import shutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gridworld.config import TrainConfig
from gridworld.mdp import FloatArray
from gridworld.report import statistics
from gridworld.report.table import number, steps_up_to
from gridworld.run import SUMMARY
from gridworld.sweep.job import JobError, run_in_sweep
from gridworld.tune.worker import become_worker, is_stopped

CONFIRM = "confirm"  # the runs' folder, in the study's


@dataclass(frozen=True)
class Job:
    """A run."""

    folder: Path
    config: TrainConfig


@dataclass(frozen=True)
class Sample:
    """What the runs of one configuration came to."""

    certified: statistics.Share
    steps: FloatArray  # (seeds,), environment steps until the certificate that held; infinite without one
    total: int

    def text(self) -> str:
        """In a few words."""
        told = f"certified on {self.certified.count} of {self.certified.total} "
        told += f"[{100 * self.certified.low:.0f} %, {100 * self.certified.high:.0f} %]"
        median = statistics.interval(statistics.median, [self.steps], 0)
        form = steps_up_to(self.total)
        bounds = f"[{form(median.low)}, {form(median.high)}]"
        return f"{told}, half of the seeds by step {form(median.point)} {bounds}"


def jobs(folder: Path, name: str, config: TrainConfig, seeds: Sequence[int]) -> list[Job]:
    """A run on each seed."""
    runs = folder / CONFIRM
    return [Job(runs / f"{name},seed={seed}", dataclasses.replace(config, seed=seed)) for seed in seeds]


def prepare(folder: Path, runs: Sequence[Job]) -> None:
    """Make room: the runs of an earlier winner go."""
    (folder / CONFIRM).mkdir(exist_ok=True)
    names = {job.folder.name for job in runs}
    for path in (folder / CONFIRM).glob("*,seed=*"):
        if path.name not in names:
            shutil.rmtree(path, ignore_errors=True)


def work(task: Sequence[Job], worker: int, parent: int) -> None:
    """Run what nobody has run yet. Ends with the parent, however that ends."""
    become_worker(parent)
    for job in task:
        if is_stopped():
            break
        job.folder.mkdir(parents=True, exist_ok=True)
        try:
            run_in_sweep(job.config, job.folder, [], stop_at_failure=False)
        except JobError as error:
            print(f"{job.folder}: {error}", file=sys.stderr, flush=True)
    sys.exit(0)


def sample(runs: Sequence[Job]) -> Sample:
    """A run that failed was not certified."""
    steps = np.array([_steps(job.folder) for job in runs])
    certified = int(np.isfinite(steps).sum())
    return Sample(statistics.share(certified, len(steps)), steps, runs[0].config.total_timesteps)


def compare(winner: Sample, began_from: Sample, name: str) -> dict[str, Any]:
    """The verdict: by the probability that a run of the winner is certified sooner, ties counting half."""
    better = statistics.improvement([(-winner.steps, -began_from.steps)], 0)
    if better.low > 0.5:
        verdict = "beats"
    elif better.high < 0.5:
        verdict = "does worse than"
    else:
        verdict = "cannot be told apart from"
    sentence = (
        f"On {len(winner.steps)} held-out seeds {name} {verdict} the settings that the search began from: "
        f"{winner.text()}, against {began_from.text()}; a run of it is certified sooner with probability "
        f"{number(better.point)} [{number(better.low)}, {number(better.high)}]."
    )
    return {
        "verdict": verdict,
        "sentence": sentence,
        "probability_sooner": dataclasses.asdict(better),
        "winner": _plain(winner),
        "began_from": _plain(began_from),
    }


def _plain(of: Sample) -> dict[str, Any]:
    return {
        "certified": dataclasses.asdict(of.certified),
        "steps": [int(step) if math.isfinite(step) else None for step in of.steps],
    }


def _steps(folder: Path) -> float:
    try:
        summary = json.loads((folder / SUMMARY).read_text("utf-8"))
    except (OSError, ValueError):
        return math.inf
    since = summary.get("certified_since_step")
    return math.inf if since is None else float(since)
