"""Kill sweeps again and again, at random moments: what comes out is what an undisturbed one leaves.

More: GRIDWORLD_KILLS=20 GRIDWORLD_KILLED_JOBS=60 GRIDWORLD_POPULATION_KILLS=100
python -m pytest tests/sweep/test_sweep_kills.py
"""

import csv
import json
import os
import random
import shutil
import subprocess
import time
from pathlib import Path

import pytest
from helpers.resuming import differences, left_behind
from helpers.support import script, start
from helpers.sweeps import rows

from gridworld.commands import jobs as jobs_command
from gridworld.storage.atomic_write import is_locked

KILLS = int(os.environ.get("GRIDWORLD_KILLS", "4"))
JOBS = int(os.environ.get("GRIDWORLD_KILLED_JOBS", "12"))
WORDS = (
    *("-m", "agent=q_learning,dqn,sarsa", f"seed=range({JOBS // 3})", "total_timesteps=3000"),
    *("recording.gif=false", "hydra.sweep.dir=sweep"),
)
OF_THE_CLOCK = ("train_seconds", "evaluation_seconds")


@pytest.mark.slow
def test_a_sweep_that_is_killed_comes_to_the_same(tmp_path: Path) -> None:
    killed, calm = tmp_path / "killed", tmp_path / "calm"
    for folder in (killed, calm):
        folder.mkdir()
    chance = random.Random(0)
    done: dict[str, bytes] = {}
    at_work = 0
    for kill in range(KILLS):
        launcher = ("basic", "joblib", "forks", "forks")[kill % 4]
        at_work += kill_after(chance.randrange(JOBS // KILLS), chance.uniform(0, 0.3), killed, launcher)
        done = check_what_is_left(killed / "sweep", done)
        print(f"kill {kill}: {len(done)} done")
    assert at_work > KILLS / 2
    last = script("train.py", *WORDS, cwd=killed)
    assert last.returncode == 0, last.stderr
    assert check_what_is_left(killed / "sweep", done).keys() == results(killed / "sweep").keys()

    assert script("train.py", *WORDS, cwd=calm).returncode == 0
    assert len(results(calm / "sweep")) == JOBS
    assert results(killed / "sweep") == results(calm / "sweep")
    assert list((killed / "sweep").rglob(".*.part")) == []


def kill_after(jobs: int, seconds: float, cwd: Path, launcher: str) -> bool:
    """Kill so long after that many more jobs have begun; whether the sweep was still running."""

    def begun() -> int:
        return len(list(cwd.glob("sweep/*/manifest.json")))

    enough = min(begun() + jobs, JOBS)
    with start("train.py", *WORDS, f"hydra/launcher={launcher}", cwd=cwd) as process:
        while process.poll() is None and begun() < enough:
            time.sleep(0.02)
        time.sleep(seconds)
        at_work = process.poll() is None
        process.kill()
    return at_work


def check_what_is_left(sweep: Path, before: dict[str, bytes]) -> dict[str, bytes]:
    """The table is right, and what was done is as it was; returns what is done now."""
    if not (sweep / "sweep.json").exists():
        return before
    end = time.monotonic() + 20
    while any(is_locked(path) for path in sweep.glob("*/.lock")):
        assert time.monotonic() < end, "a worker outlives its sweep"
        time.sleep(0.05)
    jobs_command.main([str(sweep)])
    with (sweep / "jobs.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == JOBS
    done = {}
    for row in rows:
        manifest = sweep / row["job"] / "manifest.json"
        status = json.loads(manifest.read_text())["status"] if manifest.exists() else None
        expected = {"finished": "done", None: "pending"}.get(status, "interrupted")
        assert row["status"] == expected
        if status == "finished":
            done[row["job"]] = manifest.read_bytes()
    assert before.items() <= done.items()  # a job that is done is not run again: its manifest has the time
    return done


def results(sweep: Path) -> dict[str, tuple[object, ...]]:
    """What the jobs came to, but for the seconds that they took."""
    found = {}
    for summary_file in sweep.glob("*/summary.json"):
        summary = {k: v for k, v in json.loads(summary_file.read_text()).items() if k not in OF_THE_CLOCK}
        folder = summary_file.parent
        files = sorted(
            p.relative_to(folder).as_posix() for p in folder.rglob("*") if "tfevents" not in p.name
        )
        pictures = [(folder / name).read_bytes() for name in files if name.endswith((".png", "curve.csv"))]
        found[folder.name] = (summary, files, pictures, len(list(folder.glob("*tfevents*"))))
    return found


POPULATION_KILLS = int(os.environ.get("GRIDWORLD_POPULATION_KILLS", "8"))
EVERY = 256  # steps: checkpoints
RUNS = (
    *("n_envs=16", "total_timesteps=1536", "evaluation.every=512", "agent.batch_size=64"),
    *("agent.log_interval=1", "recording.gif=false", "recording.frames=false", "logging.progress=false"),
)


def train_all(name: str, *words: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    return script("train.py", "-m", *words, f"hydra.sweep.dir={name}", cwd=cwd)


def saved(sweep: Path) -> int:
    """How many checkpoints its runs have come to."""
    steps: dict[Path, int] = {}
    for path in sweep.glob("*/checkpoints/*.state"):
        steps[path.parent] = max(steps.get(path.parent, 0), int(path.stem))
    return sum(steps.values()) // EVERY


@pytest.mark.slow
@pytest.mark.parametrize(("agent", "seeds"), [("ppo", 6), ("dqn", 3)])
def test_a_population_that_is_killed_comes_to_the_same(agent: str, seeds: int, tmp_path: Path) -> None:
    words = (
        f"agent={agent}",
        f"seed=range({seeds})",
        *RUNS,
        f"checkpoint.every={EVERY}",
        f"evaluation.every={EVERY}",
    )
    assert train_all("calm", *words, "hydra.sweeper.population=1", cwd=tmp_path).returncode == 0
    calm = {run.parent.name: left_behind(run.parent) for run in tmp_path.glob("calm/*/summary.json")}
    assert len(calm) == seeds
    chance, kills, folder = random.Random(agent), 0, tmp_path / "killed"
    most = -(-POPULATION_KILLS // 2)

    def check() -> None:
        assert {run: row["status"] for run, row in rows(folder).items()} == dict.fromkeys(calm, "done")
        for run, expected in calm.items():
            assert differences(left_behind(folder / run), expected) == []
        assert list(folder.rglob(".*.part")) == []
        shutil.rmtree(folder)

    while kills < most:
        # A run has six checkpoints: a sweep is killed about ten times before it comes to its end.
        enough = saved(folder) + chance.randrange(1 + seeds)
        with start("train.py", "-m", *words, "hydra.sweep.dir=killed", cwd=tmp_path) as process:
            while process.poll() is None and saved(folder) < enough:
                time.sleep(0.01)
            time.sleep(chance.uniform(0, 0.3))
            kills += process.poll() is None
            process.kill()
        if process.returncode == 0:
            check()
    assert train_all("killed", *words, cwd=tmp_path).returncode == 0
    check()


@pytest.mark.slow
def test_the_memory_of_a_long_sweep_stays_flat(tmp_path: Path) -> None:
    words = ("-m", "agent=ppo", "seed=range(40)", *RUNS, "total_timesteps=512", "hydra.sweeper.population=4")
    sizes: dict[int, int] = {}  # bytes, by the number of runs that are done
    with start("train.py", *words, "hydra.sweep.dir=long", cwd=tmp_path) as process:
        while process.poll() is None:
            done = len(list(tmp_path.glob("long/*/summary.json")))
            try:
                pages = int(Path(f"/proc/{process.pid}/statm").read_text().split()[1])
            except (OSError, IndexError):
                break
            if pages:
                sizes[done] = max(sizes.get(done, 0), pages * os.sysconf("SC_PAGE_SIZE"))
            time.sleep(0.02)
        assert process.wait(60) == 0
    early = max(size for done, size in sizes.items() if done <= 20)
    late = max(size for done, size in sizes.items() if 20 < done < 40)  # then come means over seeds
    assert max(sizes) == 40
    assert late - early < 11 * 2**20, sizes
