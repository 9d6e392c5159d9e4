"""What happens to the output changes nothing that a command does: no reader, terminal, UTF-8 or room.

But where there was no room for what it prints, it fails at its end.
"""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.support import ROOT, SHORT, script, train_in

from gridworld.base import console
from gridworld.base.safe_read import sealed

NO_UTF8 = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
ASCII = {"LC_ALL": "C", "PYTHONIOENCODING": "ascii"}
FULL = (
    "error: standard output: cannot be written (No space left on device), "
    "so the output is incomplete; write it to a disk with free space\n"
)


def shell(line: str, cwd: Path, **environment: str) -> subprocess.CompletedProcess[bytes]:
    """`SCRIPT` in the line stands for python and a script's folder."""
    line = line.replace("SCRIPT ", f"{sys.executable} {ROOT}/scripts/")
    environment = {**os.environ, **environment}
    return subprocess.run(["bash", "-c", line], cwd=cwd, env=environment, capture_output=True, timeout=120)


TRAIN = " ".join(["SCRIPT train.py", *SHORT["q_learning"], "hydra.run.dir=run"])


@pytest.mark.parametrize(
    ("line", "code"),
    [
        pytest.param(f"set -o pipefail; {TRAIN} 2>&1 | true", 0, marks=pytest.mark.slow),
        (f"{TRAIN} >/dev/full 2>&1", 2),
        pytest.param(f"setsid {TRAIN} >&- 2>&- <&-", 0, marks=pytest.mark.slow),
    ],
    ids=["no reader", "no room", "no terminal and all closed"],
)
def test_a_run_ends_well_whoever_reads_its_output(line: str, code: int, tmp_path: Path) -> None:
    done = shell(line, tmp_path)
    assert done.returncode == code, done.stderr
    assert b"Traceback" not in done.stderr
    assert json.loads((tmp_path / "run" / "manifest.json").read_text())["status"] == "finished"


@pytest.mark.parametrize("in_place", [True, False])
def test_progress(
    in_place: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(console, "_SECONDS_BETWEEN_LINES", 0)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: in_place)
    progress = console.Progress(2000, "dqn on\x1bmap")
    for step, note in ((0, "a long note"), (1000, "b"), (2000, "c")):
        progress.update(step, note)
    progress.close()
    shown = capsys.readouterr().err.removesuffix("\n")
    start, middle, end = shown.removeprefix("\r").split("\r" if in_place else "\n")
    assert start == r"dqn on\x1bmap: step 0 of 2,000 (0%), a long note"
    assert middle.rstrip() == r"dqn on\x1bmap: step 1,000 of 2,000 (50%), about 0 s left, b"
    assert end.rstrip() == r"dqn on\x1bmap: step 2,000 of 2,000 (100%), c"
    assert (len(end) == len(middle)) == in_place  # a line covers the one before
    console.Progress(10, "x", enabled=False).update(1, "y")
    assert capsys.readouterr().err == ""


def test_progress_on_a_narrow_terminal_keeps_the_time_left_and_the_regret(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "60")
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    progress = console.Progress(200_000, "expected_sarsa on frozen_lake_4x4")
    progress.update(1_000, "regret 0.542, goal 50%")
    assert capsys.readouterr().err == "\rstep 1,000 of 200,000 (0%), regret 0.542, goal 50%"
    progress.update(2_000, "regret 0.542, goal 50%, certified optimal")
    shown = re.sub(r"about \d+ s", "about N s", capsys.readouterr().err.rstrip())
    assert shown == "\rstep 2,000 of 200,000 (1%), about N s left, regret 0.542"


READ = """
import os, pty, sys
status = pty.spawn(sys.argv[1:])
sys.exit(os.waitstatus_to_exitcode(status))
"""


