"""A training run: what it writes, that it repeats bit for bit, and that it stops when it should."""

import csv
import functools
import gc
import json
import shutil
import sys
import weakref
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.support import NO_FILES, SHORT, configure, train_in
from PIL import Image

from gridworld.agents import Agent
from gridworld.base.errors import InputError
from gridworld.base.safe_read import sealed
from gridworld.envs.training_env import NO_EPISODES, Returns
from gridworld.training.learning_curve import LearningCurve
from gridworld.training.saved_run import SavedRun
from gridworld.training.together import run_together
from gridworld.training.train import train, training
from gridworld.world.chain import one_hot_policy
from gridworld.world.evaluation import Evaluator, PolicySnapshot

FILES = {
    *("manifest.json", "curve.csv", "model.zip", "summary.json", "visits.npy"),
    *("best_model.zip", "evaluations.npz"),
    *("policy.png", "q_error.png", "visits.png", "learning.gif", "frames", "episode.gif"),
}


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """A short run of an agent, for tests that only read it."""

    @functools.cache
    def folder_of(agent: str) -> Path:
        folder = tmp_path_factory.mktemp(agent)
        summary = train_in(folder, *SHORT[agent])
        assert json.loads((folder / "summary.json").read_text()) == json.loads(json.dumps(summary))
        return folder

    return folder_of


@pytest.mark.parametrize("agent", ["dqn", "trpo", "q_learning", "value_iteration"])
def test_a_run_leaves_everything_behind(agent: str, trained: Callable[[str], Path]) -> None:
    folder = trained(agent)
    names = {path.name for path in folder.iterdir()}
    assert names >= FILES
    assert len([name for name in names if name.startswith("events.out.tfevents")]) == 1
    assert names == {name for name in names if not name.startswith(".")}  # nothing half-written
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["optimal_value"] == pytest.approx(0.99**7)

    manifest = json.loads((folder / "manifest.json").read_text())
    assert manifest["status"] == "finished"
    assert manifest["started"] <= manifest["ended"]
    assert manifest["overrides"] == SHORT[agent]
    assert manifest["versions"]["torch"]
    assert manifest["layout"] == ["S.....", "....T.", "...TG.", "....T.", "......"]

    frames = sorted((folder / "frames").iterdir())
    assert [frame.name for frame in frames] == [f"{index:04}.png" for index in range(len(frames))]
    assert len(frames) == round(float(summary["length"])) + 1
    assert Image.open(frames[0]).convert("RGB").size == (800, 700)


