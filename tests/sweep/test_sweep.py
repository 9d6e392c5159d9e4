"""Sweeps as a user types them: run, come back, widen, fail, stop; the table is right throughout."""

import csv
import errno
import fcntl
import json
import os
import re
import shutil
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from helpers.pages import NO_PICTURES
from helpers.support import ROOT, configure, script, start, train_on_full_disk

from gridworld.commands import jobs as jobs_command
from gridworld.errors import InputError
from gridworld.run.reader import read_run
from gridworld.run.writer import RunWriter
from gridworld.storage.atomic_write import AppendLog, is_locked, locked
from gridworld.sweep.console import results_lines
from gridworld.sweep.job import JobError, run_in_sweep
from gridworld.sweep.job_table import JobTable
from gridworld.training.together import run_alone

QUICK = ("agent=q_learning", "total_timesteps=500", *NO_PICTURES)
FOLDER = "hydra.sweep.dir=sweep"
WORKERS = ("hydra/launcher=joblib", "hydra.launcher.n_jobs=2")
FORKS = ("hydra/launcher=forks", "hydra.launcher.n_jobs=2")
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
    assert sweep("seed=0,1", cwd=folder).returncode == 0
    return folder


@pytest.fixture
def swept(two_jobs: Path, tmp_path: Path) -> Path:
    """A copy of it."""
    return Path(shutil.copytree(two_jobs, tmp_path / "copy"))


