"""`gridworld.sweep`, `open_sweep`, `record` and `tune`: the commands, without a command line."""

import csv
import os
import re
import signal
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from helpers.support import NO_FILES
from PIL import Image

import gridworld
from gridworld import InputError

SMALL = ("total_timesteps=600", "evaluation.every=200", *NO_FILES)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("sweeps") / "two agents"


@pytest.fixture(scope="module")
def swept(folder: Path) -> gridworld.SweepResult:
    """Of four jobs, two of which fail."""
    words = ["agent=q_learning,sarsa", {"env.slip": [0.1, 2]}]
    return gridworld.sweep(*words, *SMALL, seed=range(1), folder=folder, progress=False)


def test_a_sweep_is_the_commands(swept: gridworld.SweepResult, folder: Path) -> None:
    assert repr(swept) == f"SweepResult({str(folder)!r}, 4 jobs: 2 done, 2 failed)"
    with (folder / "jobs.csv").open() as file:
        of_command = list(csv.DictReader(file))
    assert [row["status"] for row in swept.rows] == [row["status"] for row in of_command]
    assert [(row["agent"], row["env.slip"], row["seed"]) for row in swept.rows] == [
        *(("q_learning", 0.1, 0), ("q_learning", 2, 0), ("sarsa", 0.1, 0), ("sarsa", 2, 0))
    ]
    alone = gridworld.train("agent=sarsa", "env.slip=0.1", *SMALL)
    assert swept.rows[2]["value"] == alone.summary["value"] == swept.runs[1].summary["value"]
    assert "slip" in swept.rows[1]["error"]
    assert repr(gridworld.open_sweep(folder)) == repr(swept)


def test_what_a_sweep_shows(swept: gridworld.SweepResult, monkeypatch: pytest.MonkeyPatch) -> None:
    html = swept._repr_html_()
    assert "4 jobs: 2 done, 2 failed" in html
    assert "q_learning" in html
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(InputError, match="needs pandas, which is not installed; `rows` has the same"):
        _ = swept.table
    monkeypatch.setitem(sys.modules, "pandas", SimpleNamespace(DataFrame=list))
    assert swept.table == swept.rows


@pytest.mark.slow
def test_a_sweeps_report(swept: gridworld.SweepResult, folder: Path) -> None:
    assert swept.report() == folder / "report" / "report.html"
    assert "sarsa" in (folder / "report" / "report.html").read_text()


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["agent=dqnn,ppo"], "did you mean dqn or qrdqn?"),
        (["agent"], "agent: is not an override; write KEY=VALUE"),
        (["hydra.sweep.dir=x"], "here the folder is given by folder="),
        ([{"agent.gamma": {1}}], "agent.gamma: must be plain values, has a set"),
    ],
)
def test_mistakes_in_a_sweep(
    words: list[str], sentence: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(InputError, match=re.escape(sentence)) as told:
        gridworld.sweep(*words, folder=tmp_path / "sweep")
    assert "\n" not in str(told.value)
    assert capfd.readouterr().err == ""
    assert list(tmp_path.iterdir()) == []


def test_folders_of_something_else(swept: gridworld.SweepResult, folder: Path) -> None:
    run = swept.runs[0].folder
    with pytest.raises(InputError, match="is a run's folder, not a sweep's"):
        gridworld.open_sweep(run or "")
    with pytest.raises(InputError, match="is a sweep"):
        gridworld.open_run(folder)
    with pytest.raises(InputError, match="nowhere: no such folder"):
        gridworld.open_sweep("nowhere")


def test_ctrl_c_ends_a_sweep_that_the_same_call_completes(tmp_path: Path) -> None:
    place = tmp_path / "sweep"
    words = ("agent=q_learning", "seed=0,1", "total_timesteps=3000000", *NO_FILES)

    def press() -> None:
        while not list(place.glob("*/curve.csv")):
            time.sleep(0.05)
        os.kill(os.getpid(), signal.SIGINT)

    presser = threading.Thread(target=press, daemon=True)
    presser.start()
    with pytest.raises(KeyboardInterrupt, match="the same call with this folder does the rest"):
        gridworld.sweep(*words, folder=place, progress=False)
    presser.join()
    statuses = [row["status"] for row in gridworld.open_sweep(place).rows]
    assert "interrupted" in statuses
    assert set(statuses) <= {"interrupted", "pending"}


def test_recordings(tmp_path: Path) -> None:
    run = gridworld.train("agent=q_learning", *SMALL, folder=tmp_path / "run")
    assert gridworld.record(run, "gif", episodes=2, cell_size=20) == tmp_path / "run" / "recording"
    with Image.open(tmp_path / "run" / "recording" / "episode.gif") as film:
        assert film.size[0] < 20 * 10
    with pytest.raises(InputError, match="argument --fps: 0: must be from 1 to 100"):
        gridworld.record(tmp_path / "run", "policy", out=tmp_path / "maps", fps=0)
    with pytest.raises(
        InputError, match=r"has no folder, so that its files are gone; train it with folder=\.\.\."
    ):
        gridworld.record(gridworld.train("agent=value_iteration", progress=False))


@pytest.mark.slow
def test_a_study(tmp_path: Path) -> None:
    few = {"trials": 2, "seeds": 1, "final_seeds": 1, "confirm_seeds": 2, "workers": 1}
    words = ("agent=q_learning", {"tune": few}, *SMALL)
    study = gridworld.tune(*words, folder=tmp_path / "study", progress=False)
    assert len(study.trials) == 2
    assert study.sentence in repr(study)
    found = gridworld.compose(recipe=tmp_path / "study").agent
    assert {f"agent.{key}": getattr(found, key) for key in ("learning_rate",)}.items() <= study.values.items()
