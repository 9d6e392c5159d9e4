"""Where a run's numbers come from: versions, source tree, processor and environment variables.

Each is determined once per process. Where the numbers of two runs differ, look here first.
"""

from __future__ import annotations

import functools
import hashlib
import os
import platform
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gridworld.errors import DISTRIBUTION
from gridworld.run.folder import SOURCE_DIFF
from gridworld.storage.safe_read import sha256

LARGEST_DIFF = 2**20  # bytes; of a larger one only the checksum is kept

PACKAGES = (
    "gridworld",
    "gymnasium",
    "hydra-core",
    "numpy",
    "omegaconf",
    "pillow",
    "pygame",
    "sb3-contrib",
    "scipy",
    "stable-baselines3",
    "tensorboard",
    "torch",
)
# Read by Python, torch and the numerical libraries.
_VARIABLES = (
    *("PYTHONHASHSEED", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"),
    *("OPENBLAS_CORETYPE", "MKL_CBWR", "ATEN_CPU_CAPABILITY", "NPY_DISABLE_CPU_FEATURES"),
    *("CUDA_VISIBLE_DEVICES", "CUBLAS_WORKSPACE_CONFIG"),
)
_GIT_SECONDS = 10
_PARTS = ("gridworld", "conf", "scripts", "pyproject.toml")  # of the source tree: what the numbers depend on


@dataclass(frozen=True)
class Source:
    """The state of a source tree: its commit, and what was changed since."""

    commit: str
    diff: bytes  # as git writes it, empty for a clean tree; files that git does not know are in it

    def told(self, file: str = SOURCE_DIFF) -> dict[str, Any]:
        """The manifest's entry; `file` is the name of the file for the changes."""
        about: dict[str, Any] = {"commit": self.commit, "dirty": bool(self.diff)}
        if self.diff:
            kept = file if len(self.diff) <= LARGEST_DIFF else None
            about["diff"] = {"file": kept, "bytes": len(self.diff), "sha256": sha256(self.diff)}
        return about


@functools.cache  # the code that runs is the code that was imported
def versions() -> dict[str, str | None]:
    """The versions of Python and of every package that the result depends on; None: not installed."""
    # Imported here, as subprocess below, to keep them out of the way of `train.py --help`.
    from importlib.metadata import PackageNotFoundError, version

    found: dict[str, str | None] = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = version(DISTRIBUTION if package == "gridworld" else package)
        except PackageNotFoundError:
            found[package] = None
    return found


@functools.cache
def source() -> Source | None:
    """The source tree of this package; None outside a git checkout, or where git fails."""
    return source_of(Path(__file__).parents[3])


def git(file: str = SOURCE_DIFF) -> dict[str, Any] | None:
    """The manifest's entry for this package's source tree; None where that is not known.

    Args:
        file: The name of the file for the uncommitted changes.
    """
    tree = source()
    return None if tree is None else tree.told(file)


def source_of(tree: Path) -> Source | None:
    """The source tree in a folder; None where it is no git checkout, or git fails."""
    import shutil
    import subprocess
    import tempfile

    if not (tree / ".git").exists():
        return None

    def ask(*words: str, **variables: str) -> bytes:
        environment = {**os.environ, **variables, "GIT_OPTIONAL_LOCKS": "0"}
        command = ["git", "-C", str(tree), *words]
        done = subprocess.run(command, capture_output=True, check=True, timeout=_GIT_SECONDS, env=environment)
        return done.stdout

    try:
        commit = ask("rev-parse", "HEAD").decode().strip()
        if not ask("status", "--porcelain", "--", *_PARTS):
            return Source(commit, b"")
        there = [part for part in _PARTS if (tree / part).exists()]  # `add` wants them all to be
        # Untracked files are added by name to a copy of the index: `diff` then has their content.
        with tempfile.TemporaryDirectory() as folder:
            index = Path(folder) / "index"
            # With its time, by which git knows which files to compare in full.
            shutil.copy2(tree / ask("rev-parse", "--git-path", "index").decode().strip(), index)
            ask("add", "--intent-to-add", "--all", "--", *there, GIT_INDEX_FILE=str(index))
            words = ("diff", "--no-ext-diff", "--no-color", "--binary", "HEAD", "--", *_PARTS)
            diff = ask(*words, GIT_INDEX_FILE=str(index))
    except (OSError, ValueError, subprocess.SubprocessError):
        return None
    return Source(commit, diff)


@functools.cache
def code() -> str:
    """A hash of the package's source files, SHA-256 as hexadecimal digits."""
    package, found = Path(__file__).parents[2], hashlib.sha256()
    elsewhere = package / "sweep" / "hydra_plugin.py"  # in a wheel; no number depends on it
    for path in sorted({*package.rglob("*.py")} - {elsewhere}):
        found.update(f"{path.relative_to(package).as_posix()} {sha256(path.read_bytes())}\n".encode())
    return found.hexdigest()


def processor() -> dict[str, Any]:
    """The processor, and which of its instructions NumPy uses, and torch, if it is imported."""
    torch = sys.modules.get("torch")  # importing it takes seconds
    capability = None if torch is None else torch.backends.cpu.get_cpu_capability()
    return {**_hardware(), "torch": capability}


@functools.cache
def _hardware() -> dict[str, Any]:
    import numpy as np

    extensions = np.show_config(mode="dicts").get("SIMD Extensions", {})
    return {
        "machine": platform.machine(),
        "model": _model(),
        "cores": os.cpu_count(),
        "numpy": [*extensions.get("baseline", []), *extensions.get("found", [])],
    }


def _model() -> str | None:
    try:
        with open("/proc/cpuinfo", encoding="utf-8", errors="replace") as lines:
            return next(
                (line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), None
            )
    except OSError:  # not Linux
        return platform.processor() or None


def variables() -> dict[str, str]:
    """The environment variables that are set and that the numbers depend on."""
    return {name: os.environ[name] for name in _VARIABLES if name in os.environ}


def describe() -> dict[str, Any]:
    """All of it, as entries of a manifest."""
    return {
        "versions": versions(),
        "git": git(),
        "platform": platform.platform(),
        "processor": processor(),
        "environment": variables(),
    }


def differences(then: Mapping[str, Any], now: Mapping[str, Any]) -> Iterator[str]:
    """Compare two descriptions.

    Args:
        then: A manifest, which need not be valid.
        now: What `describe` returns.

    Yields:
        A line for each difference.
    """
    yield from source_differences(then.get("git"), now.get("git"))
    for section, name in (("versions", ""), ("processor", "processor "), ("environment", "")):
        before, after = then.get(section), now[section]
        before = before if isinstance(before, dict) else {}
        for key in sorted(before.keys() | after.keys(), key=str):
            if before.get(key) != after.get(key):
                yield f"{name}{key}: {_told(before.get(key))} then, {_told(after.get(key))} now"
    if then.get("platform") != now["platform"]:
        yield f"platform: {_told(then.get('platform'))} then, {_told(now['platform'])} now"


def source_differences(then: Any, now: Any) -> Iterator[str]:
    """Compare two results of `git`, of which `then` need not be valid; yields a line for each difference."""
    before, after = (git if isinstance(git, dict) else {} for git in (then, now))
    if before.get("commit") != after.get("commit"):
        yield f"commit: {_told(before.get('commit'))} then, {_told(after.get('commit'))} now"
    changes = [about.get("diff") or {} for about in (before, after)]
    sums = [change.get("sha256") if isinstance(change, dict) else None for change in changes]
    if sums[0] != sums[1]:
        kept = f" ({SOURCE_DIFF} has them)" if sums[0] and changes[0].get("file") == SOURCE_DIFF else ""
        told = [f"changes {_told(digest)[:12]}" if digest else "no changes" for digest in sums]
        yield f"uncommitted source: {told[0]}{kept} then, {told[1]} now"


def _told(value: Any) -> str:
    return "none" if value is None else str(value)[:200]
