"""Which run it is, and where its numbers come from.

The identity of a run follows from its settings: two runs of one identity do the same as far as their settings
decide it. To the last bit they do so only in the same environment: other versions or another processor round
differently. Versions, source tree, processor and environment variables are determined once per process. Where
the numbers of two runs differ, look here first.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import os
import platform
import signal
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gridworld.base.errors import DISTRIBUTION
from gridworld.base.safe_read import sha256
from gridworld.base.signals import deferring
from gridworld.config.fields import Effect
from gridworld.config.settings import ON_RESULT, with_effects
from gridworld.config.train import AgentConfig, TrainConfig
from gridworld.run.folder import SOURCE_DIFF

LARGEST_DIFF = 2**20  # bytes; of a larger one only the checksum is kept

PACKAGES = (
    *("gridworld", "gymnasium", "hydra-core", "numpy", "omegaconf", "pillow", "pygame", "pygame-ce"),
    *("sb3-contrib", "scipy", "stable-baselines3", "tensorboard", "torch"),
)
# Read by Python, torch and the numerical libraries.
_VARIABLES = (
    *("PYTHONHASHSEED", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"),
    *("OPENBLAS_CORETYPE", "MKL_CBWR", "ATEN_CPU_CAPABILITY", "NPY_DISABLE_CPU_FEATURES"),
    *("CUDA_VISIBLE_DEVICES", "CUBLAS_WORKSPACE_CONFIG"),
)
_GIT_SECONDS = 10
_PACKAGE = Path(__file__).parents[1]
_PARTS = ("gridworld", "conf", "scripts", "pyproject.toml")  # of the source tree: what the numbers depend on
# Files of the package that are elsewhere in a wheel; no number depends on them.
_PLUGINS = ("checking/pytest_plugin.py", "sweeps/hydra_plugin.py")
_FIXED = frozenset(Effect) - {Effect.LENGTH, Effect.NOTHING}
_FOR_ALL_AGENTS = ("python", "gridworld", "gymnasium", "numpy", "scipy")


def settings(config: TrainConfig) -> dict[str, Any]:
    """The settings that are fixed for a run: all but its length and those without an effect on its files."""
    return with_effects(_FIXED, dataclasses.asdict(config))


def identity(config: TrainConfig, layout: str) -> str:
    """SHA-256 of a run's fixed settings and of its map's text."""
    return _hash(settings(config), layout)


def settings_hash(settings: dict[str, Any], layout: str) -> str:
    """A hash of a run's settings and its map's text; the same for settings read from a manifest."""
    return _hash(with_effects(ON_RESULT, settings), layout)[:32]


def _hash(settings: dict[str, Any], layout: str) -> str:
    return sha256(json.dumps([settings, layout], sort_keys=True, default=str).encode())


def environment(agent: AgentConfig) -> dict[str, str]:
    """What the last bits of an agent's numbers depend on beside its settings; imports torch if it is used."""
    found = {name: str(versions().get(name)) for name in _FOR_ALL_AGENTS}
    found["source code"] = code()[:12]
    found |= {name: str(versions().get(name)) for name in agent.libraries}
    if "torch" in agent.libraries:
        import torch  # noqa: F401  # `processor` asks it once it is imported

        found["processor for torch"] = str(processor()["torch"])
    found["machine"] = processor()["machine"]
    found["processor for numpy"] = " ".join(processor()["numpy"])
    return found


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
def code() -> str:
    """A hash of the package's source files, SHA-256 as hexadecimal digits."""
    found = hashlib.sha256()
    for path in sorted({*_PACKAGE.rglob("*.py")} - {_PACKAGE / plugin for plugin in _PLUGINS}):
        found.update(f"{path.relative_to(_PACKAGE).as_posix()} {sha256(path.read_bytes())}\n".encode())
    return found.hexdigest()


