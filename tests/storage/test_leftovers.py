"""What killed processes had half written is removed, and nothing else."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from gridworld.base.atomic_write import tidy

_WRITES = """
import os, sys
from pathlib import Path
from gridworld.base.atomic_write import replacing, replacing_folder
end, name = sys.argv[1:]
with (replacing if "." in name else replacing_folder)(Path(name)) as part:
    (part if "." in name else part / "events").write_text("half")
    print("half", flush=True)
    if end == "waits":
        sys.stdin.read()
    if end == "dies":
        os.kill(os.getpid(), 9)
"""


def writer(folder: Path, end: str, name: str) -> subprocess.Popen[str]:
    """A process that is in the middle of a write, or has been killed there."""
    words = [sys.executable, "-c", _WRITES, end, name]
    process = subprocess.Popen(words, cwd=folder, stdin=-1, stdout=-1, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "half\n"
    if end != "waits":
        process.communicate(timeout=180)
        assert process.returncode == (-signal.SIGKILL if end == "dies" else 0)
    return process


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("name", ["film.apng", "answers"])
def test_what_killed_writers_left_is_removed_and_nothing_else(name: str, tmp_path: Path) -> None:
    killed = [writer(tmp_path, "dies", name).pid for _ in range(2)]
    (tmp_path / ".film.9.part.txt").touch()  # none of ours
    living = writer(tmp_path, "waits", name)
    at_work = f".{name}.{living.pid}.part"
    assert living.pid not in killed
    assert len(names(tmp_path)) == 4 if "." in name else 2  # a new folder has removed what it found
    tidy(tmp_path)
    assert names(tmp_path) == sorted([".film.9.part.txt", at_work])
    living.communicate("")
    assert living.returncode == 0
    assert names(tmp_path) == sorted([".film.9.part.txt", name])