def test_a_sweep_is_come_back_to(tmp_path: Path) -> None:
    folder = tmp_path / "sweep"
    done = sweep("seed=0,1", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "sweep sweep: 2 jobs: 2 done" in done.stdout
    assert "curves: tensorboard --logdir sweep" in done.stdout
    assert f"report: python {ROOT / 'scripts' / 'report.py'} sweep\n" in done.stdout
    assert results(done.stdout) == [["q_learning", "classic", "0 of 2 [0 %, 66 %]", "> 512"]]
    assert statuses(folder) == {"seed=0": "done", "seed=1": "done"}
    first = (folder / "seed=0" / "manifest.json").read_bytes()
    summary = json.loads((folder / "seed=0" / "summary.json").read_text())
    row = table(folder)["seed=0"]
    assert float(row["objective"]) == summary["regret"]
    assert float(row["seconds"]) >= 0
    assert row["overrides"] == f"{' '.join(QUICK)} seed=0"

    widened = sweep("seed=0,1,2", "logging.progress=false", cwd=tmp_path)  # logging is no other job
    assert "3 jobs: 1 pending, 2 done; 1 to run" in widened.stderr
    assert [row[2] for row in results(widened.stdout)] == ["0 of 3 [0 %, 56 %]"]
    assert statuses(folder) == {"seed=0": "done", "seed=1": "done", "seed=2": "done"}
    assert (folder / "seed=0" / "manifest.json").read_bytes() == first
    content = json.loads((folder / "sweep.json").read_text())
    assert [job["job"] for job in content["jobs"]] == ["seed=0", "seed=1", "seed=2"]
    assert len(content["asked"]) == 2

    other = sweep("seed=0", "agent.gamma=0.5", cwd=tmp_path)
    assert other.returncode == 2
    assert "which has no job in common with this one" in other.stderr
    assert sweep("seed=0", "agent.gamma=0.5", "hydra.sweeper.extend=true", cwd=tmp_path).returncode == 0
    (added,) = statuses(folder).keys() - {"seed=0", "seed=1", "seed=2"}
    assert "agent.gamma=0.5" in added
    rows = list(JobTable(folder).read().values())
    assert [line.split()[2] for line in results_lines(folder, rows)[1:]] == ["gamma=0.9", "gamma=0.5"]

    subprocess.run(["rm", "-r", str(folder / "seed=1")], check=True)  # to have it again
    assert "1 to run" in sweep("seed=0,1", cwd=tmp_path).stderr
    assert statuses(folder)["seed=1"] == "done"


def test_settings_are_told_by_the_words_that_asked_for_them(tmp_path: Path) -> None:
    """Many others follow from the slip, and would hide it."""
    words = ("agent=ppo", "env.slip=0,0.1", "observation=one_hot,image", "total_timesteps=300", "seed=0")
    done = sweep(*words, cwd=tmp_path)
    assert [row[2] for row in results(done.stdout)] == [
        f"env.slip={slip} observation={kind}" for slip in ("0", "0.1") for kind in ("one_hot", "image")
    ]
    words = ("agent=q_learning", "n_envs=${seed}", "seed=3,4", "total_timesteps=300")  # which follows from it
    followed = script("train.py", "-m", *words, *NO_PICTURES, cwd=tmp_path)
    assert [row[2] for row in results(followed.stdout)] == ["n_envs=3", "n_envs=4"]
    presets = script("train.py", "-m", *QUICK, "env=four_rooms", "preset=auto,none,large", cwd=tmp_path)
    assert [row[2] for row in results(presets.stdout)] == ["preset=auto", "preset=large"]


@pytest.mark.parametrize("launcher", ["basic", "joblib"])
def test_a_failure_stops_no_other_job(launcher: str, tmp_path: Path) -> None:
    words = ("agent.learning_rate=0.1,2,0.2", "seed=0,1", f"hydra/launcher={launcher}", "agent=q_learning")
    done = sweep(*words, cwd=tmp_path)
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    assert sorted(statuses(tmp_path / "sweep").values()) == ["done"] * 4 + ["failed"] * 2
    assert [row[2] for row in results(done.stdout)] == ["learning_rate=0.1", "learning_rate=0.2"]
    row = table(tmp_path / "sweep")["agent.learning_rate=2,seed=0"]
    assert row["error"].startswith("agent.learning_rate=2: must be above 0 and at most 1")
    assert done.stderr.count("agent.learning_rate=2: must be above 0 and at most 1") == 2
    assert "retry_failed" not in done.stderr  # it would fail again


def test_what_fails_while_it_runs_is_told_and_tried_again_if_asked(tmp_path: Path) -> None:
    words = ("agent=dqn", "agent.learning_rate=1e30,1e-3", "total_timesteps=600", "evaluation.every=300")
    done = sweep(*words, "agent.learning_starts=200", cwd=tmp_path)
    assert done.returncode == 1, done.stderr
    folder = tmp_path / "sweep"
    (failed,) = (job for job, status in statuses(folder).items() if status == "failed")
    assert "training diverged" in table(folder)[failed]["error"]
    assert json.loads((folder / failed / "manifest.json").read_text())["status"] == "failed"
    again = sweep(*words, "agent.learning_starts=200", cwd=tmp_path)
    assert again.returncode == 1
    assert "0 to run" in again.stderr
    retry = next(line for line in again.stderr.splitlines() if line.startswith("to try them again: python"))
    assert retry.endswith("hydra.sweeper.retry_failed=true")
    retried = sweep(*words, "agent.learning_starts=200", "hydra.sweeper.retry_failed=true", cwd=tmp_path)
    assert "1 to run" in retried.stderr


def test_it_stops_at_the_first_failure_if_asked(tmp_path: Path) -> None:
    words = ("agent=dqn", "agent.learning_rate=1e30,1e-3", "total_timesteps=600", "agent.learning_starts=200")
    done = sweep(*words, "hydra.sweeper.stop_at_first_failure=true", cwd=tmp_path)
    assert done.returncode == 1
    assert list(statuses(tmp_path / "sweep").values()) == ["failed", "pending"]
    assert "stopped at the first failure; go on with: python " in done.stderr


def test_an_unforeseen_error_leaves_its_traceback(tmp_path: Path) -> None:
    done = with_own_classes("agent.algorithm=own.Broken,stable_baselines3.A2C", cwd=tmp_path)
    assert done.returncode == 1, done.stderr
    broken, working = table(tmp_path / "sweep").values()
    assert (broken["status"], working["status"]) == ("failed", "done")
    assert broken["error"] == "RuntimeError: first second"
    assert "in learn\n" in (tmp_path / "sweep" / broken["job"] / "error.txt").read_text()
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("launcher", "number"),
    [
        ("basic", signal.SIGINT),
        ("forks", signal.SIGINT),
        ("forks", signal.SIGTERM),
        ("joblib", signal.SIGTERM),
    ],
)
def test_a_signal_ends_it_and_it_says_how_to_go_on(
    number: signal.Signals, launcher: str, tmp_path: Path
) -> None:
    folder = tmp_path / "sweep"
    words = ["-m", *QUICK, "seed=0,1", "total_timesteps=100000000", FOLDER, f"hydra/launcher={launcher}"]
    with start("train.py", *words, cwd=tmp_path) as process:
        wait_for(lambda: any(curve_begun(path) for path in folder.glob("*/curve.csv")))
        if number is signal.SIGINT:
            os.killpg(process.pid, number)  # as a terminal does on Ctrl-C
        else:
            process.send_signal(number)
        _, errors = process.communicate(timeout=20)
    assert process.returncode == 128 + number
    assert f"stopped by {number.name}; go on with: python " in errors
    assert "Traceback" not in errors
    wait_for(lambda: not members(process.pid))
    assert "interrupted" in statuses(folder).values()
    assert "running" not in statuses(folder).values()