@dataclass(frozen=True)
class Source:
    """The state of a source tree: its commit, and what was changed since."""

    commit: str
    diff: bytes  # as git writes it, empty for a clean tree; files that git does not know are in it

    def manifest_entry(self, file: str = SOURCE_DIFF) -> dict[str, Any]:
        """Its commit, and of the changes their size and checksum, and the name of the file that has them."""
        about: dict[str, Any] = {"commit": self.commit, "dirty": bool(self.diff)}
        if self.diff:
            kept = file if len(self.diff) <= LARGEST_DIFF else None
            about["diff"] = {"file": kept, "bytes": len(self.diff), "sha256": sha256(self.diff)}
        return about


@functools.cache
def source() -> Source | None:
    """The source tree of this package; None outside a git checkout, or where git fails."""
    return source_of(_PACKAGE.parent)


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
        # A handler that raised within `run` could leave a lock taken for which `run` waits then.
        with deferring(signal.SIGINT, signal.SIGTERM):
            done = subprocess.run(
                command,
                capture_output=True,
                check=True,
                timeout=_GIT_SECONDS,
                env=environment,
                process_group=0,  # a terminal's Ctrl-C is not for git
            )
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
            return Source(commit, ask(*words, GIT_INDEX_FILE=str(index)))
    except (OSError, ValueError, subprocess.SubprocessError):
        return None


def git(file: str = SOURCE_DIFF) -> dict[str, Any] | None:
    """The manifest's entry for this package's source tree, whose changes go to `file`; None: not known."""
    tree = source()
    return None if tree is None else tree.manifest_entry(file)


def processor() -> dict[str, Any]:
    """The processor, and which of its instructions NumPy uses, and torch, if it is imported."""
    torch = sys.modules.get("torch")  # importing it takes seconds
    capability = None if torch is None else torch.backends.cpu.get_cpu_capability()
    return {**_hardware(), "torch": capability}


@functools.cache
def _hardware() -> dict[str, Any]:
    import numpy as np

    info = Path("/proc/cpuinfo")
    lines = info.read_text("utf-8", "replace").splitlines() if info.exists() else []
    models = (line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    extensions = np.show_config(mode="dicts").get("SIMD Extensions", {})
    return {
        "machine": platform.machine(),
        "model": next(models, platform.processor() or None),
        "cores": os.cpu_count(),
        "numpy": [*extensions.get("baseline", []), *extensions.get("found", [])],
    }


def describe() -> dict[str, Any]:
    """All of it, as entries of a manifest."""
    return {
        "versions": versions(),
        "git": git(),
        "platform": platform.platform(),
        "processor": processor(),
        "environment": {name: os.environ[name] for name in _VARIABLES if name in os.environ},
    }


def differences(then: Mapping[str, Any], now: Mapping[str, Any]) -> Iterator[str]:
    """A line for each difference between a manifest, which need not be valid, and what `describe` returns."""
    yield from source_differences(then.get("git"), now.get("git"))
    for section, name in (("versions", ""), ("processor", "processor "), ("environment", "")):
        before, after = _mapping(then.get(section)), now[section]
        for key in sorted(before.keys() | after.keys(), key=str):
            if before.get(key) != after.get(key):
                yield f"{name}{key}: {_shown(before.get(key))} then, {_shown(after.get(key))} now"
    if then.get("platform") != now["platform"]:
        yield f"platform: {_shown(then.get('platform'))} then, {_shown(now['platform'])} now"


def source_differences(then: Any, now: Any) -> Iterator[str]:
    """A line for each difference between two results of `git`, of which `then` need not be valid."""
    before, after = _mapping(then), _mapping(now)
    if before.get("commit") != after.get("commit"):
        yield f"commit: {_shown(before.get('commit'))} then, {_shown(after.get('commit'))} now"
    changes = [_mapping(about.get("diff")) for about in (before, after)]
    sums = [change.get("sha256") for change in changes]
    if sums[0] != sums[1]:
        kept = f" ({SOURCE_DIFF} has them)" if sums[0] and changes[0].get("file") == SOURCE_DIFF else ""
        shown = [f"changes {_shown(digest)[:12]}" if digest else "no changes" for digest in sums]
        yield f"uncommitted source: {shown[0]}{kept} then, {shown[1]} now"


def _mapping(value: Any) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def _shown(value: Any) -> str:
    return "none" if value is None else str(value)[:200]