@pytest.mark.parametrize(
    ("variables", "is_coloured"), [({}, True), ({"NO_COLOR": "1"}, False), ({"TERM": "dumb"}, False)]
)
def test_a_verdict_is_coloured_on_a_terminal_alone(
    variables: dict[str, str], is_coloured: bool, tmp_path: Path
) -> None:
    train_in(tmp_path / "run", *SHORT["value_iteration"], "recording.learning=false")
    variables = {"TERM": "xterm", "NO_COLOR": "", **variables}
    (tmp_path / "read.py").write_text(READ)
    line = "SCRIPT evaluate.py run --episodes 10"
    shown = shell(f"{sys.executable} read.py {line} </dev/null", tmp_path, **variables).stdout.decode()
    assert ("  \x1b[32mcertified optimal: " in shown) == is_coloured
    assert ("\x1b" in shown) == is_coloured
    assert b"  certified optimal: " in shell(line, tmp_path, **variables).stdout


@pytest.mark.slow
def test_a_run_says_what_it_trains_before_torch_is_imported(tmp_path: Path) -> None:
    """Where torch cannot be imported, it is the line before the error; a refused setting has no such line."""
    (tmp_path / "torch.py").write_text("raise ImportError('slow')")
    begin, path = b"training dqn on classic, seed 3, for ", f"{tmp_path}:{ROOT}"
    for more, is_said in (("", True), ("logging.progress=false", False), ("agent.tau=-1", False)):
        line = f"SCRIPT train.py agent=dqn seed=3 hydra.run.dir=run {more}"
        said = shell(line, tmp_path, PYTHONPATH=path).stderr
        assert said.startswith(begin) == is_said
        assert (b"slow" in said) == ("tau" not in more)


@pytest.mark.slow
def test_names_in_a_locale_without_utf8(tmp_path: Path) -> None:
    (tmp_path / "mäp.txt").write_text("S..\n..G\n")
    words = [*SHORT["q_learning"], "env.layout='mäp.txt'", "hydra.run.dir=run"]
    done = script("train.py", *words, cwd=tmp_path, **NO_UTF8)
    assert done.returncode == 0, done.stderr
    assert "q_learning on m\\" in done.stdout  # with the sign as a number
    assert done.stdout.isascii()
    for environment in (NO_UTF8, ASCII):
        refused = script("train.py", "env.layout='nö.txt'", cwd=tmp_path, **environment)
        assert refused.returncode == 2
        assert refused.stderr.startswith("error: layout 'n")


def test_what_there_was_no_room_for_is_an_error(tmp_path: Path) -> None:
    done = shell("SCRIPT train.py --help >/dev/full", tmp_path)  # in a process of its own
    assert (done.returncode, done.stderr.decode()) == (2, FULL)
    done = shell("ulimit -f 1; trap '' XFSZ; SCRIPT train.py --help >out", tmp_path)  # the first half fits
    assert done.returncode == 2
    assert b"error: standard output: cannot be written (File too large)" in done.stderr
    assert (tmp_path / "out").stat().st_size == 1024
    (tmp_path / "out").unlink()
    folder = tmp_path / "sweep" / "seed=0"
    train_in(folder, *SHORT["q_learning"], "recording.learning=false")
    entry = {"job": "seed=0", "hash": "x", "overrides": ["seed=0"]}
    content = {"asked": [{"overrides": ["seed=0"]}], "jobs": [entry]}
    (tmp_path / "sweep" / "sweep.json").write_text(json.dumps(sealed(content)))
    for line in (
        *("train.py --help", "report.py --help", "train.py --cfg job", "train.py --version", "jobs.py sweep"),
        *("tune.py agent=ppo --cfg", "evaluate.py sweep/seed=0", "record.py sweep/seed=0 --format policy"),
    ):
        ended = script(*line.split(), cwd=tmp_path, stdout=Path("/dev/full"))
        assert (ended.returncode, ended.stderr) == (2, FULL), line
    assert (folder / "recording" / "policy.png").exists()
    assert [path.name for path in tmp_path.iterdir()] == ["sweep"]


def test_a_reader_may_leave(tmp_path: Path) -> None:
    done = shell("set -o pipefail; SCRIPT tune.py agent=ppo --cfg | head -c 1", tmp_path)
    assert (done.returncode, done.stderr, len(done.stdout)) == (0, b"", 1)


def test_a_mistake_has_its_exit_code_whoever_reads_it(tmp_path: Path) -> None:
    assert shell("SCRIPT evaluate.py nowhere 2>&-", tmp_path).returncode == 2
    assert shell("SCRIPT train.py seed=x 2>/dev/full", tmp_path).returncode == 2
