"""What a run leaves beside its result: the best model, evaluations.npz, train.log, error.txt."""

import csv
import json
import logging
import os
import signal
import warnings
from pathlib import Path

import numpy as np
import pytest
from helpers.resuming import begin, go_on
from helpers.support import NO_FILES, SHORT, script
from stable_baselines3 import DQN

from gridworld.base.errors import InputError
from gridworld.base.signals import Interrupted
from gridworld.commands import evaluate, play, record
from gridworld.report.playground.page import world_page
from gridworld.training import session
from gridworld.training.learning_curve import LearningCurve
from gridworld.training.saved_run import SavedRun

# It is optimal on the way and no more at the end, at which it explores still.
FORGETFUL = ["agent=q_learning", "total_timesteps=3000", "n_envs=1", "evaluation.every=250", "env.slip=0.2"]
FORGETFUL += ["agent.learning_rate=0.9", *NO_FILES]


@pytest.fixture(scope="module")
def forgetful(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("forgetful") / "run"
    begin(folder, *FORGETFUL)
    return folder


@pytest.fixture(scope="module")
def deep(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("deep") / "run"
    few = ["n_envs=128", "agent.batch_size=128", "agent.exploration_final_eps=0.05", "exploring_starts=0"]
    few += ["agent.target_update_interval=512", "agent.learning_rate=0.01", "agent.gamma=0.9"]
    few += ["stratified_draws=false"]
    begin(folder, *SHORT["dqn"], "env=frozen_lake_4x4", "evaluation.every=200", *few)
    return folder


def curve(folder: Path) -> dict[str, np.ndarray]:
    with (folder / "curve.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    return {name: np.array([float(row[name] or "nan") for row in rows]) for name in rows[0]}


@pytest.mark.parametrize("kind", ["forgetful", "deep"])
def test_the_best_model_is_that_of_the_lowest_regret(kind: str, request: pytest.FixtureRequest) -> None:
    folder: Path = request.getfixturevalue(kind)
    columns = curve(folder)
    regret = np.where(columns["certified"] == 1, 0.0, columns["regret"])
    first = int(regret.argmin())
    summary = json.loads((folder / "summary.json").read_text())
    assert 0 < first < len(regret) - 1, regret
    assert summary["best_step"] == columns["step"][first]
    assert summary["best_regret"] == regret[first]
    saved = SavedRun(folder, best=True)
    assert saved.steps() == summary["best_step"]
    greedy = np.eye(4)[saved.snapshot().greedy]
    score = saved.evaluator().score(greedy)
    assert score.value == columns["value"][first]
    last = SavedRun(folder)
    assert last.steps() != saved.steps()
    assert last.snapshot().values.tolist() != saved.snapshot().values.tolist()
    if kind == "deep":  # an ordinary file of SB3
        assert DQN.load(folder / "best_model.zip", device="cpu").num_timesteps == saved.steps()


def test_evaluations_as_sb3_writes_them(forgetful: Path) -> None:
    columns, found = curve(forgetful), np.load(forgetful / "evaluations.npz")
    assert sorted(found) == ["ep_lengths", "results", "successes", "timesteps"]
    assert np.array_equal(found["timesteps"], columns["step"])
    assert found["timesteps"].dtype == np.int64
    for name, column in (("results", "return"), ("ep_lengths", "length"), ("successes", "goal_probability")):
        assert np.array_equal(found[name], columns[column][:, None]), name


def test_the_commands_take_the_best(
    forgetful: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = str(forgetful)
    best = json.loads((forgetful / "summary.json").read_text())["best_step"]
    evaluate.main([run, "--best", "--episodes", "10"])
    shown = capsys.readouterr().out
    assert shown.startswith(f"greedy policy of {run} (best model, step {best:,}) on classic\n")
    evaluate.main([run, "--episodes", "10"])
    assert capsys.readouterr().out.splitlines()[1:] != shown.splitlines()[1:]
    for name, words in (("best", ["--best"]), ("last", [])):
        record.main([run, *words, "--format", "policy", "--out", str(tmp_path / name)])
    assert (tmp_path / "best" / "policy.png").read_bytes() != (tmp_path / "last" / "policy.png").read_bytes()
    with pytest.raises(InputError, match=r"^--best: chooses between the models of a run; add --agent RUN$"):
        play.main(["--best"])


def log(folder: Path) -> list[str]:
    """The lines without their times."""
    return [line.partition(" ")[2] for line in (folder / "train.log").read_text().splitlines()]


def test_the_log_has_the_warnings_of_each_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    evaluate_first = LearningCurve.evaluate

    def warning(self: LearningCurve, step: int) -> object:
        warnings.warn(f"strange\n at {min(step, 1)}", stacklevel=1)
        return evaluate_first(self, step)

    monkeypatch.setattr(LearningCurve, "evaluate", warning)
    monkeypatch.setattr(logging.getLogger(), "handlers", [])  # pytest's
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        for name in ("one", "two"):
            begin(tmp_path / name, *SHORT["q_learning"])
    for name in ("one", "two"):
        _, first, second, *_ = log(tmp_path / name)
        assert first.startswith("WARNING ")
        assert "UserWarning: strange\\n at 0" in first
        assert "UserWarning: strange\\n at 1" in second
    assert capsys.readouterr().err.count("UserWarning: strange") == 4  # as without a log


def test_an_interruption_is_in_the_log_and_goes_on(
    forgetful: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C at a step; the run ends with the same best model and evaluations."""
    step = session.Session._on_step

    def interrupted(self: session.Session, steps: int) -> bool:
        if steps == 1500:
            os.kill(os.getpid(), signal.SIGINT)
        return step(self, steps)

    with monkeypatch.context() as patched:
        patched.setattr(session.Session, "_on_step", interrupted)
        with pytest.raises(Interrupted):
            begin(tmp_path, *FORGETFUL)
    assert log(tmp_path)[-1].startswith("INFO stopped by SIGINT: all 1,500 steps are saved; resume with  ")
    assert np.load(tmp_path / "evaluations.npz")["timesteps"].tolist() == list(range(0, 1501, 250))
    go_on(tmp_path)
    assert [line.split(":")[0] for line in log(tmp_path)[2:-1]] == [f"INFO {tmp_path}"]
    assert log(tmp_path)[-1] == log(forgetful)[-1] == "INFO finished after 3,000 steps"
    assert len(log(forgetful)) == 2  # with its beginning
    assert not (forgetful / "error.txt").exists()
    for name in ("best_model.zip", "evaluations.npz"):
        assert (tmp_path / name).read_bytes() == (forgetful / name).read_bytes()


def test_a_bug_leaves_its_traceback(tmp_path: Path) -> None:
    (tmp_path / "broken.py").write_text(
        "from stable_baselines3 import A2C\n\n\nclass Broken(A2C):\n    def train(self):\n        1 / 0\n"
    )
    words = [*SHORT["a2c"], "agent.algorithm=broken.Broken", "hydra.run.dir=run"]
    ended = script("train.py", *words, cwd=tmp_path, PYTHONPATH=str(tmp_path))
    assert ended.returncode == 1
    assert "in train\n    1 / 0\n" in ended.stderr
    assert "in train\n    1 / 0\n" in (tmp_path / "run" / "error.txt").read_text()
    assert log(tmp_path / "run")[-1] == "ERROR failed: ZeroDivisionError: division by zero"
    (tmp_path / "broken.py").write_text("from stable_baselines3 import A2C as Broken\n")
    script("train.py", "resume=run", "trust=true", "anyway=true", cwd=tmp_path, PYTHONPATH=str(tmp_path))
    assert not (tmp_path / "run" / "error.txt").exists()
    assert log(tmp_path / "run")[-1] == "INFO finished after 512 steps"


def test_ends_of_a_map_stay_with_the_run(tmp_path: Path) -> None:
    file, folder = tmp_path / "bridge.txt", tmp_path / "run"
    file.write_text("A=10 B=-100\n#BBBBB#\nDS...FA\n#BBBBB#")
    few = ["agent=q_learning", "total_timesteps=600", "n_envs=1", "evaluation.every=200", *NO_FILES]
    begin(folder, *few, f"env.layout={file}", "env.rewards={D: 1, B: -50}")
    file.unlink()
    go_on(folder, 1200)
    saved = SavedRun(folder)
    assert saved.steps() == 1200
    assert saved.mdp.text() == "A=10 B=-50 D=1\n#BBBBB#\nDS....A\n#BBBBB#"
    assert saved.evaluator().solution.v[7:14].max() == pytest.approx(10)
    other = tmp_path / "other.txt"
    other.write_text("#BBBBB#\nA...S.D\n#BBBBB#")
    with pytest.raises(InputError, match=r"other.txt: row 2, column 1: unknown tile 'A'"):
        saved.evaluator(str(other))
    other.write_text("A=2\n" + other.read_text())
    assert saved.evaluator(str(other)).mdp.text().startswith("A=2 B=-50 D=1\n")
    assert '"tables"' in world_page(saved.mdp, 0.99, 100)  # which a link has no room for
