"""Files and system calls of a run, by which a study on a cluster can be planned.

Calls are counted by strace, where it is installed: all that name something in the sweep's folder.
"""

from __future__ import annotations

import functools
import re
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from benchmarks.measure import Comparison, Workload

from gridworld.config.train import PICTURES

_RUN = ("agent=dqn", "total_timesteps=2000", "evaluation.every=500", "logging.progress=false")
_NO_PICTURES = tuple(f"recording.{name}=false" for name in PICTURES)
_SETTINGS = {
    "all that a run writes": (),
    "without recording.frames": ("recording.frames=false",),
    "without recording.*": _NO_PICTURES,
    "nor logging.tensorboard": (*_NO_PICTURES, "logging.tensorboard=false"),
}
_CALLS = {  # by what they cost where the file system is a network away
    "opened, made, renamed": r"open\w*|creat|rename\w*|unlink\w*|mkdir\w*|rmdir",
    "looked at": r"\w*stat\w*|access\w*|readlink\w*|getdents\w*",
    "locked": r"flock",
    "forced to disk": r"fsync|fdatasync",
}
Measured = dict[str, float]  # per run


def comparisons(workload: Workload) -> Iterator[Comparison]:
    """The measurements."""
    runs = 2 * workload.sweep_seeds
    calls = _CALLS if shutil.which("strace") else ()
    for what in ("files", "kB", *calls):
        for name, words in _SETTINGS.items():
            yield Comparison(f"on disk, per run: {what}", name, partial(_per_run, words, runs, what))


def _per_run(words: tuple[str, ...], runs: int, what: str) -> float:
    return _measure(words, runs)[what]


@functools.cache
def _measure(words: tuple[str, ...], runs: int) -> Measured:
    traced = shutil.which("strace") is not None
    with tempfile.TemporaryDirectory() as folder:
        log, sweep = Path(folder) / "calls", Path(folder) / "the-sweep"
        command = [sys.executable, "-m", "gridworld", "train", "-m", *_RUN, *words, f"seed=range({runs})"]
        command.append(f"hydra.sweep.dir={sweep}")
        if traced:
            names = "%file,flock,fsync,fdatasync,getdents64"
            command = ["strace", "-f", "-y", "-qq", "-e", f"trace={names}", "-o", str(log), *command]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        files = [path for path in sweep.rglob("*") if path.is_file()]
        blocks = sum(path.stat().st_blocks for path in sweep.rglob("*"))
        measured = {"files": len(files) / runs, "kB": blocks * 512 / 1000 / runs}
        if traced:
            calls = Counter(
                found.group(1)
                for line in log.read_text(errors="replace").splitlines()
                if sweep.name in line and (found := re.match(r"\d+\s+(\w+)\(", line))
            )
            for kind, pattern in _CALLS.items():
                count = sum(n for call, n in calls.items() if re.fullmatch(pattern, call))
                measured[kind] = count / runs
        return measured
