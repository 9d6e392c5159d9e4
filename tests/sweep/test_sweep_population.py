"""Sweeps whose runs train as populations: each run is what it would be alone, whatever others do."""

import errno
import json
import os
import shutil
import signal
import subprocess
from pathlib import Path
from typing import Any

import pytest
from helpers.resuming import begin, begin_all, differences, go_on, left_behind
from helpers.support import script, start, wait_for
from helpers.sweeps import differing, logged, rows
from test_sweep import WORKERS

from gridworld.base.atomic_write import AppendLog
from gridworld.base.errors import InputError
from gridworld.run.checkpoints import Checkpoints
from gridworld.run.folder import claimed
from gridworld.sweeps import plan as plan_module
from gridworld.training.learning_curve import LearningCurve

SMALL = (
    *("n_envs=16", "total_timesteps=1536", "evaluation.every=512", "agent.batch_size=64"),
    *("agent.log_interval=1", "recording.gif=false", "recording.frames=false", "logging.progress=false"),
    "checkpoint.every=512",  # not as the clock says
)
JOBS = ("agent=ppo,dqn", "seed=range(3)", *SMALL)
ALONE = "hydra.sweeper.population=1"


def sweep(name: str, *words: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    return script("train.py", "-m", *words, f"hydra.sweep.dir={name}", cwd=cwd)


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sweep whose runs trained one by one."""
    cwd = tmp_path_factory.mktemp("alone")
    done = sweep("calm", *JOBS, ALONE, cwd=cwd)
    assert done.returncode == 0, done.stderr
    return cwd / "calm"


@pytest.mark.slow
@pytest.mark.parametrize("words", [(), WORKERS])
def test_each_run_is_the_run_alone(words: tuple[str, ...], alone: Path, tmp_path: Path) -> None:
    done = sweep("together", *JOBS, *words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stderr == "sweep together: 6 jobs: 6 pending; 6 to run\n"
    together = tmp_path / "together"
    assert differing(together, alone) == {}
    assert rows(together) == rows(alone)
    assert len(rows(together)) == 6
    assert {path.name for path in together.iterdir()} == {path.name for path in alone.iterdir()}


@pytest.mark.slow
def test_members_that_are_refused_or_diverge_leave_the_others_alone(tmp_path: Path) -> None:
    """A mistake is found before; a rate is refused as training begins, or makes no finite numbers."""
    words = ("agent=dqn", *SMALL, "agent.gradient_steps=1", "agent.learning_rate=1e20,0.001,1e38,-1,0.002")
    for name, more in (("together", ()), ("calm", (ALONE,))):
        done = sweep(name, *words, *more, cwd=tmp_path)
        assert done.returncode == 1, done.stderr
        assert "Traceback" not in done.stderr
    together, calm = rows(tmp_path / "together"), rows(tmp_path / "calm")
    assert [(row["status"], row["error"]) for row in together.values()] == [
        (row["status"], row["error"].replace("calm", "together")) for row in calm.values()
    ]
    assert [row["status"] for row in together.values()] == ["failed", "done", "failed", "failed", "done"]
    assert "training diverged at update" in together["agent.learning_rate=1e+20"]["error"]
    assert differing(tmp_path / "together", tmp_path / "calm") == {}
    assert logged(tmp_path / "together" / "agent.learning_rate=0.001") == [
        "INFO starts: ",
        "INFO finished after 1,536 steps",
    ]


def words_of(seed: int) -> list[str]:
    return ["agent=ppo", *SMALL, f"seed={seed}"]


@pytest.fixture(scope="module")
def calm(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Any]]:
    """What three runs leave that trained one by one."""
    folder = tmp_path_factory.mktemp("calm")
    for seed in range(3):
        begin(folder / str(seed), *words_of(seed))
    return [left_behind(folder / str(seed)) for seed in range(3)]


def test_runs_whose_folder_is_lost_or_full_end_alone(
    calm: list[dict[str, Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """That of seed 3 is taken away, and there is no room for seed 1 once each has a checkpoint."""
    save, append, full, taken = Checkpoints.save, AppendLog.append, tmp_path / "1", tmp_path / "3"

    def taking(self: Checkpoints, *arguments: Any, **options: Any) -> None:
        save(self, *arguments, **options)
        shutil.rmtree(taken, ignore_errors=True)

    def failing(self: AppendLog, *arguments: Any) -> None:
        if full in self.path.parents and list(full.glob("checkpoints/*.state")):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        append(self, *arguments)

    with monkeypatch.context() as patched:
        patched.setattr(Checkpoints, "save", taking)
        patched.setattr(AppendLog, "append", failing)
        ended = begin_all([(tmp_path / str(seed), words_of(seed)) for seed in range(4)])
    assert ended[0]["timesteps"] == ended[2]["timesteps"]
    assert all(isinstance(ended[seed], InputError) for seed in (1, 3))
    assert os.strerror(errno.ENOSPC) in str(ended[1])
    assert "was deleted or replaced during the run" in str(ended[3])
    assert not taken.exists()
    go_on(full)
    for seed in range(3):
        assert differences(left_behind(tmp_path / str(seed)), calm[seed]) == []


@pytest.mark.slow
def test_runs_that_are_certified_end_when_they_would_alone(tmp_path: Path) -> None:
    """With `evaluation.stop_after`; the first to be done is not waited for."""
    words = ["agent=ppo", "env.layout=aima_4x3", *SMALL, "total_timesteps=16384", "evaluation.stop_after=1"]
    words += ["agent.ent_coef=0.01", "seed=range(4)"]
    for name, more in (("together", ()), ("calm", (ALONE,))):
        done = sweep(name, *words, *more, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
    assert differing(tmp_path / "together", tmp_path / "calm") == {}
    manifests = [path.read_text() for path in (tmp_path / "together").glob("*/manifest.json")]
    assert len({json.loads(manifest)["reached"] for manifest in manifests}) > 1


LONG = ("agent=ppo", "seed=range(3)", *SMALL, "total_timesteps=9216", "evaluation.every=3072")


@pytest.fixture(scope="module")
def long_alone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    cwd = tmp_path_factory.mktemp("long")
    assert sweep("calm", *LONG, ALONE, cwd=cwd).returncode == 0
    return cwd / "calm"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "launcher"),
    [(signal.SIGTERM, ()), (signal.SIGINT, ("hydra/launcher=basic",)), (signal.SIGINT, WORKERS)],
    ids=["forks", "one process", "workers"],
)
def test_a_signal_interrupts_all_and_nothing_is_lost(
    number: signal.Signals, launcher: tuple[str, ...], long_alone: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "sweep"
    words = ("-m", *LONG, *launcher, "checkpoint.every=1024", "hydra.sweep.dir=sweep")
    with start("train.py", *words, cwd=tmp_path) as process:
        wait_for(lambda: len(list(folder.glob("*/checkpoints/*.state"))) >= 3, "checkpoints", process)
        os.killpg(process.pid, number)  # as a terminal does on Ctrl-C
        _, errors = process.communicate(timeout=180)
    assert process.returncode == 128 + number, errors
    assert f"stopped by {number.name}; resume with: python " in errors
    assert "Traceback" not in errors
    assert {row["status"] for row in rows(folder).values()} == {"interrupted"}
    ends = [logged(run)[-1] for run in map(folder.joinpath, rows(folder))]
    if launcher != WORKERS:  # workers are ended, and go on from their last checkpoint
        assert all(end.startswith(f"INFO stopped by {number.name}: ") for end in ends), ends
        assert all(" steps are saved; resume with " in end for end in ends), ends
    done = script("train.py", *words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    for run in map(folder.joinpath, rows(folder)):
        assert differences(left_behind(run), left_behind(long_alone / run.name)) == []


def test_a_run_has_as_many_files_open_as_a_population_reckons_with(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    most, evaluate = [], LearningCurve.evaluate

    def counted(*arguments: Any) -> Any:
        paths = [os.path.realpath(f"/proc/self/fd/{file}") for file in os.listdir("/proc/self/fd")]
        most.append(sum(path.startswith(f"{tmp_path}/") for path in paths))
        return evaluate(*arguments)

    monkeypatch.setattr(LearningCurve, "evaluate", counted)
    with claimed(tmp_path / "run"):
        begin(tmp_path / "run", "agent=dqn", *SMALL)
    assert max(most) == plan_module.RUNS_FILES
