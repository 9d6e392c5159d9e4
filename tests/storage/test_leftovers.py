"""The next process that writes to a folder removes what killed ones had half written, and nothing else."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.support import script

_WRITES = """
import os, sys
from pathlib import Path
from gridworld.storage.atomic_write import replacing, replacing_folder
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
        process.communicate(timeout=60)
        assert process.returncode == (-signal.SIGKILL if end == "dies" else 0)
    return process


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("name", ["film.apng", "answers"])
def test_the_next_writer_removes_what_killed_ones_left(name: str, tmp_path: Path) -> None:
    killed = [writer(tmp_path, "dies", name).pid for _ in range(2)]
    (tmp_path / ".film.9.part.txt").touch()  # none of ours
    living = writer(tmp_path, "waits", name)
    at_work = f".{name}.{os.uname().nodename}.{living.pid}.part"
    assert names(tmp_path) == sorted([".film.9.part.txt", at_work])
    assert living.pid not in killed
    writer(tmp_path, "ends", "other.csv")
    assert at_work in names(tmp_path)
    living.communicate("")
    assert living.returncode == 0
    assert names(tmp_path) == sorted([".film.9.part.txt", name, "other.csv"])


def test_a_new_report_and_recording_leave_nothing_half_written(tmp_path: Path) -> None:
    words = ("agent=sarsa", "total_timesteps=500", "env=river_swim", "hydra.run.dir=it")
    assert script("train.py", *words, cwd=tmp_path).returncode == 0
    folder = tmp_path / "it" / "recording"
    folder.mkdir()
    writer(tmp_path / "it", "dies", "report")
    writer(folder, "dies", "frames")
    writer(folder, "dies", "episode.gif")
    for command in (("report.py", "it"), ("record.py", "it", "--format", "png")):
        assert script(*command, cwd=tmp_path).returncode == 0
    assert not list((tmp_path / "it").rglob("*.part"))
    assert os.listdir(folder) == ["frames"]
