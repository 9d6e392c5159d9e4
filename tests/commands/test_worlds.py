"""The commands on worlds that are no maps: train, look, go on, repeat, sweep, report."""

import json
from pathlib import Path

import numpy as np
import pytest
from helpers.support import script

from gridworld.commands import run
from gridworld.errors import InputError
from gridworld.restore.saved_run import SavedRun
from gridworld.run.reader import read_run
from gridworld.run.stored_world import stored_world
from gridworld.world.sources.gymnasium_table import compile_gymnasium

TRAINED = ("agent=q_learning", "env=frozen_lake_v1", "env.kwargs.is_slippery=false", "evaluation.every=1000")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sweep of two runs over 2,000 steps, and the first of them over 4,000 at once and by going on."""
    folder = tmp_path_factory.mktemp("worlds")
    few = (*TRAINED, "total_timesteps=2000")
    for words in (
        ("-m", *few, "seed=0,1", "hydra.sweep.dir=sweep", "recording.gif=false", "recording.frames=false"),
        (*few, "hydra.run.dir=short"),
        (*few, "hydra.run.dir=longer", "checkpoint.every=500"),
        ("resume=longer", "total_timesteps=4000"),
    ):
        done = script("train.py", *words, cwd=folder)
        assert done.returncode == 0, done.stderr
    return folder


def test_a_run_keeps_its_world(folder: Path) -> None:
    saved = SavedRun(folder / "short")
    made = compile_gymnasium("FrozenLake-v1", {"is_slippery": False})
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


def test_a_run_is_repeated_scored_and_shown_again(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder)
    run("reproduce", ["short"])
    assert capsys.readouterr().out.endswith("identical\n")
    run("evaluate", ["short", "--episodes", "50"])
    assert "greedy policy of q_learning" in capsys.readouterr().out
    run("record", ["short", "--format", "gif", "policy"])
    assert (folder / "short" / "recording" / "episode.gif").stat().st_size > 1000


def test_a_sweep_ends_with_a_table_and_a_report(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder)
    run("report", ["sweep", "--formats", "svg"])
    assert "which this version does not know" not in capsys.readouterr().err
    page = (folder / "sweep" / "report" / "report.html").read_text()
    assert "FrozenLake-v1" in page


@pytest.mark.parametrize(
    ("command", "words", "told"),
    [
        ("play", ["--agent", "short"], "was trained on FrozenLake-v1, which is no map"),
        ("evaluate", ["short", "--layout", "maze"], "was trained on FrozenLake-v1, which is no map"),
    ],
)
def test_what_only_a_map_has_is_refused(
    command: str, words: list[str], told: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    with pytest.raises(InputError, match=told):
        run(command, words)


def test_a_world_that_was_changed_is_refused(folder: Path, tmp_path: Path) -> None:
    source, then = folder / "short", tmp_path / "run"
    then.mkdir()
    (then / "manifest.json").write_bytes((source / "manifest.json").read_bytes())
    reader, env = read_run(then), SavedRun(source).config.env
    with pytest.raises(InputError, match=r"world\.npz"):
        stored_world(reader, env)
    (then / "world.npz").write_bytes(b"no world")
    with pytest.raises(InputError, match=r"world\.npz"):
        stored_world(reader, env)
