"""A run's folder: its files, its manifest, its status.

    manifest.json   what ran, with which versions and settings, from when to when, and how it ended
    curve.csv       the learning curve, a row per evaluation
    summary.json    the result
    model.zip       the trained model
    visits.npy      how often training took each action in each state, (S, A)
    policy.png, q_error.png, visits.png, learning.gif   what was learnt, how well, where, and how
    frames/, episode.gif, ...   the final policy's episode
    .hydra/         the configuration as Hydra composed it
    events.out...   TensorBoard's event file

The manifest alone is enough to build the world and the agent again: it holds the resolved settings and
the map's text.
"""

from __future__ import annotations

import functools
import json
import os
import platform
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from gridworld.errors import InputError
from gridworld.files import write_json

MANIFEST = "manifest.json"
CURVE = "curve.csv"
SWEEP_JSON = "sweep.json"  # a sweep's folder has this instead
SUMMARY = "summary.json"
PACKAGES = (
    "gridworld",
    "gymnasium",
    "hydra-core",
    "numpy",
    "omegaconf",
    "pillow",
    "pygame",
    "scipy",
    "stable-baselines3",
    "tensorboard",
    "torch",
)


class Run:
    """The folder of one run."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.manifest_file = folder / MANIFEST
        self.curve_file = folder / CURVE
        self.summary_file = folder / SUMMARY
        self.model_file = folder / "model.zip"
        self.visits_file = folder / "visits.npy"
        self.frames_folder = folder / "frames"
        self.manifest: dict[str, Any] = {}

    def start(self, config: dict[str, Any], layout_text: str, overrides: list[str]) -> None:
        """Write the manifest of a run that begins now. Raises `InputError` if the folder has one."""
        self.manifest = {
            "status": "running",
            "started": _now(),
            "ended": None,
            "command": [Path(sys.argv[0]).name, *sys.argv[1:]],
            "overrides": overrides,
            "seed": config["seed"],
            "threads": config["threads"],
            "versions": versions(),
            "git": _git(),
            "platform": platform.platform(),
            "processor": {"machine": platform.machine(), "cores": os.cpu_count()},
            "layout": layout_text.split("\n"),
            "config": config,
        }
        try:
            self.manifest_file.open("x").close()  # of two runs that start at once, one gets the folder
        except FileExistsError:
            raise InputError(
                f"{self.folder}: holds a run already; give every run a folder of its own"
            ) from None
        write_json(self.manifest_file, self.manifest)

    def end(self, status: str, error: str | None = None) -> None:
        """Record how it ended: finished, interrupted or failed."""
        self.manifest |= {"status": status, "ended": _now()}
        if error is not None:
            self.manifest["error"] = error
        write_json(self.manifest_file, self.manifest)


def open_run(folder: Path) -> Run:
    """A finished run, to look at. Raises `InputError` where there is none."""
    run = Run(folder)
    if not folder.exists():
        raise InputError(f"{folder}: no such folder; give the folder of a run, e.g. one in runs/")
    if not run.manifest_file.is_file():
        raise InputError(f"{folder}: not a run's folder, it has no {MANIFEST}")
    try:
        manifest = json.loads(run.manifest_file.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{run.manifest_file}: cannot be read ({error})") from None
    if not isinstance(manifest, dict) or not {"status", "config", "layout"} <= manifest.keys():
        raise InputError(f"{run.manifest_file}: not the manifest of a run; it lacks status, config or layout")
    if manifest["status"] != "finished":
        raise InputError(
            f"{folder}: this run is {manifest['status']!r}; only a finished one can be looked at"
        )
    run.manifest = manifest
    return run


def check_new(folder: Path) -> None:
    """Raise `InputError` unless a run can be written to `folder`: it can be made and holds no run yet."""
    if (folder / MANIFEST).exists():
        raise InputError(f"{folder}: holds a run already; choose another folder")
    if (folder / SWEEP_JSON).exists():
        raise InputError(f"{folder}: is the folder of a sweep; choose another hydra.run.dir")
    check_writable(folder, "hydra.run.dir")


def check_writable(folder: Path, key: str) -> None:
    """Raise `InputError` if the folder that `key` names can neither be made nor written to."""
    existing = folder
    while not existing.exists() and existing != existing.parent:
        existing = existing.parent
    if not existing.is_dir():
        raise InputError(f"{folder}: cannot be made, {existing} is a file; choose another {key}")
    if not os.access(existing, os.W_OK | os.X_OK):
        raise InputError(f"{folder}: cannot be written, {existing} is read-only; choose another {key}")


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="milliseconds")


@functools.cache  # the code that runs is the code that was imported
def versions() -> dict[str, str | None]:
    """Of Python and of every package that has a say in the result."""
    # Imported here, as subprocess below, to keep them out of the way of `train.py --help`.
    from importlib.metadata import PackageNotFoundError, version

    found: dict[str, str | None] = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = None
    return found


@functools.cache
def _git() -> dict[str, Any] | None:
    """Commit of the source tree and whether it has changes; None outside a git checkout."""
    import subprocess

    source = Path(__file__).parents[1]
    if not (source / ".git").exists():
        return None
    try:
        answers = [
            subprocess.run(
                ["git", "-C", str(source), *arguments], capture_output=True, text=True, check=True, timeout=10
            ).stdout.strip()
            for arguments in (["rev-parse", "HEAD"], ["status", "--porcelain"])
        ]
    except (OSError, subprocess.SubprocessError):
        return None
    return {"commit": answers[0], "dirty": bool(answers[1])}
