"""What happens to the output changes nothing that a command does: no reader, terminal, UTF-8 or room.

But where what it prints is its result, it fails at its end if that could not be written.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.support import ROOT, SHORT, script, train_in

from gridworld.storage.safe_read import sealed

NO_UTF8 = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
ASCII = {"LC_ALL": "C", "PYTHONIOENCODING": "ascii"}
MAP = "mäp.txt"


def shell(line: str, cwd: Path, **environment: str) -> subprocess.CompletedProcess[bytes]:
    """`SCRIPT` in the line stands for python and a script's folder."""
    line = line.replace("SCRIPT ", f"{sys.executable} {ROOT}/scripts/")
    environment = {**os.environ, **environment}
    return subprocess.run(["bash", "-c", line], cwd=cwd, env=environment, capture_output=True, timeout=120)


TRAIN = " ".join(["SCRIPT train.py", *SHORT["q_learning"], "hydra.run.dir=run"])


@pytest.mark.parametrize(
    "line",
    [
        f"set -o pipefail; {TRAIN} 2>&1 | true",
        f"{TRAIN} >/dev/full 2>&1",
        f"{TRAIN} >&- 2>&- <&-",
        f"setsid {TRAIN} </dev/null",
    ],
    ids=["no reader", "no room", "closed", "no terminal"],
)
def test_a_run_ends_well_whoever_reads_its_output(line: str, tmp_path: Path) -> None:
    done = shell(line, tmp_path)
    assert done.returncode == 0, done.stderr
    assert b"Traceback" not in done.stderr
    assert json.loads((tmp_path / "run" / "manifest.json").read_text())["status"] == "finished"


def test_progress_that_nobody_reads_is_no_reason_to_stop(tmp_path: Path) -> None:
    code = (
        "import os, sys; from gridworld.process import console; console.prepare();"
        "console._SECONDS_BETWEEN_LINES = 0;"
        "read, write = os.pipe(); os.close(read); os.dup2(write, 2);"
        "p = console.Progress(10, 'x'); [p.update(i, 'y') for i in range(10)]; print('done')"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, "done\n")


@pytest.mark.parametrize("environment", [NO_UTF8, ASCII], ids=["no UTF-8", "ASCII"])
def test_names_in_a_locale_without_utf8(environment: dict[str, str], tmp_path: Path) -> None:
    (tmp_path / MAP).write_text("S..\n..G\n")
    words = [*SHORT["q_learning"], f"env.layout='{MAP}'", "hydra.run.dir=run"]
    done = script("train.py", *words, cwd=tmp_path, **environment)
    assert done.returncode == 0, done.stderr
    assert "q_learning on m\\" in done.stdout  # with the sign as a number
    assert done.stdout.isascii()
    for name, options in (
        ("evaluate", []),
        ("record", ["--format", "policy"]),
        ("report", ["--formats"]),
        ("reproduce", []),
    ):
        looked = script(f"{name}.py", "run", *options, cwd=tmp_path, **environment)
        assert looked.returncode == 0, looked.stderr
        assert (looked.stdout + looked.stderr).isascii()
        if environment is ASCII:
            break  # the others print in the same way
    refused = script("train.py", "env.layout='nö.txt'", cwd=tmp_path, **environment)
    assert refused.returncode == 2
    assert refused.stderr.startswith("error: layout 'n")


def check_full_disk(told: str, code: int) -> None:
    """That a command failed at it, and says nothing else."""
    assert (code, told) == (
        2,
        "error: standard output: cannot be written (No space left on device), "
        "what was printed is not complete; send it to where there is room\n",
    )


def print_to_a_full_disk(line: str, cwd: Path) -> None:
    """Run a command that fails at that, in a fork."""
    name, *words = line.split()
    done = script(name, *words, cwd=cwd, stdout=Path("/dev/full"))
    check_full_disk(done.stderr, done.returncode)


def test_help_that_cannot_be_written_is_an_error(tmp_path: Path) -> None:
    done = shell("SCRIPT train.py --help >/dev/full", tmp_path)  # in a process of its own
    check_full_disk(done.stderr.decode(), done.returncode)
    for path in (ROOT / "scripts").glob("*.py"):
        print_to_a_full_disk(f"{path.name} --help", tmp_path)


@pytest.mark.parametrize("line", ["train.py --cfg job", "train.py --version", "tune.py agent=ppo --cfg"])
def test_a_configuration_that_cannot_be_written_is_an_error(line: str, tmp_path: Path) -> None:
    print_to_a_full_disk(line, tmp_path)
    assert list(tmp_path.iterdir()) == []
    done = shell(f"set -o pipefail; SCRIPT {line} | head -c 1", tmp_path)
    assert (done.returncode, done.stderr, len(done.stdout)) == (0, b"", 1)


def test_a_result_that_cannot_be_written_is_an_error(tmp_path: Path) -> None:
    folder = tmp_path / "sweep" / "seed=0"
    train_in(folder, *SHORT["q_learning"], "recording.learning=false")
    entry = {"job": "seed=0", "hash": "x", "overrides": ["seed=0"]}
    content = {"asked": [{"overrides": ["seed=0"]}], "jobs": [entry]}
    (tmp_path / "sweep" / "sweep.json").write_text(json.dumps(sealed(content)))
    run = f"sweep/{folder.name}"
    for line in (f"evaluate.py {run}", "jobs.py sweep", f"record.py {run} --format policy"):
        print_to_a_full_disk(line, tmp_path)
    assert (folder / "recording" / "policy.png").exists()


def test_a_result_that_is_cut_short_is_an_error(tmp_path: Path) -> None:
    """A disk that fills while something is printed, where the first half fitted."""
    done = shell("ulimit -f 1; trap '' XFSZ; SCRIPT train.py --help >out", tmp_path)
    assert done.returncode == 2
    assert b"error: standard output: cannot be written (File too large)" in done.stderr
    assert (tmp_path / "out").stat().st_size == 1024


def test_a_mistake_has_its_exit_code_whoever_reads_it(tmp_path: Path) -> None:
    assert shell("SCRIPT evaluate.py nowhere 2>&-", tmp_path).returncode == 2
    assert shell("SCRIPT train.py seed=x 2>/dev/full", tmp_path).returncode == 2
