"""What several tests of sweeps need: all that must be the same of two sweeps' runs."""

import csv
import json
import re
from pathlib import Path
from typing import Any

from helpers.resuming import differences, left_behind

_OF_THE_CLOCK = {"started", "ended", "seal"}
_NOT_THE_SETTINGS = {"command", "overrides"}  # where the sweep's folder and its launcher are named
_OF_WORKERS = {"OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"}
_HASHED_WITH_TIMES = ("summary.json", "model.zip", "best_model.zip")


def rows(sweep: Path) -> dict[str, dict[str, str]]:
    """The rows of a sweep's table by job, without what the clock says."""
    with (sweep / "jobs.csv").open(newline="") as file:
        return {row["job"]: {k: v for k, v in row.items() if k != "seconds"} for row in csv.DictReader(file)}


def logged(run: Path) -> list[str]:
    """The lines of `train.log`, without times and commands."""
    lines = (run / "train.log").read_text().splitlines()
    return [re.sub(r"^\S+ |(?<=starts: ).*", "", line) for line in lines]


def everything(run: Path) -> dict[str, Any]:
    """What a run that was not interrupted leaves: its files' names and contents, its manifest and its log."""
    manifest = json.loads((run / "manifest.json").read_text())
    for key in _OF_THE_CLOCK | _NOT_THE_SETTINGS:
        del manifest[key]
    for name in _HASHED_WITH_TIMES:
        del manifest["sha256"][name]
    for name in _OF_WORKERS & manifest["environment"].keys():
        del manifest["environment"][name]
    names = [re.sub(r"tfevents.*", "tfevents", str(p.relative_to(run))) for p in run.rglob("*")]
    config = (run / ".hydra" / "config.yaml").read_text()
    return {
        **left_behind(run),
        "manifest": manifest,
        "log": logged(run),
        "names": sorted(names),
        "config": config,
    }


def differing(one: Path, other: Path) -> dict[str, list[str]]:
    """The runs of two sweeps in which something differs that should not."""
    runs = sorted(path.parent.name for path in one.glob("*/summary.json"))
    assert runs == sorted(path.parent.name for path in other.glob("*/summary.json"))
    found = {name: differences(everything(one / name), everything(other / name)) for name in runs}
    return {name: of_run for name, of_run in found.items() if of_run}
