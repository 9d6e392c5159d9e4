"""The commands on worlds that are no maps: train, look, go on, repeat, sweep, report."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from helpers.support import script
from PIL import Image

from gridworld.training.saved_run import SavedRun
from gridworld.world.sources.environment import compile_id

TRAINED = (
    *("agent=q_learning", "env=frozen_lake_v1", "env.kwargs.is_slippery=false"),
    *("evaluation.every=1000", "tuned=none", "recording.frames=false", "recording.learning=false"),
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sweep of two runs over 2,000 steps, and the first of them over 4,000 at once and by going on."""
    folder = tmp_path_factory.mktemp("worlds")
    few = (*TRAINED, "total_timesteps=2000")
    for words in (
        ("-m", *few, "seed=0,1", "hydra.sweep.dir=sweep", "recording.gif=false"),
        (*few, "hydra.run.dir=short"),
        (*few, "hydra.run.dir=longer", "checkpoint.every=500"),
        ("resume=longer", "total_timesteps=4000"),
    ):
        done = script("train.py", *words, cwd=folder)
        assert done.returncode == 0, done.stderr
    return folder


@pytest.mark.slow
def test_a_run_keeps_its_world(folder: Path) -> None:
    saved = SavedRun(folder / "short")
    made = compile_id("FrozenLake-v1", {"is_slippery": False})
    assert saved.mdp.text() == made.text()
    assert saved.mdp.max_episode_steps == 100
    for name in ("next_state", "probability", "reward", "terminal", "goal", "start", "thresholds", "places"):
        assert np.array_equal(getattr(saved.mdp, name), getattr(made, name)), name
    summary = json.loads((folder / "short" / "summary.json").read_text())
    assert (summary["env"], summary["max_episode_steps"]) == ("FrozenLake-v1", 100)
    assert summary["optimal_value"] == pytest.approx(0.99**5)


def test_a_run_goes_on_in_the_world_that_it_keeps(folder: Path) -> None:
    curve = (folder / "longer" / "curve.csv").read_text().splitlines()
    assert curve[-1].startswith("4000,")
    assert curve[:3] == (folder / "short" / "curve.csv").read_text().splitlines()[:3]


@pytest.mark.parametrize("trust", [True, False])
def test_the_environment_of_a_run_is_made_with_trust_only(trust: bool, folder: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(folder / "longer", run)
    sizes = {}
    for words, film in (
        (["record.py", "run", "--format", "gif", *["--trust"] * trust], "recording/episode.gif"),
        (["train.py", "resume=run", "total_timesteps=4500", *["trust=true"] * trust], "episode.gif"),
    ):
        done = script(*words, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        told = "the episode is drawn from the run's tables; FrozenLake-v1 itself is only drawn with trust"
        assert (told in done.stderr) == (not trust)
        with Image.open(run / film) as picture:
            sizes[film] = picture.size
    assert ((256, 304) in sizes.values()) == trust  # of its own frames, with captions below
    assert len(set(sizes.values())) == 1


def test_a_run_is_repeated_scored_shown_and_reported(folder: Path) -> None:
    for line, told in (
        ("reproduce.py short", "identical\n"),
        ("evaluate.py short --episodes 50", "greedy policy of"),
        ("record.py short --format gif policy", "episode.gif"),
        ("report.py sweep --formats svg", "report.html"),
    ):
        done = script(*line.split(), cwd=folder)
        assert done.returncode == 0, done.stderr
        assert told in done.stdout
        assert "which this version does not know" not in done.stdout + done.stderr
    assert (folder / "short" / "recording" / "episode.gif").stat().st_size > 1000
    assert "FrozenLake-v1" in (folder / "sweep" / "report" / "report.html").read_text()
    done = script("evaluate.py", "short", "--layout", "maze", cwd=folder)
    assert done.returncode == 2
    assert "was trained on FrozenLake-v1, not a map" in done.stderr
