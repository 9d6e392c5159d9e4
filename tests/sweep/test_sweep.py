"""Sweeps as a user types them: run, come back, widen, fail, stop; the table is right throughout."""

import csv
import json
import os
import re
import shutil
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
from helpers.pages import NO_PICTURES
from helpers.support import ROOT, script, start, train_on_full_disk, wait_for

from gridworld.base.atomic_write import is_locked, locked
from gridworld.commands import jobs as jobs_command
from gridworld.run.reader import read_run
from gridworld.run.writer import RunWriter
from gridworld.sweeps.console import results_lines
from gridworld.sweeps.folder import SweepFolder

QUICK = ("agent=q_learning", "total_timesteps=500", *NO_PICTURES)
FOLDER = "hydra.sweep.dir=sweep"
WORKERS = ("hydra/launcher=joblib", "hydra.launcher.n_jobs=2")
OWN_CLASSES = """
import os, signal
from stable_baselines3 import A2C

class Broken(A2C):
    def learn(self, *arguments, **keywords):
        raise RuntimeError("first\\nsecond")

class Killer(A2C):
    def learn(self, *arguments, **keywords):
        os.kill(os.getpid(), signal.SIGKILL)
"""


def sweep(*words: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    return script("train.py", "-m", *QUICK, FOLDER, *words, cwd=cwd)


def table(folder: Path) -> dict[str, dict[str, str]]:
    with (folder / "jobs.csv").open(newline="") as file:
        return {row["job"]: row for row in csv.DictReader(file)}


def results(output: str) -> list[list[str]]:
    """The rows of the table of results, by columns."""
    lines = output.split("\n\n")[1].splitlines()
    assert lines[0].split()[:2] == ["agent", "task"]
    return [re.split(" {2,}", line.strip()) for line in lines[1:]]


def statuses(folder: Path) -> dict[str, str]:
    return {job: row["status"] for job, row in table(folder).items()}


@pytest.fixture(scope="module")
def two_jobs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder in which a sweep of two jobs has come to its end."""
    folder = tmp_path_factory.mktemp("two")
    done = sweep("seed=0,1", cwd=folder)
    assert done.returncode == 0, done.stderr
    assert "sweep sweep: 2 jobs: 2 done" in done.stdout
    assert "curves: tensorboard --logdir sweep" in done.stdout
    assert f"report: python {ROOT}/scripts/report.py sweep\n" in done.stdout
    assert results(done.stdout) == [["q_learning", "classic", "0 of 2 [0 %, 66 %]", "> 512"]]
    return folder


@pytest.fixture
def swept(two_jobs: Path, tmp_path: Path) -> Path:
    """A copy of it."""
    return Path(shutil.copytree(two_jobs, tmp_path / "copy"))


@pytest.mark.slow
def test_a_sweep_is_come_back_to(swept: Path) -> None:
    folder = swept / "sweep"
    first = (folder / "seed=0" / "manifest.json").read_bytes()
    row = table(folder)["seed=0"]
    assert float(row["objective"]) == json.loads((folder / "seed=0" / "summary.json").read_text())["regret"]
    assert float(row["seconds"]) >= 0
    assert row["overrides"] == f"{' '.join(QUICK)} seed=0"

    widened = sweep("seed=0,1,2", "logging.progress=false", cwd=swept)  # logging is no other job
    assert "3 jobs: 1 pending, 2 done; 1 to run" in widened.stderr
    assert [row[2] for row in results(widened.stdout)] == ["0 of 3 [0 %, 56 %]"]
    assert (folder / "seed=0" / "manifest.json").read_bytes() == first
    content = json.loads((folder / "sweep.json").read_text())
    assert [job["job"] for job in content["jobs"]] == ["seed=0", "seed=1", "seed=2"]
    assert len(content["asked"]) == 2

    other = sweep("seed=0", "agent.gamma=0.5", cwd=swept)
    assert other.returncode == 2
    assert "which has no job in common with this one" in other.stderr
    assert sweep("seed=0", "agent.gamma=0.5", "hydra.sweeper.extend=true", cwd=swept).returncode == 0
    (added,) = statuses(folder).keys() - {"seed=0", "seed=1", "seed=2"}
    assert "agent.gamma=0.5" in added
    rows = list(SweepFolder(folder).rows().values())
    assert [line.split()[2] for line in results_lines(folder, rows)[1:]] == ["gamma=0.9", "gamma=0.5"]

    shutil.rmtree(folder / "seed=1")  # to have it again
    assert "1 to run" in sweep("seed=0,1", cwd=swept).stderr
    assert set(statuses(folder).values()) == {"done"}


@pytest.mark.slow
def test_settings_are_told_by_the_words_that_asked_for_them(tmp_path: Path) -> None:
    """Many others follow from the slip, and would hide it."""
    words = ("agent=ppo", "env.slip=0,0.1", "observation=one_hot,coordinates", "total_timesteps=300")
    done = sweep(*words, "seed=0", cwd=tmp_path)
    assert [row[2] for row in results(done.stdout)] == [
        f"env.slip={slip} observation={kind}" for slip in ("0", "0.1") for kind in ("one_hot", "coordinates")
    ]
    words = ("agent=q_learning", "n_envs=${seed}", "seed=3,4", "total_timesteps=300")  # which follows from it
    followed = script("train.py", "-m", *words, *NO_PICTURES, cwd=tmp_path)
    assert [row[2] for row in results(followed.stdout)] == ["n_envs=3", "n_envs=4"]
    presets = script("train.py", "-m", *QUICK, "env=four_rooms", "tuned=none,large", cwd=tmp_path)
    assert [row[2] for row in results(presets.stdout)] == ["tuned=none", "tuned=large"]


def test_a_failure_stops_no_other_job(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    done = sweep("agent.learning_rate=0.1,2,0.2", cwd=tmp_path)
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    *counted, _ = results(done.stdout)  # the last line names the job that is not
    assert [row[2] for row in counted] == ["learning_rate=0.1", "learning_rate=0.2"]
    why = table(tmp_path / "sweep")["agent.learning_rate=2"]["error"]
    assert why.startswith("agent.learning_rate=2: must be above 0 and ")
    assert done.stderr.count("agent.learning_rate=2: must be above 0 and ") == 1
    assert "retry_failed" not in done.stderr  # it would fail again
    jobs_command.main([str(tmp_path / "sweep")])
    *rows, total = capsys.readouterr().out.splitlines()
    of_rates = ((0.1, "done"), (2, "failed"), (0.2, "done"))
    assert [row.split()[:2] for row in rows] == [[f"agent.learning_rate={r}", s] for r, s in of_rates]
    assert rows[1].endswith(why)
    assert total == "3 jobs: 2 done, 1 failed"
    jobs_command.main([str(tmp_path / "sweep"), "--status", "failed"])
    assert len(capsys.readouterr().out.splitlines()) == 2


def test_what_fails_while_it_runs_is_told_and_tried_again_if_asked(tmp_path: Path) -> None:
    words = ("agent=dqn", "agent.learning_rate=1e30,1e-3", "total_timesteps=600", "agent.learning_starts=200")
    folder = tmp_path / "sweep"
    done = sweep(*words, cwd=tmp_path)
    assert done.returncode == 1, done.stderr
    assert sorted(statuses(folder).values()) == ["done", "failed"]
    (failed,) = (job for job, status in statuses(folder).items() if status == "failed")
    assert "training diverged" in table(folder)[failed]["error"]
    assert json.loads((folder / failed / "manifest.json").read_text())["status"] == "failed"
    retry = next(line for line in done.stderr.splitlines() if line.startswith("to try them again: python"))
    assert retry.endswith("hydra.sweeper.retry_failed=true")
    assert "1 to run" in sweep(*words, "hydra.sweeper.retry_failed=true", cwd=tmp_path).stderr


def test_an_unforeseen_error_or_a_killed_worker_takes_no_other_job_along(tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(OWN_CLASSES)
    path = f"{tmp_path}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"
    words = ["-m", "agent=a2c", "total_timesteps=64", "n_envs=4", "evaluation.every=64", *NO_PICTURES, FOLDER]
    words += ["agent.algorithm=own.Broken,own.Killer,stable_baselines3.A2C", *WORKERS]
    done = script("train.py", *words, cwd=tmp_path, PYTHONPATH=path)
    assert done.returncode == 1, done.stderr
    assert "Traceback" not in done.stderr
    broken, killed, working = table(tmp_path / "sweep").values()
    assert (broken["status"], broken["error"]) == ("failed", "RuntimeError: first second")
    assert (killed["status"], killed["error"]) == ("failed", "its process died (exit code -9)")
    assert (working["status"], working["error"]) == ("done", "")
    assert "in learn\n" in (tmp_path / "sweep" / broken["job"] / "error.txt").read_text()
    again = script("train.py", *words, cwd=tmp_path, PYTHONPATH=path)
    assert "0 to run" in again.stderr  # what failed is remembered


def members(session: int) -> list[str]:
    """The live processes of a session."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, _, own = stat.read_text().rsplit(")", 1)[1].split()[:4]
        except (FileNotFoundError, ProcessLookupError):
            continue
        if int(own) == session and state != "Z":
            found.append(stat.parent.name)
    return found