@pytest.mark.parametrize("workers", [FORKS, WORKERS])
def test_workers_do_not_outlive_a_killed_sweep(workers: tuple[str, ...], tmp_path: Path) -> None:
    folder = tmp_path / "sweep"
    words = ["-m", *QUICK, "seed=0,1,2", "total_timesteps=100000000", FOLDER, *workers]
    with start("train.py", *words, cwd=tmp_path) as process:
        wait_for(lambda: any(curve_begun(path) for path in folder.glob("*/curve.csv")))
        process.kill()
    wait_for(lambda: not members(process.pid))
    looked = script("jobs.py", "sweep", cwd=tmp_path)
    assert looked.returncode == 0
    assert looked.stdout.splitlines()[-1].startswith("3 jobs: ")
    assert "running" not in looked.stdout
    assert set(statuses(folder).values()) <= {"interrupted", "pending"}


def test_a_fork_that_is_killed_takes_no_other_job_along(tmp_path: Path) -> None:
    words = ["-m", *QUICK, "seed=range(4)", "total_timesteps=40000", FOLDER, *FORKS]
    with start("train.py", *words, cwd=tmp_path) as process:
        wait_for(lambda: any(curve_begun(path) for path in (tmp_path / "sweep").glob("*/curve.csv")))
        os.kill(max(int(each) for each in members(process.pid)), signal.SIGKILL)
        _, errors = process.communicate(timeout=30)
    assert process.returncode == 0, errors
    assert "Traceback" not in errors
    assert list(statuses(tmp_path / "sweep").values()) == ["done"] * 4


def test_a_worker_that_is_killed_takes_no_other_job_along(tmp_path: Path) -> None:
    words = ("agent.algorithm=own.Killer,stable_baselines3.A2C", *WORKERS)
    done = with_own_classes(*words, cwd=tmp_path)
    assert done.returncode == 1, done.stderr
    rows = table(tmp_path / "sweep").values()
    assert [row["status"] for row in rows] == ["failed", "done"]
    assert {row["error"] for row in rows} == {"its process was lost (exit code -9)", ""}
    again = with_own_classes(*words, cwd=tmp_path)
    assert "0 to run" in again.stderr  # what failed is remembered


def test_a_job_that_cannot_go_on_says_why_and_begins_anew_if_asked(swept: Path) -> None:
    run = read_run(swept / "sweep" / "seed=0")
    run.manifest["config"]["total_timesteps"] = 700
    RunWriter(run.folder, run.manifest).end("interrupted")
    check_told_and_begun_anew(swept, "holds an unfinished run with other settings (total_timesteps=500")


