"""Kill sweeps again and again, at random moments: what comes out is what an undisturbed one leaves.

More: GRIDWORLD_KILLS=100 python -m pytest tests/sweep/test_sweep_kills.py
"""

import json
import os
import random
import shutil
import time
from pathlib import Path

import pytest
from helpers.resuming import differences, left_behind
from helpers.support import script, start
from helpers.sweeps import rows

from gridworld.base.atomic_write import is_locked
from gridworld.commands import jobs as jobs_command

KILLS = int(os.environ.get("GRIDWORLD_KILLS", "4"))
EVERY = 256  # steps: checkpoints
SHORT = (
    *("n_envs=16", "total_timesteps=1536", "evaluation.every=512", "agent.batch_size=64"),
    *("agent.log_interval=1", "recording.gif=false", "recording.frames=false", "logging.progress=false"),
)
SAVED = (*SHORT, f"checkpoint.every={EVERY}", f"evaluation.every={EVERY}")
OF_EACH = ("agent=q_learning,dqn,sarsa", "seed=range(4)", "recording.gif=false", "total_timesteps=3000")
CASES = {  # the jobs, their number, and the launchers in turn
    "of each": ((*OF_EACH, "checkpoint.every=500"), 12, ("basic", "joblib", "forks")),
    "ppo": (("agent=ppo", "seed=range(6)", *SAVED), 6, ("forks",)),
}


def progress(sweep: Path) -> int:
    """How many runs have begun, and how many checkpoints they have come to."""
    steps: dict[Path, int] = {}
    for path in sweep.glob("*/checkpoints/*.state"):
        steps[path.parent] = max(steps.get(path.parent, 0), int(path.stem))
    return len(list(sweep.glob("*/manifest.json"))) + sum(steps.values()) // EVERY


def check_what_is_left(sweep: Path, before: dict[str, bytes]) -> dict[str, bytes]:
    """No worker is left, the table is right, and what was done is as it was; returns what is done now."""
    if not (sweep / "sweep.json").exists():
        return before
    end = time.monotonic() + 180
    while any(is_locked(path) for path in sweep.glob("*/.lock")):
        assert time.monotonic() < end, "a worker outlives its sweep"
        time.sleep(0.05)
    (sweep / "jobs.csv").write_text("nonsense\n")  # it is made again
    jobs_command.main([str(sweep)])
    done = {}
    for job, row in rows(sweep).items():
        manifest = sweep / job / "manifest.json"
        status = json.loads(manifest.read_text())["status"] if manifest.exists() else None
        assert row["status"] == {"finished": "done", None: "pending"}.get(status, "interrupted")
        if status == "finished":
            done[job] = manifest.read_bytes()
    assert before.items() <= done.items()  # a job that is done is not run again: its manifest has the time
    return done


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_a_sweep_that_is_killed_comes_to_the_same(case: str, tmp_path: Path) -> None:
    words, count, launchers = CASES[case]
    words = ("-m", *words)
    calm_words = (*words, "hydra.sweep.dir=calm", "hydra.sweeper.population=1")
    assert script("train.py", *calm_words, cwd=tmp_path).returncode == 0
    calm = {run.parent.name: left_behind(run.parent) for run in tmp_path.glob("calm/*/summary.json")}
    assert len(calm) == count
    chance, kills, folder = random.Random(case), 0, tmp_path / "killed"
    words = (*words, "hydra.sweep.dir=killed")

    def check_all() -> None:
        assert {job: row["status"] for job, row in rows(folder).items()} == dict.fromkeys(calm, "done")
        for run, expected in calm.items():
            assert differences(left_behind(folder / run), expected) == []
        assert list(folder.rglob(".*.part")) == []
        shutil.rmtree(folder)

    done: dict[str, bytes] = {}
    for attempt in range(3 * KILLS):
        if kills == KILLS:
            break
        launcher = launchers[attempt % len(launchers)]
        enough = progress(folder) + chance.randrange(1 + count)
        with start("train.py", *words, f"hydra/launcher={launcher}", cwd=tmp_path) as process:
            while process.poll() is None and progress(folder) < enough:
                time.sleep(0.01)
            time.sleep(chance.uniform(0, 0.3))
            kills += process.poll() is None
            process.kill()
        done = check_what_is_left(folder, done)
        if process.returncode == 0:
            check_all()
            done = {}
    assert kills > KILLS / 2
    assert script("train.py", *words, cwd=tmp_path).returncode == 0
    check_all()


@pytest.mark.slow
def test_the_memory_of_a_long_sweep_stays_flat(tmp_path: Path) -> None:
    words = ("-m", "agent=ppo", "seed=range(40)", *SHORT, "total_timesteps=512")
    sizes: dict[int, int] = {}  # bytes, by the number of runs that are done
    own = ("hydra/launcher=basic", "hydra.sweeper.population=4")  # in the sweep's own process
    with start("train.py", *words, *own, "hydra.sweep.dir=long", cwd=tmp_path) as process:
        while process.poll() is None:
            done = len(list(tmp_path.glob("long/*/summary.json")))
            try:
                pages = int(Path(f"/proc/{process.pid}/statm").read_text().split()[1])
            except (OSError, IndexError):
                break
            if pages:
                sizes[done] = max(sizes.get(done, 0), pages * os.sysconf("SC_PAGE_SIZE"))
            time.sleep(0.02)
        assert process.wait(180) == 0
    early = max(size for done, size in sizes.items() if done <= 20)  # by then garbage is collected
    late = max(size for done, size in sizes.items() if 20 < done < 40)  # then come means over seeds
    assert max(sizes) == 40
    assert late - early < 8 * 2**20, sizes  # of 20 runs; the allocator alone takes up to 6