def curve_begun(path: Path) -> bool:
    return path.read_text().count("\n") > 2


@pytest.mark.slow
def test_a_fork_that_is_killed_takes_no_other_job_along(tmp_path: Path) -> None:
    words = ["-m", *QUICK, "seed=range(3)", "total_timesteps=20000", FOLDER, "hydra/launcher=forks"]
    with start("train.py", *words, "hydra.launcher.n_jobs=2", cwd=tmp_path) as process:
        wait_for(lambda: any(map(curve_begun, tmp_path.glob("sweep/*/curve.csv"))), "a job")
        os.kill(max(int(each) for each in members(process.pid)), signal.SIGKILL)
        _, errors = process.communicate(timeout=180)
    assert process.returncode == 0, errors
    assert "Traceback" not in errors
    assert list(statuses(tmp_path / "sweep").values()) == ["done"] * 3


def with_other_settings(run: Path) -> None:
    then = read_run(run)
    then.manifest["config"]["total_timesteps"] = 700
    RunWriter(run, then.manifest).end("interrupted")


def made_longer(run: Path) -> None:
    longer = script("train.py", f"resume={run}", "total_timesteps=700", cwd=run)
    assert longer.returncode == 0, longer.stderr


def cut_off(run: Path) -> None:
    os.truncate(run / "manifest.json", 300)


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (with_other_settings, "contains an unfinished run with other settings (total_timesteps=500"),
        (made_longer, "the run in seed=0 was made 700 steps long"),
        (cut_off, "manifest.json: is not JSON, it was changed or cut off"),
    ],
)
def test_a_job_that_cannot_go_on_says_why_and_begins_anew_if_asked(
    change: Callable[[Path], None], why: str, swept: Path
) -> None:
    """It is left alone, however often, until it is asked for; what is not its own stays."""
    folder = swept / "sweep" / "seed=0"
    change(folder)
    (folder / "mynotes.txt").write_text("mine")
    before = (folder / "model.zip").read_bytes()
    for _ in range(2):
        told = sweep("seed=0,1", cwd=swept)
        assert told.returncode == 1
        assert f"failed:\n  {' '.join(QUICK)} seed=0: " in told.stderr
        assert why in told.stderr
        assert why in table(swept / "sweep")["seed=0"]["error"]
        assert (folder / "model.zip").read_bytes() == before
    assert "0 to run" in told.stderr
    again = sweep("seed=0,1", "hydra.sweeper.retry_failed=true", cwd=swept)
    assert again.returncode == 0, again.stderr
    assert statuses(swept / "sweep") == {"seed=0": "done", "seed=1": "done"}
    assert "resumed" not in json.loads((folder / "manifest.json").read_text())
    assert json.loads((folder / "summary.json").read_text())["total_timesteps"] == 500
    assert (folder / "mynotes.txt").read_text() == "mine"