def test_a_job_that_was_made_longer_is_no_longer_done(swept: Path) -> None:
    longer = script("train.py", "resume=sweep/seed=0", "total_timesteps=700", cwd=swept)
    assert longer.returncode == 0, longer.stderr
    check_told_and_begun_anew(swept, "the run in seed=0 was made 700 steps long")


@pytest.mark.parametrize("keep", [0, 300])
def test_a_job_with_a_damaged_manifest_is_told(keep: int, swept: Path) -> None:
    file = swept / "sweep" / "seed=0" / "manifest.json"
    file.write_bytes(file.read_bytes()[:keep])
    check_told_and_begun_anew(swept, "manifest.json: is no JSON, it was changed or cut off")


def check_told_and_begun_anew(cwd: Path, why: str) -> None:
    """The job on seed 0 is left alone, however often, until it is asked for; what is not its own stays."""
    folder = cwd / "sweep" / "seed=0"
    (folder / "mynotes.txt").write_text("mine")
    before = (folder / "model.zip").read_bytes()
    for _ in range(2):
        told = sweep("seed=0,1", cwd=cwd)
        assert told.returncode == 1
        assert f"failed:\n  {' '.join(QUICK)} seed=0: " in told.stderr
        assert why in told.stderr
        assert why in table(cwd / "sweep")["seed=0"]["error"]
        assert (folder / "model.zip").read_bytes() == before
    assert "0 to run" in told.stderr
    again = sweep("seed=0,1", "hydra.sweeper.retry_failed=true", cwd=cwd)
    assert again.returncode == 0, again.stderr
    assert statuses(cwd / "sweep") == {"seed=0": "done", "seed=1": "done"}
    assert "resumed" not in json.loads((folder / "manifest.json").read_text())
    assert json.loads((folder / "summary.json").read_text())["total_timesteps"] == 500
    assert (folder / "mynotes.txt").read_text() == "mine"


@pytest.mark.parametrize(("most", "stands"), [(100, set()), (15_000, {"interrupted"})])
def test_a_full_disk_is_told_and_the_same_line_goes_on(most: int, stands: set[str], tmp_path: Path) -> None:
    """Too few bytes for the table, or for a job's event file."""
    words = ["-m", *QUICK, "seed=0,1", "total_timesteps=2000", "checkpoint.every=500", FOLDER]
    full = train_on_full_disk(most, *words, cwd=tmp_path)
    assert full.returncode == 1
    assert "Traceback" not in full.stderr
    assert "File too large" in full.stderr
    assert "go on with: python " in full.stderr.splitlines()[-1]
    if stands:
        assert set(statuses(tmp_path / "sweep").values()) == stands
        assert "File too large" in table(tmp_path / "sweep")["seed=0"]["error"]
    again = script("train.py", *words, cwd=tmp_path)
    assert again.returncode == 0, again.stderr
    assert set(statuses(tmp_path / "sweep").values()) == {"done"}


def test_a_job_that_a_full_disk_ended_goes_on_from_its_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = (*QUICK, "total_timesteps=2000", "checkpoint.every=500", "evaluation.every=100")
    folder = tmp_path / "seed=0"
    folder.mkdir()
    append = AppendLog.append

    def fill(journal: AppendLog, content: bytes) -> None:
        if any(folder.glob("checkpoints/*.state")):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        append(journal, content)

    monkeypatch.setattr(AppendLog, "append", fill)
    with pytest.raises(JobError, match="No space left on device"):
        run_alone(run_in_sweep(configure(*words), folder, list(words), stop_at_failure=False))
    assert JobTable(tmp_path).row("seed=0").status == "interrupted"
    monkeypatch.setattr(AppendLog, "append", append)
    assert run_alone(run_in_sweep(configure(*words), folder, list(words), stop_at_failure=False)) >= 0
    assert JobTable(tmp_path).row("seed=0").status == "done"
    assert json.loads((folder / "manifest.json").read_text())["resumed"][0]["step"] > 0


