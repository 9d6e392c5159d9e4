"""Without what only Unix has, the package is imported and trains, or says in one sentence why not.

A process without it stands for Windows: `fcntl`, signals, flags and folders' descriptors are taken away as
Python starts. That is not Windows, only as near as it can be tried here.
"""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.support import SHORT

_WITHOUT_UNIX = """
import os, shutil, signal, subprocess, sys, tempfile  # which ask once what there is
import fcntl
FOR_MSVCRT = fcntl
sys.modules["fcntl"] = None
for name in ("O_NOFOLLOW", "O_NONBLOCK", "O_CLOEXEC", "O_DIRECTORY", "sched_getaffinity"):
    delattr(os, name)
for name in ("SIGALRM", "SIGUSR1", "SIGUSR2", "setitimer", "pthread_sigmask"):
    delattr(signal, name)
os.supports_dir_fd = os.supports_fd = set()
"""
_MSVCRT = """
import types
def locking(file, mode, count):
    assert (mode, count) == (2, 1)
    try:
        FOR_MSVCRT.flock(file, FOR_MSVCRT.LOCK_EX | FOR_MSVCRT.LOCK_NB)
    except BlockingIOError as error:
        raise PermissionError(*error.args) from None
sys.modules["msvcrt"] = types.ModuleType("msvcrt")
sys.modules["msvcrt"].LK_NBLCK, sys.modules["msvcrt"].locking = 2, locking
"""
_RUN_ALL = """
import json, runpy, sys
for words in json.loads(sys.argv.pop()):
    sys.argv[1:] = words
    try:
        runpy.run_module("gridworld", run_name="__main__")
    except SystemExit as end:
        assert end.code in (None, 0), (words, end.code)
"""
_IMPORT_ALL = """
import importlib, pkgutil, gridworld
for module in pkgutil.walk_packages(gridworld.__path__, "gridworld."):
    if not module.name.endswith((".on_ray", "__main__")):
        importlib.import_module(module.name)
"""


def python(
    folder: Path, *words: str, hide: str = _WITHOUT_UNIX + _MSVCRT
) -> subprocess.CompletedProcess[str]:
    """Python in `folder`, in a process that `hide` has been run in first."""
    (folder / "hidden").mkdir(exist_ok=True)
    (folder / "hidden" / "sitecustomize.py").write_text(hide)
    path = os.pathsep.join([str(folder / "hidden"), os.environ.get("PYTHONPATH", "")])
    return subprocess.run(
        [sys.executable, *words],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        timeout=120,
    )


def gridworld(folder: Path, *lines: list[str]) -> str:
    """What commands print that end well, one after the other in one process."""
    done = python(folder, "-c", _RUN_ALL, json.dumps(lines))
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_every_module_is_imported(tmp_path: Path) -> None:
    done = python(tmp_path, "-c", _IMPORT_ALL, hide=_WITHOUT_UNIX)
    assert done.returncode == 0, done.stderr


def test_without_locks_training_is_refused(tmp_path: Path) -> None:
    done = python(
        tmp_path, "-m", "gridworld", "train", *SHORT["q_learning"], "hydra.run.dir=run", hide=_WITHOUT_UNIX
    )
    assert done.returncode == 2
    assert done.stderr == (
        "error: linux: Python can lock no files here (it has neither fcntl nor msvcrt), which a run's folder "
        "needs; train on Linux, macOS or Windows\n"
    )


@pytest.mark.parametrize("agent", ["dqn", "q_learning"])
def test_with_the_locks_of_windows_a_run_trains_and_is_resumed(agent: str, tmp_path: Path) -> None:
    lines = [
        ["train", *SHORT[agent], "hydra.run.dir=run"],
        ["train", "resume=run", "total_timesteps=3000"],
    ]
    if agent == "q_learning":  # nothing of an agent is left to be told apart
        lines.append(["evaluate", "run", "--episodes", "10"])
    told = gridworld(tmp_path, *lines)
    first, longer = re.findall(rf"^{agent} on classic, seed 0: ([\d,]+) steps", told, re.MULTILINE)
    assert int(longer.replace(",", "")) > int(first.replace(",", ""))
    assert ("policy of run" in told) == (agent == "q_learning")


def test_with_the_locks_of_windows_a_sweep_runs(tmp_path: Path) -> None:
    words = [*SHORT["q_learning"], "seed=0,1", "hydra.sweep.dir=sweep"]
    told = gridworld(tmp_path, ["train", "-m", *words], ["jobs", "sweep"])
    assert told.endswith("2 jobs: 2 done\n")