@pytest.mark.slow
def test_a_full_disk_is_told_and_the_same_line_goes_on(tmp_path: Path) -> None:
    """Too few bytes for the table, then for a job's event file."""
    words = ["-m", *QUICK, "seed=0,1", "total_timesteps=2000", "checkpoint.every=500", FOLDER]
    for most in (100, 15_000):
        full = train_on_full_disk(most, *words, cwd=tmp_path)
        assert full.returncode == 1
        assert "Traceback" not in full.stderr
        assert "File too large" in full.stderr
        assert "resume with: python " in full.stderr.splitlines()[-1]
    assert set(statuses(tmp_path / "sweep").values()) == {"interrupted"}
    assert "File too large" in table(tmp_path / "sweep")["seed=0"]["error"]
    again = script("train.py", *words, cwd=tmp_path)
    assert again.returncode == 0, again.stderr
    assert set(statuses(tmp_path / "sweep").values()) == {"done"}


def test_a_lock_keeps_a_second_sweep_out_and_ends_with_its_block(tmp_path: Path) -> None:
    path = tmp_path / "sweep" / ".lock"
    path.parent.mkdir()
    assert not is_locked(path)
    with locked(path, wait=0) as first, locked(path, wait=0.05) as second:
        assert (first, second, is_locked(path)) == (True, False, True)
        done = sweep("seed=0", cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr == "error: sweep: another process is using it; wait for it or stop it\n"
    assert not is_locked(path)


def test_a_run_that_is_there_is_not_taken_for_another_job(swept: Path) -> None:
    folder = swept / "sweep"
    (folder / "seed=1").rename(folder / "seed=2")
    before = (folder / "seed=2" / "manifest.json").read_bytes()
    done = sweep("seed=0,2", cwd=swept)
    assert done.returncode == 0, done.stderr
    assert "seed=2" not in statuses(folder)
    assert list(statuses(folder).values()) == ["done", "pending", "done"]
    assert (folder / "seed=2" / "manifest.json").read_bytes() == before
