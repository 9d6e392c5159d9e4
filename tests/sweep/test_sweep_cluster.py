"""Sweeps on a real Slurm and a real Ray, a node each: the same folders, failures and restarts as here."""

import os
import signal
import subprocess
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from helpers import forks
from helpers.clusters import ray_head, slurm
from helpers.support import script, start, wait_for
from test_sweep import OWN_CLASSES, QUICK, curve_begun, statuses, table

pytestmark = pytest.mark.slow
ENDLESS = "total_timesteps=100000000"


@dataclass
class Cluster:
    """One that runs, and what it takes to use it."""

    launcher: str
    environment: dict[str, str]

    def words(self, *more: str) -> list[str]:
        return ["-m", *QUICK, "hydra.sweep.dir=sweep", f"hydra/launcher={self.launcher}", *more]

    def sweep(self, *more: str, cwd: Path) -> subprocess.CompletedProcess[str]:
        return script("train.py", *self.words(*more), cwd=cwd, **self.environment)

    def start(self, *more: str, cwd: Path) -> forks.Started:
        return start("train.py", *self.words(*more), cwd=cwd, **self.environment)

    def slurms(self, *command: str) -> str:
        environment = {**os.environ, **self.environment}
        return subprocess.run(command, env=environment, check=True, capture_output=True, text=True).stdout


@pytest.fixture(scope="module", params=["slurm", "ray"])
def cluster(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    own = tmp_path_factory.mktemp("own")
    (own / "own.py").write_text(OWN_CLASSES)
    path = f"{own}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"
    begin = {"slurm": slurm, "ray": ray_head}[request.param]
    with begin(tmp_path_factory.mktemp(request.param), {"PYTHONPATH": path}) as found:
        yield Cluster(request.param, {**found, "PYTHONPATH": path})


def a_class(*names: str) -> list[str]:
    """Of A2C or one made for the occasion."""
    short = ("agent=a2c", "total_timesteps=64", "n_envs=4", "evaluation.every=64")
    return [*short, f"agent.algorithm={','.join(names)}"]


@pytest.mark.slow
def test_a_small_sweep_comes_to_its_end_and_is_widened(cluster: Cluster, tmp_path: Path) -> None:
    """A failure and a lost process take no other job along."""
    two_per_task = ["hydra.launcher.jobs_per_task=2"] if cluster.launcher == "slurm" else []
    words = a_class("own.Broken", "own.Killer", "stable_baselines3.A2C")
    done = cluster.sweep(*words, *two_per_task, cwd=tmp_path)
    assert done.returncode == 1, done.stderr
    broken, killed, working = table(tmp_path / "sweep").values()
    assert [row["status"] for row in (broken, killed, working)] == ["failed", "failed", "done"]
    assert (broken["error"], working["error"]) == ("RuntimeError: first second", "")
    assert killed["error"].startswith("its process died (")
    assert done.stderr.count("RuntimeError: first second") == 1
    assert "Traceback" not in done.stderr
    first = {path: path.read_bytes() for path in (tmp_path / "sweep").glob("*/manifest.json")}
    assert len(first) == 3

    one_process = two_per_task or ["hydra.launcher.remote.num_cpus=2"]
    words = (*a_class("own.Broken", "stable_baselines3.A2C"), "seed=0,1")
    widened = cluster.sweep(*words, *one_process, cwd=tmp_path)
    assert "1 done, 1 failed; 2 to run" in widened.stderr
    assert Counter(statuses(tmp_path / "sweep").values()) == {"done": 2, "failed": 3}
    assert all(path.read_bytes() == content for path, content in first.items())
    assert list((tmp_path / "sweep").glob(".slurm")) == []

    here = [word for word in cluster.words(*words) if "launcher" not in word]
    assert "0 to run" in script("train.py", *here, cwd=tmp_path).stderr  # they are the same jobs


@pytest.mark.slow
def test_a_signal_gives_its_tasks_up(cluster: Cluster, tmp_path: Path) -> None:
    folder = tmp_path / "sweep"
    with cluster.start("seed=0,1,2", ENDLESS, cwd=tmp_path) as process:
        wait_for(lambda: any(curve_begun(path) for path in folder.glob("*/curve.csv")), "a job", process)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=180)
    assert process.returncode == 130
    assert "stopped by SIGINT; resume with: python " in errors
    assert "Traceback" not in errors
    assert "slurm: scancel" in errors or "tasks cancelled" in errors
    script("jobs.py", "sweep", cwd=tmp_path)
    found = statuses(folder)
    assert "interrupted" in found.values()
    assert set(found.values()) <= {"interrupted", "pending"}
    if cluster.launcher == "slurm":
        assert cluster.slurms("squeue", "--noheader", "--states=PENDING,RUNNING") == ""


@pytest.mark.parametrize("cluster", ["slurm"], indirect=True)
def test_slurms_warning_interrupts_a_job_and_a_restart_has_the_rest(cluster: Cluster, tmp_path: Path) -> None:
    folder = tmp_path / "sweep"
    words = ("total_timesteps=500,100000000,600", "hydra.launcher.jobs_per_task=3")
    with cluster.start(*words, cwd=tmp_path) as process:
        curves = "*=100000000/curve.csv"
        wait_for(lambda: any(curve_begun(path) for path in folder.glob(curves)), "a job", process)
        tasks = cluster.slurms("squeue", "--noheader", "--format=%A").split()
        cluster.slurms("scancel", "--signal=USR2", *tasks)
        _, errors = process.communicate(timeout=180)
    assert process.returncode == 1
    assert list(statuses(folder).values()) == ["done", "interrupted", "pending"]
    assert "the rest did not finish; resume with: python " in errors


@pytest.mark.slow
@pytest.mark.parametrize("cluster", ["slurm"], indirect=True)
def test_what_slurm_refuses_is_one_sentence(cluster: Cluster, tmp_path: Path) -> None:
    done = cluster.sweep("seed=range(150)", cwd=tmp_path)
    assert done.returncode == 2
    assert "hydra/launcher=slurm: Slurm took no array of 150 tasks (" in done.stderr
    assert done.stderr.rstrip().endswith("for fewer tasks, raise hydra.launcher.jobs_per_task")
    nowhere = cluster.sweep("seed=0,1", "hydra.launcher.partition=nowhere", cwd=tmp_path)
    assert nowhere.returncode == 2
    assert "hydra/launcher=slurm: Slurm took no array of 2 tasks (" in nowhere.stderr
    assert "nvalid partition" in nowhere.stderr