def test_the_curve_has_a_row_per_evaluation(tmp_path: Path) -> None:
    train_in(tmp_path, *SHORT["dqn"], "n_envs=10", "evaluation.every=500")
    with (tmp_path / "curve.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["step"]) for row in rows] == [0, 500, 1000, 1500, 2000]
    evaluator = Evaluator(configure().env.compile(), 0.99, 100)
    # DQN is scored as random as it acts before it learns.
    assert float(rows[0]["sampled_value"]) == pytest.approx(evaluator.score(np.full((30, 4), 0.25)).value)
    for row in rows:
        total = sum(float(row[f"{name}_probability"]) for name in ("goal", "trap", "timeout"))
        assert total == pytest.approx(1)
        assert float(row["value"]) + float(row["regret"]) == pytest.approx(evaluator.optimal_value)
        assert float(row["sampled_regret"]) >= 0


@pytest.mark.parametrize(
    "words",
    [
        "dqn env=maze recording.cell_size=7 observation=coordinates",
        "ppo observation=none logging.tensorboard=false logging.policy_map_every=0 recording.gif=false",
        "ppo observation=image agent.policy=CnnPolicy n_envs=8 total_timesteps=500",
        "ppo env=frozen_lake_4x4 agent.policy_kwargs={net_arch:[8],activation_fn:torch.nn.Tanh}",
    ],
)
def test_settings_run_through(words: str, tmp_path: Path) -> None:
    agent, *others = words.split()
    summary = train_in(tmp_path, *SHORT[agent], *others)
    assert 0 <= float(summary["goal_probability"]) <= 1
    assert bool(list(tmp_path.glob("events*"))) == ("logging.tensorboard=false" not in words)
    assert (tmp_path / "episode.gif").exists() == ("recording.gif=false" not in words)
    SavedRun(tmp_path).snapshot()


class Scripted:
    """An agent that is optimal at the evaluations it is told to be, and stands still at the others."""

    learns = True

    def __init__(self, optimal: np.ndarray, pattern: list[bool]) -> None:
        self.optimal = optimal
        self.pattern = iter(pattern)
        self.calls = 0

    def snapshot(self) -> PolicySnapshot:
        greedy = self.optimal if next(self.pattern) else np.zeros_like(self.optimal)
        self.calls += 1
        values = np.full(len(greedy), float(self.calls * self.learns))
        return PolicySnapshot(greedy, one_hot_policy(greedy, 4), values)

    def model_file(self) -> bytes:
        return f"after snapshot {self.calls}".encode()


class Envs:
    """Environments in which episodes with these returns end, and no others."""

    def __init__(self, *returns: Returns) -> None:
        self.returns = iter(returns)

    def take_returns(self) -> Returns:
        return next(self.returns, NO_EPISODES)


def follow(pattern: list[bool], *overrides: str, returns: Any = ()) -> tuple[LearningCurve, list[bool]]:
    config = configure("evaluation.every=10", "logging.progress=false", *overrides)
    evaluator = Evaluator(config.env.compile(), 0.99, 100)
    agent = Scripted(np.argmax(evaluator.optimal_policy(), axis=1), pattern)
    curve = LearningCurve(evaluator, agent, config, Envs(*returns))  # type: ignore[arg-type]
    goes_on = [curve.on_step(10 * (index + 1)) > 0 for index in range(len(pattern))]
    return curve, goes_on


def test_certificates_and_the_best_model() -> None:
    """The first certificate, the streak that holds, and the first model of the lowest regret."""
    curve, goes_on = follow([False, True, False, True, True])
    assert (curve.certificate.first_certified_step, curve.certificate.certified_since_step) == (20, 40)
    assert all(goes_on)
    assert (curve.best.step, curve.best.regret, curve.best.content) == (20, 0.0, b"after snapshot 2")
    curve, _ = follow([True, False])
    assert (curve.certificate.first_certified_step, curve.certificate.certified_since_step) == (10, None)
    curve, _ = follow([False, False])
    assert (curve.best.step, curve.best.content) == (10, b"after snapshot 1")
    assert curve.best.regret == curve.newest.greedy.regret > 0  # type: ignore[union-attr]
    assert curve.newest.greedy.outcome.timeout == 1  # type: ignore[union-attr]
    assert curve.evaluator.endless_states(one_hot_policy(curve.newest.snapshot.greedy, 4)) == [0]  # type: ignore[union-attr]
    _, goes_on = follow([True, False, True, True, True], "evaluation.stop_after=3")
    assert goes_on == [True, True, True, True, False]


def test_one_policy_earns_one_certificate_however_often_it_is_met(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Scripted, "learns", False)
    curve, goes_on = follow([True] * 5, "evaluation.stop_after=2")
    assert (curve.certificate.streak, goes_on) == (1, [True] * 5)


def test_the_model_of_an_evaluation_at_the_end_is_kept_for_a_longer_run() -> None:
    curve, _ = follow([False, True], "total_timesteps=20")
    assert (curve.best.step, curve.best.content) == (10, b"after snapshot 1")
    agent: Any = Scripted(np.zeros(30), [])  # has learned on meanwhile
    longer = LearningCurve(curve.evaluator, agent, configure("total_timesteps=40"), Envs())  # type: ignore[arg-type]
    longer.set_state(curve.get_state())
    longer.write_held_of_shorter_run()
    assert (longer.best.step, longer.best.content) == (20, b"after snapshot 2")


@pytest.mark.parametrize(
    ("total", "step", "episodes"),
    [(100, 25, 2 + 4), (100, 20, 2), (20, 20, 2 + 4), (20, 25, 2 + 4)],
    ids=["early", "due", "held", "after held"],
)
def test_the_last_row_does_not_stand_on_the_few_episodes_since_the_row_before(
    total: int, step: int, episodes: int
) -> None:
    """It has those of the evaluation before too, which a later step would have had in a row of its own."""

    returns = Returns(1, -1.0), Returns(2, -2.0), Returns(4, -4.0)
    curve, _ = follow([False, True], f"total_timesteps={total}", returns=returns)
    curve.agent.pattern = iter([False])  # type: ignore[attr-defined]
    if step > 20:
        curve.on_step(step)
    assert curve.evaluate(step).returns.episodes == episodes


def test_an_endless_walk_at_gamma_1_is_summarised(tmp_path: Path) -> None:
    train_in(tmp_path, *SHORT["dqn"], "env=cliff", "evaluation.gamma=1", "total_timesteps=400")
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["value"] is None or summary["timeout_probability"] == 0


def test_a_finished_run_is_not_overwritten_and_its_manifest_cannot_import_what_it_likes(
    trained: Callable[[str], Path], tmp_path: Path
) -> None:
    shutil.copytree(trained("dqn"), tmp_path / "run")
    before = (tmp_path / "run" / "model.zip").read_bytes()
    with pytest.raises(InputError, match="contains a run already"):
        train_in(tmp_path / "run", *SHORT["dqn"], "seed=1")
    assert (tmp_path / "run" / "model.zip").read_bytes() == before
    manifest = json.loads((tmp_path / "run" / "manifest.json").read_text())
    manifest["config"]["agent"]["policy_kwargs"]["activation_fn"] = "this.Foo"
    (tmp_path / "run" / "manifest.json").write_text(json.dumps(sealed(manifest)))
    with pytest.raises(InputError, match=r"activation_fn=this\.Foo is not from one of torch"):
        SavedRun(tmp_path / "run")
    assert "this" not in sys.modules


@pytest.mark.parametrize("stop", [SystemExit(143), KeyboardInterrupt()])
def test_a_signal_while_the_runs_files_are_opened_interrupts_it(
    stop: BaseException, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A sweep's worker and the scripts handle signals themselves until the session does."""

    def opening(*arguments: object) -> None:
        raise stop

    with monkeypatch.context() as patched:
        patched.setattr("gridworld.training.session.AppendLog", opening)
        with pytest.raises(type(stop)):
            train_in(tmp_path, *SHORT["q_learning"])
    assert json.loads((tmp_path / "manifest.json").read_text())["status"] == "interrupted"


@pytest.mark.slow
@pytest.mark.parametrize("agent", ["dqn", "ppo", "q_learning", "sarsa", "expected_sarsa", "value_iteration"])
def test_the_default_job_is_certified(agent: str, tmp_path: Path) -> None:
    """On five seeds, which train together: each run is what it is alone, see engine/test_populations.py."""
    for seed in range(5):
        (tmp_path / str(seed)).mkdir()
    configs = [configure(f"agent={agent}", f"seed={seed}", *NO_FILES) for seed in range(5)]
    summaries = run_together([training(config, tmp_path / str(config.seed), []) for config in configs])
    assert len(summaries) == 5
    for seed, summary in enumerate(summaries):
        assert isinstance(summary, dict), summary
        assert summary["certified"], seed
        assert summary["goal_probability"] == 1
        assert summary["length"] == 8
        assert int(summary["first_certified_step"]) <= int(summary["certified_since_step"])


@pytest.mark.parametrize("words", [["dqn"], ["q_learning"], ["ppo", "agent.engine=stock"]], ids=str)
def test_a_runs_memory_is_freed_when_it_ends(tmp_path: Path, words: list[str]) -> None:
    """Not when the garbage collector comes by: a sweep's runs would pile up until then."""
    config = configure(*SHORT[words[0]], *words[1:], *NO_FILES, "total_timesteps=640")
    held: list[weakref.ref[Agent]] = []
    gc.collect()
    gc.disable()
    try:
        for folder in (tmp_path / "first", tmp_path / "second"):  # a first one imports what others have
            folder.mkdir()
            train(config, folder, [], on_built=lambda agent: held.append(weakref.ref(agent)))
    finally:
        gc.enable()
    assert held[1]() is None
