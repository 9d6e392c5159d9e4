"""The command lines, as a user types them: train, look, sweep, stop."""

import errno
import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import IO, Any

import pytest
from helpers.support import CONF, ROOT, SHORT, script, start

from gridworld.base.errors import InputError
from gridworld.commands import evaluate, run
from gridworld.commands import record as record_command
from gridworld.commands.manual import manual
from gridworld.commands.tune import main as tune

TRAINED_WITHOUT_NEEDLESS_IMPORTS = f"""
import runpy, sys
sys.argv = ["train.py", *sys.argv[1:]]
runpy.run_path({str(ROOT / "scripts" / "train.py")!r}, run_name="__main__")
assert "torch" in sys.modules and "pygame" in sys.modules
assert not {{"torch._dynamo", "sympy", "pkg_resources"}} & sys.modules.keys()
"""


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run from a process of its own, its output in output.txt beside it.

    The process never imports torch's compiler, sympy or pkg_resources, which would take longer than the run.
    """
    folder = tmp_path_factory.mktemp("finished")
    command = [sys.executable, "-c", TRAINED_WITHOUT_NEEDLESS_IMPORTS, *SHORT["dqn"], "hydra.run.dir=run"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    (folder / "output.txt").write_text(done.stdout)
    return folder / "run"


@pytest.mark.slow
def test_train_tells_what_was_reached_and_where(finished: Path) -> None:
    output = (finished.parent / "output.txt").read_text()
    summary = json.loads((finished / "summary.json").read_text())
    assert re.search(r"value +\S+ +\S+ +0\.9321", output)
    assert "certified optimal since" in output if summary["certified"] else "not optimal: regret" in output
    assert "  files: run\n" in output
    assert "  curves: tensorboard --logdir run\n" in output
    assert {"config.yaml", "hydra.yaml", "overrides.yaml"} == {
        p.name for p in (finished / ".hydra").iterdir()
    }


def test_runs_get_folders_of_their_own_even_in_the_same_second(tmp_path: Path) -> None:
    (tmp_path / "my map.txt").write_text("S..\n..G\n")
    words = (*SHORT["sarsa"], "env.layout=my map.txt")
    with start("train.py", *words, cwd=tmp_path) as one, start("train.py", *words, cwd=tmp_path) as other:
        told = [process.communicate(timeout=120)[1] for process in (one, other)]
    assert (one.returncode, other.returncode) == (0, 0), told
    folders = sorted(path.name for path in (tmp_path / "runs").iterdir())
    assert len(folders) == 2
    for folder in folders:
        assert re.fullmatch(r"\d{4}-\d\d-\d\d_\d\d-\d\d-\d\d_sarsa_my-map.txt_seed0_[0-9a-f]{6}", folder)


def test_help_is_a_manual_with_every_choice() -> None:
    lines = manual().splitlines()
    for file in CONF.glob("*/**/*.yaml"):
        if file.parent.parent.name == "tuned":
            continue  # listed by agent, see test_recipes.py
        line = next(line for line in lines if line.strip().split(" ")[0] == file.stem)
        assert len(line.split()) > 2, f"{file} opens with no comment that says what it is"
    assert "\n".join(lines).count("gridworld train ") >= 5


@pytest.mark.parametrize("command", ["-m gridworld --help", "{train} --help", "{train} --cfg job"])
def test_asking_imports_nothing_heavy(command: str, tmp_path: Path) -> None:
    words = command.format(train=ROOT / "scripts" / "train.py").split()
    done = subprocess.run(
        [sys.executable, "-X", "importtime", *words], cwd=tmp_path, capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0
    modules = {line.rsplit("|", 1)[1].strip() for line in done.stderr.splitlines() if "|" in line}
    assert ("hydra" in modules) == ("train" in command)
    assert not modules & {"torch", "stable_baselines3", "gymnasium", "scipy", "pygame", "tensorboard"}
    # A tabular agent's settings are in one module with its arithmetic, and composing reads all settings.
    assert ("numpy" in modules) <= ("--cfg" in command)


@pytest.mark.slow
def test_evaluate_scores_again_exactly_and_by_sampling(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    evaluate.main([str(finished), "--episodes", "50"])
    output = capsys.readouterr().out
    summary = json.loads((finished / "summary.json").read_text())
    value = next(line for line in output.splitlines() if line.strip().startswith("value"))
    assert float(value.split()[1]) == pytest.approx(summary["value"], abs=1e-4)
    assert "50 episodes" in output
    monkeypatch.setenv("COLUMNS", "60")
    evaluate.main([str(finished), "--episodes", "50", "--policy", "sampled"])
    assert max(map(len, capsys.readouterr().out.split("on classic")[1].splitlines())) <= 60

    other = tmp_path / "other.txt"
    other.write_text("S....G\n......\n......\n......\n......\n")
    evaluate.main([str(finished), "--layout", str(other), "--policy", "sampled", "--episodes", "50"])
    assert f"on {other}" in capsys.readouterr().out

    with pytest.raises(InputError, match=r"layout cliff: is 4x12, the agent was trained on 5x6; "):
        evaluate.main([str(finished), "--layout", "cliff"])
    evaluate.main([str(finished), "--render", "human"])
    assert "greedy policy of" in capsys.readouterr().out


def test_record_writes_every_format_it_names(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    films, maps = ["frames", "episode.gif", "episode.apng", "episode.mp4"], ["policy", "q_error", "visits"]
    line = [str(finished), "--format", "png", "gif", "apng", "mp4", "--cell-size", "11", "--fps", "7"]
    line += ["--policy", "sampled", "--episodes", "2", "--seed", "3", "--out", str(tmp_path / "films")]
    record_command.main(line)
    record_command.main([str(finished), "--format", *maps, "--out", str(tmp_path / "maps")])
    named = [Path(line) for line in capsys.readouterr().out.splitlines()]
    assert [path.name for path in named] == [*films, *(f"{name}.png" for name in maps)]
    assert all(path.exists() for path in named)
    assert set(tmp_path.glob("*/*")) == set(named)
    for path in named[len(films) :]:
        assert path.read_bytes() == (finished / path.name).read_bytes()


def test_record_says_where_it_cannot_write(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    out, line = tmp_path / "below", [str(finished), "--format", "gif", "--out"]
    told = "file/below: cannot be made, .*file is a file; choose another --out"
    with pytest.raises(InputError, match=told):
        record_command.main([*line, str(tmp_path / "file" / "below")])
    with monkeypatch.context() as patched:
        patched.setattr(os, "access", lambda path, mode: False)
        with pytest.raises(InputError, match=f"below: cannot be written, {tmp_path} is read-only; choose an"):
            record_command.main([*line, str(out)])
    assert [path.name for path in tmp_path.iterdir()] == ["file"]

    def refuse(path: Path, mode: str = "r", *more: Any, **named: Any) -> IO[Any]:
        if "w" in mode:
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), os.fspath(path))
        return path_open(path, mode, *more, **named)

    path_open = Path.open
    monkeypatch.setattr(sys, "argv", ["record.py", *line, str(out)])
    monkeypatch.setattr(Path, "open", refuse)  # as a file server may, whatever the permissions say
    with pytest.raises(SystemExit) as ended:
        run(record_command.main)
    told = f"{out}/episode.gif: Permission denied; choose another folder, or make {out} writable"
    assert (ended.value.code, capsys.readouterr().err) == (2, f"error: {told}\n")


# ---- what users of Hydra expect ----------------------------------------------------------------------------


def test_a_job_in_its_own_folder_speaks_of_the_users(tmp_path: Path) -> None:
    """And reads the user's map. What it prints can be typed where the command was typed."""
    (tmp_path / "map.txt").write_text("S..\n.#G\n")
    words = ["agent=q_learning", "env.layout=map.txt", "total_timesteps=300", "hydra.run.dir=runs/own"]
    quiet = ["recording.frames=false", "recording.gif=false", "recording.learning=false"]
    done = script("train.py", *words, *quiet, "hydra.job.chdir=true", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "  files: runs/own\n  curves: tensorboard --logdir runs\n" in done.stdout
    again = script("train.py", *words, "hydra.job.chdir=true", cwd=tmp_path)
    assert f"python {ROOT}/scripts/train.py resume=runs/own total_timesteps=" in again.stderr


@pytest.mark.slow
def test_tune_shows_what_train_would_run(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    words = ["agent=q_learning", "total_timesteps=1e3", "tune.trials=1e1"]

    def shows(*more: str) -> str:
        tune(more)
        return capsys.readouterr().out

    job = shows(*words, "--cfg", "job")
    between = [words[0], "--cfg", "job", words[1]]  # Hydra alone takes settings in one piece only
    assert job == script("train.py", *between, cwd=tmp_path).stdout
    whole = shows("--cfg", *words)
    assert whole == shows(*words, "-c", "all") == shows(*words, "--cfg")
    assert whole.startswith(job)
    assert "\n  trials: 10\n" in whole
    assert shows(*words, "-c", "job", "-p", "agent.gamma") == "# @package agent.gamma\n0.9\n"
    assert shows(*words, "--cfg", "--package", "env").startswith(
        "# @package env\nmax_episode_steps: 100\nrecipes_of: []\nlayout: classic\n"
    )
    for more, told in (
        (["--cfg", "--package", "nowhere"], "--package nowhere: no such part of the configuration"),
        (["-p", "env"], "--package env: shows a part of the configuration; use it with --cfg"),
    ):
        with pytest.raises(InputError, match=told):
            shows(*words, *more)
    with pytest.raises(InputError, match=r"invalid choice: .hydra."):
        shows(*words, "--cfg", "hydra")
