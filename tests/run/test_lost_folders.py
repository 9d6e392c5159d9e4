"""A process whose folder was taken away, and is another's by now, writes nothing more there and says so."""

import os
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.forks import Started
from helpers.resuming import begin
from helpers.support import SHORT, configure, script, start

from gridworld.errors import FolderLostError
from gridworld.run.checkpoints import Checkpoints
from gridworld.run.folder import LOCK, alone_in
from gridworld.run.writer import RunWriter, clear
from gridworld.storage.append_log import AppendLog
from gridworld.storage.atomic_write import (
    locked,
    remove_path,
    write_array,
    write_json,
    write_text,
)
from gridworld.sweep.folder import SweepFolder
from gridworld.sweep.job import run_in_sweep
from gridworld.training.pictures import Pictures
from gridworld.training.together import run_alone
from gridworld.visualization.animation import animation_of_states
from gridworld.visualization.files import save_pngs
from gridworld.world.grid import compile_mdp
from gridworld.world.layout import load

LESS = ["recording.frames=false", "recording.gif=false", "logging.progress=false"]
WORDS = [*SHORT["q_learning"], *LESS, "checkpoint.every=600"]
TOLD = r"is no longer this process's, .lock in it was removed or replaced"


def content(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def stranger(tmp_path: Path) -> Path:
    """A run of somebody else's, of other settings."""
    begin(tmp_path / "stranger", *WORDS, "seed=7")
    (tmp_path / "stranger" / LOCK).touch()
    return tmp_path / "stranger"


def taken_over(folder: Path, stranger: Path) -> None:
    shutil.rmtree(folder)
    shutil.copytree(stranger, folder)


POINTS: dict[str, tuple[Any, str]] = {
    "after a checkpoint": (Checkpoints, "save"),
    "while pictures are drawn": (Pictures, "finish"),
    "before the results": (RunWriter, "settle"),
}


@pytest.mark.parametrize("point", POINTS)
def test_a_run_that_lost_its_folder_leaves_the_new_one_alone(
    point: str, stranger: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    owner, name = POINTS[point]
    original, folder = getattr(owner, name), tmp_path / "run"

    def then_taken_over(*arguments: Any, **options: Any) -> None:
        original(*arguments, **options)
        if not (folder / "stranger").exists():
            taken_over(folder, stranger)
            (folder / "stranger").touch()

    monkeypatch.setattr(owner, name, then_taken_over)
    folder.mkdir()
    with pytest.raises(FolderLostError, match=TOLD), alone_in(folder):
        begin(folder, *WORDS)
    assert content(folder) == {**content(stranger), "stranger": b""}


def writers(folder: Path) -> list[Callable[[], Any]]:
    mdp = compile_mdp(load("classic"))
    journal = AppendLog(folder / "open.csv")
    return [
        lambda: write_text(folder / "a", "a"),
        lambda: write_json(folder / "a", {}, durable=True),
        lambda: write_array(folder / "deeper" / "a", np.zeros(1)),
        lambda: save_pngs(animation_of_states(mdp, np.zeros(1, dtype=int), 20), folder / "frames"),
        lambda: AppendLog(folder / "curve.csv"),
        journal.sync,
        journal.close,
        lambda: Checkpoints(folder).save(1, {}),
        lambda: remove_path(folder / "mine"),
        lambda: SweepFolder(folder).write({}),
        lambda: locked(folder / "deeper" / LOCK).__enter__(),
        lambda: clear(folder),
        lambda: RunWriter(folder, {}).end("failed"),
    ]


def test_no_writer_writes_to_a_folder_that_was_lost(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    with locked(folder / LOCK):
        all_of_them = writers(folder)
        shutil.rmtree(folder)
        (folder / "deeper").mkdir(parents=True)
        (folder / "mine").write_text("mine")
        (folder / f".x.{os.uname().nodename}.{2**22 + 1}.part").write_text("half")
        before = content(folder)
        for write in all_of_them:
            with pytest.raises(FolderLostError, match=TOLD):
                write()
        assert content(folder) == before
        write_text(tmp_path / "elsewhere", "nobody's")
    write_text(folder / "a", "a")  # it is nobody's now


def test_a_job_that_lost_its_folder_fails_alone(
    stranger: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from gridworld.sweep.job import JobError

    sweep = tmp_path / "sweep"
    job = sweep / "seed=0"
    finish = Pictures.finish

    def then_taken_over(*arguments: Any) -> None:
        finish(*arguments)
        taken_over(job, stranger)

    monkeypatch.setattr(Pictures, "finish", then_taken_over)
    with SweepFolder(sweep).at_work():
        job.mkdir()
        with pytest.raises(JobError, match=TOLD):
            run_alone(run_in_sweep(configure(*WORDS), job, WORDS, stop_at_failure=False))
    assert content(job) == content(stranger)


@contextmanager
def at_work(cwd: Path, *words: str) -> Iterator[Started]:
    with start("train.py", *words, cwd=cwd) as process:
        try:
            yield process
        finally:
            process.kill()


def until(is_so: Callable[[], bool]) -> None:
    end = time.monotonic() + 60
    while not is_so():
        assert time.monotonic() < end
        time.sleep(0.02)


def test_two_commands_in_one_folder(tmp_path: Path) -> None:
    """The first one's folder is deleted while it is at work, and another begins there."""
    curve = tmp_path / "run" / "curve.csv"
    with at_work(tmp_path, "agent=q_learning", "total_timesteps=1000000000", "hydra.run.dir=run") as first:
        until(lambda: curve.exists() and curve.read_text().count("\n") > 3)
        shutil.rmtree(tmp_path / "run", ignore_errors=True)
        shutil.rmtree(tmp_path / "run", ignore_errors=True)
        second = script("train.py", *WORDS, "hydra.run.dir=run", cwd=tmp_path)
        assert second.returncode == 0, second.stderr
        _, told = first.communicate(timeout=60)
    assert first.returncode == 2
    assert told.splitlines()[-1].startswith(
        f"error: {tmp_path}/run: is no longer this process's, .lock in it"
    )
    assert script("reproduce.py", "run", cwd=tmp_path).returncode == 0


def test_a_study_that_lost_its_folder_stops(tmp_path: Path) -> None:
    pytest.importorskip("optuna", reason="optuna is not installed (extra `tune`)")
    from gridworld.tune.study import at_work_in, claim

    folder = tmp_path / "study"
    with at_work_in(folder):
        claim(folder, "mine", {})
        shutil.rmtree(folder)
        folder.mkdir()
        (folder / LOCK).touch()
        with pytest.raises(FolderLostError, match=TOLD):
            claim(folder, "mine", {})
        assert [path.name for path in folder.iterdir()] == [LOCK]
    folder.mkdir(exist_ok=True)
    (folder / f".trials.csv.{os.uname().nodename}.{2**22 + 1}.part").write_text("half")
    with at_work_in(folder):
        assert [path.name for path in folder.iterdir()] == [LOCK]
    assert not folder.exists()
