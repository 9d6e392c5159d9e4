"""Populations that are killed at random moments, and the memory of a long sweep of them.

More: GRIDWORLD_POPULATION_KILLS=100 python -m pytest tests/sweep/test_population_kills.py
"""

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

POPULATION_KILLS = int(os.environ.get("GRIDWORLD_POPULATION_KILLS", "20"))
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
@pytest.mark.parametrize(("agent", "seeds"), [("ppo", 10), ("dqn", 4)])
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