def with_own_classes(*words: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    """A sweep of A2C and of classes made for the occasion."""
    (cwd / "own.py").write_text(OWN_CLASSES)
    return script(
        "train.py",
        *("-m", "agent=a2c", "total_timesteps=64", "n_envs=4", "evaluation.every=64", FOLDER),
        *NO_PICTURES,
        *words,
        cwd=cwd,
        PYTHONPATH=f"{cwd}{os.pathsep}{os.environ.get('PYTHONPATH', '')}",
    )


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


def wait_for(condition: Callable[[], object], seconds: float = 60) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.05)


def test_two_sweeps_do_not_meet_in_one_folder(tmp_path: Path) -> None:
    (tmp_path / "sweep").mkdir()
    with locked(tmp_path / "sweep" / ".lock") as is_ours:
        assert is_ours
        done = sweep("seed=0", cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr == "error: sweep: another process runs this sweep; wait for it or stop it\n"


def test_a_lock_is_seen_and_ends_with_its_block(tmp_path: Path) -> None:
    path = tmp_path / "lock"
    assert not is_locked(path)
    with locked(path):
        assert is_locked(path)
        with locked(path, wait=0.05) as is_ours:
            assert not is_ours
        assert is_locked(path)
    assert not is_locked(path)


def test_a_file_system_without_locks_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(file: int, operation: int) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", refuse)
    with pytest.raises(InputError, match="no locks"), locked(tmp_path / "lock"):
        raise AssertionError


@pytest.mark.parametrize("damage", ["[]", '{"format": 1, "asked": [], "jobs": [{}]}'])
def test_a_damaged_sweep_is_refused_and_left_alone(damage: str, tmp_path: Path) -> None:
    (tmp_path / "sweep").mkdir()
    (tmp_path / "sweep" / "sweep.json").write_text(damage)
    done = sweep("seed=0", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("error: sweep/sweep.json: damaged (")
    assert [path.name for path in (tmp_path / "sweep").iterdir()] == ["sweep.json"]


def test_a_run_that_is_there_is_not_taken_for_another_job(tmp_path: Path) -> None:
    assert sweep("seed=0", cwd=tmp_path).returncode == 0
    asked = (tmp_path / "sweep" / "sweep.json").read_bytes()
    assert sweep("seed=1", "n_envs=4", "hydra.sweeper.extend=true", cwd=tmp_path).returncode == 0
    (there,) = (job for job in statuses(tmp_path / "sweep") if "seed=1" in job)
    (tmp_path / "sweep" / there).rename(tmp_path / "sweep" / "seed=1")
    other = (tmp_path / "sweep" / "seed=1" / "manifest.json").read_bytes()
    (tmp_path / "sweep" / "sweep.json").write_bytes(asked)
    done = sweep("seed=0,1", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert len(statuses(tmp_path / "sweep")) == 2
    assert "seed=1" not in statuses(tmp_path / "sweep")
    assert (tmp_path / "sweep" / "seed=1" / "manifest.json").read_bytes() == other


def test_a_table_that_was_damaged_or_lost_is_made_again(swept: Path) -> None:
    file = swept / "sweep" / "jobs.csv"
    before = file.read_text()
    for damage in ("nonsense\n", before.replace("done", "running"), before.splitlines()[0] + "\n", None):
        file.unlink()
        if damage is not None:
            file.write_text(damage)
        jobs_command.main([str(swept / "sweep")])
        assert file.read_text() == before


def test_the_jobs_are_listed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sweep("seed=0,-1,1", cwd=tmp_path)
    jobs_command.main([str(tmp_path / "sweep")])
    *rows, total = capsys.readouterr().out.splitlines()
    assert [row.split()[0] for row in rows] == ["seed=0", "seed=-1", "seed=1"]
    assert [row.split()[1] for row in rows] == ["done", "failed", "done"]
    assert rows[1].endswith("seed=-1: must be from 0 to 4294967295 (says jobs.csv alone)")
    assert total == "3 jobs: 2 done, 1 failed"
    jobs_command.main([str(tmp_path / "sweep"), "--status", "failed"])
    assert len(capsys.readouterr().out.splitlines()) == 2
