"""A run whose folder was taken away, and is another's by now, says so and leaves that one alone."""

import contextlib
import shutil
from pathlib import Path
from typing import Any

import pytest
from helpers.resuming import begin
from helpers.support import SHORT, configure, script, start, wait_for

from gridworld.base.errors import FolderLostError
from gridworld.run.checkpoints import Checkpoints
from gridworld.run.folder import alone_in
from gridworld.run.reader import open_run
from gridworld.sweeps.folder import SweepFolder
from gridworld.sweeps.job import run_in_sweep
from gridworld.sweeps.plan import Job
from gridworld.training.pictures import Pictures
from gridworld.training.together import run_alone

LESS = ["recording.frames=false", "recording.gif=false", "logging.progress=false"]
WORDS = [*SHORT["q_learning"], *LESS, "checkpoint.every=600"]
TOLD = r"was deleted or replaced during the run, which stops here"


def content(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def stranger(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of somebody else's, of other settings, which is at work still."""
    folder = tmp_path_factory.mktemp("stranger") / "run"
    begin(folder, *WORDS, "seed=7")
    return folder


@pytest.mark.parametrize(
    ("owner", "name", "is_job"),
    [(Checkpoints, "save", False), (Pictures, "finish", True)],
    ids=["a run, after a checkpoint", "a job, while pictures are drawn"],
)
def test_a_run_that_lost_its_folder_leaves_the_new_one_alone(
    owner: Any, name: str, is_job: bool, stranger: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    original, folder = getattr(owner, name), tmp_path / "run"

    def then_taken_over(*arguments: Any, **options: Any) -> None:
        original(*arguments, **options)
        if not (folder / "stranger").exists():
            shutil.rmtree(folder)
            shutil.copytree(stranger, folder)
            (folder / "stranger").touch()

    monkeypatch.setattr(owner, name, then_taken_over)
    folder.mkdir()
    if is_job:
        with SweepFolder(tmp_path).at_work(), pytest.raises(FolderLostError, match=TOLD):
            run_alone(run_in_sweep(Job(tuple(WORDS), (), "0" * 32, None, configure(*WORDS), folder=folder)))
    else:
        with pytest.raises(FolderLostError, match=TOLD), alone_in(folder):
            begin(folder, *WORDS)
    assert content(folder) == {**content(stranger), "stranger": b""}


def test_two_commands_in_one_folder(tmp_path: Path) -> None:
    """The first one's folder is deleted while it is at work, and another begins there."""
    curve = tmp_path / "run" / "curve.csv"
    words = ("agent=q_learning", "total_timesteps=1000000000", "hydra.run.dir=run")
    with start("train.py", *words, cwd=tmp_path) as first, contextlib.ExitStack() as at_end:
        at_end.callback(first.kill)
        wait_for(lambda: curve.exists() and curve.read_text().count("\n") > 3, "its curve", first)
        shutil.rmtree(tmp_path / "run", ignore_errors=True)
        shutil.rmtree(tmp_path / "run", ignore_errors=True)
        second = script("train.py", *WORDS, "hydra.run.dir=run", cwd=tmp_path)
        assert second.returncode == 0, second.stderr
        _, told = first.communicate(timeout=180)
    assert first.returncode == 2
    assert "was deleted or replaced during the run" in told.splitlines()[-1]
    assert open_run(tmp_path / "run").damage() == {}
