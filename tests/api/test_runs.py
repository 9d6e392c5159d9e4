"""`gridworld.train`, `compose` and `open_run`: the commands' results, without a command line."""

import csv
import json
import re
import shutil
import signal
import threading
from pathlib import Path

import hydra
import numpy as np
import pytest
import torch
from helpers.support import CONF, NO_FILES, SHORT, configure, script
from hydra.core.global_hydra import GlobalHydra
from hydra.version import getbase
from omegaconf import OmegaConf
from PIL import Image

import gridworld
from gridworld import InputError
from gridworld.training.session import Session

TIMES = ("train_seconds", "evaluation_seconds")


def timeless(summary: dict[str, object]) -> dict[str, object]:
    return {name: value for name, value in summary.items() if name not in TIMES}


@pytest.mark.slow
@pytest.mark.parametrize("agent", ["dqn", "q_learning"])
def test_bit_for_bit_what_the_command_does(agent: str, tmp_path: Path) -> None:
    words = [*SHORT[agent], "seed=3"]
    done = script("train.py", *words, "hydra.run.dir=theirs", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    theirs = tmp_path / "theirs"
    kept = gridworld.train(*SHORT[agent], seed=3, folder=tmp_path / "mine", progress=False)
    bare = gridworld.train(*SHORT[agent], seed=3, progress=False)

    assert (tmp_path / "mine" / "curve.csv").read_bytes() == (theirs / "curve.csv").read_bytes()
    expected = timeless(json.loads((theirs / "summary.json").read_text()))
    weights = kept.config.agent.weights
    of_command, of_call = (weights(each / "model.zip", 10**8) for each in (theirs, tmp_path / "mine"))
    assert of_command.keys() == of_call.keys()
    assert all(np.array_equal(of_command[name], of_call[name]) for name in of_command)

    opened = gridworld.open_run(theirs)
    for run in (kept, bare, opened):
        assert timeless(run.summary) == expected
        assert np.array_equal(run.policy.greedy, opened.policy.greedy)
        assert np.array_equal(run.policy.q, opened.policy.q)
        assert np.array_equal(run.policy.sampled, opened.policy.sampled)
        assert np.array_equal(run.visits, np.load(theirs / "visits.npy"))
    assert (kept.folder, bare.folder, opened.folder) == (tmp_path / "mine", None, theirs)
    assert bare.config == gridworld.compose(*SHORT[agent], "logging.progress=false", seed=3)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> gridworld.RunResult:
    """Of a table, in a folder."""
    folder = tmp_path_factory.mktemp("api") / "run"
    return gridworld.train(*SHORT["q_learning"], folder=folder, progress=False)


def test_the_folder_is_an_ordinary_run(run: gridworld.RunResult, tmp_path: Path) -> None:
    shutil.copytree(str(run.folder), tmp_path / "mine")
    for command in (["evaluate.py", "mine"], ["report.py", "."], ["reproduce.py", "mine"]):
        done = script(*command, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
    done = script("train.py", "resume=mine", "total_timesteps=4000", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert gridworld.open_run(tmp_path / "mine").summary["timesteps"] >= 4000


def test_without_a_folder_nothing_is_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    run = gridworld.train(*SHORT["q_learning"], progress=False)
    assert list(tmp_path.iterdir()) == []
    assert run.evaluator.score(run.evaluator.optimal_policy()).certified  # nothing more is read


def test_the_curve_has_the_columns_of_the_file(run: gridworld.RunResult) -> None:
    rows = list(csv.DictReader((Path(run.folder or "") / "curve.csv").read_text().splitlines()))
    assert list(run.curve) == list(rows[0])
    for name, column in run.curve.items():
        expected = [float(row[name]) if row[name] else np.nan for row in rows]
        assert np.array_equal(column, expected, equal_nan=True), name
    assert run.curve["step"].dtype == np.int64
    assert run.curve["certified"].dtype == run.curve["sampled_certified"].dtype == np.bool_


def test_what_a_result_has() -> None:
    run = gridworld.train(*SHORT["dqn"], seed=1, progress=False)
    assert run.model.num_timesteps == run.summary["timesteps"]
    assert repr(run) == f"RunResult(dqn on classic, seed 1: {run.summary['timesteps']:,} steps, regret 0.932)"
    before = run.policy.q.copy()
    run.model.learn(600)  # an ordinary model, which goes on learning
    assert np.array_equal(run.policy.q, before)
    table = gridworld.train("agent=value_iteration", progress=False)
    assert table.model.shape == (30, 4)
    assert "certified since step 0" in repr(table)


def test_a_run_shows_itself(run: gridworld.RunResult) -> None:
    figure = run.plot("regret")
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    assert names[:3] == ["greedy", "with exploration", "optimum"]
    drawn = {tuple(line.get_ydata()) for line in figure.axes[0].lines}
    assert tuple(run.curve["regret"]) in drawn
    with pytest.raises(InputError, match="metric='speed': no such curve; choose from value, regret"):
        run.plot("speed")
    with Image.open(Path(run.folder or "") / "policy.png") as picture:
        assert np.array_equal(np.asarray(picture), np.asarray(run.policy_map()))
    html = run._repr_html_()
    assert html.count('<img src="data:image/png;base64,') == 2
    assert "<b>certified optimal since step 2,000</b>" in html
    run.summary["agent"] = "<b>x</b>"
    assert "<b>x</b>" not in run._repr_html_()
    run.summary["agent"] = "q_learning"


def test_settings_are_those_of_the_command_line() -> None:
    words = ["agent=ppo", "env=four_rooms", "seed=3", "agent.gamma=0.9"]
    by_call = gridworld.compose("agent=ppo", {"env": "four_rooms", "agent.gamma": 0.9}, seed=np.int64(3))
    assert by_call == configure(*words)
    nested = gridworld.compose(
        agent="ppo", env={"slip": 0.25, "layout": Path("maze")}, total_timesteps=20_000
    )
    assert (nested.env.slip, nested.env.layout, nested.agent.name) == (0.25, "maze", "ppo")
    widths = gridworld.compose({"agent.policy_kwargs.net_arch": (32, 16), "evaluation.stop_after": None})
    assert list(widths.agent.policy_kwargs.net_arch) == [32, 16]
    schedule = gridworld.compose({"agent.learning_rate": "lin_0.01"}, "logging.progress=false")
    assert (schedule.agent.learning_rate, schedule.logging.progress) == ("lin_0.01", False)


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        (("agent=dnq",), "agent=dnq: no such choice; choose from"),
        (({"agent.gama": 0.9},), "did you mean gamma?"),
        (("seed=1,2",), "seed=1,2: has several values; call gridworld.sweep with them"),
        (("-m",), "-m: is not an override; write KEY=VALUE"),
        (("dqn",), "dqn: is not an override; write KEY=VALUE"),
        (("hydra.run.dir=x",), "here the folder is given by folder="),
        (({"seed": {1, 2}},), "seed: must be plain values, has a set"),
        (({3: 4},), "'3': must be the name of a setting"),
        (({"a b": 4},), "'a b': must be the name of a setting"),
        ((3,), "3: must be an override, such as 'agent=dqn', or a dictionary"),
        (("seed=x",), "seed=x: Value 'x' of type 'str' could not be converted to Integer"),
        (("total_timesteps=0",), "total_timesteps=0: must be at least 1"),
        (("recipe=nowhere.yaml",), "nowhere.yaml"),
    ],
)
def test_mistakes_are_told_in_one_sentence(given: tuple[object, ...], sentence: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=re.escape(sentence)) as told:
        gridworld.train(*given, folder=tmp_path / "run", progress=False)  # type: ignore[arg-type]
    assert "\n" not in str(told.value)
    assert list(tmp_path.iterdir()) == []


def test_folders_that_cannot_be_used(tmp_path: Path) -> None:
    gridworld.train("agent=value_iteration", folder=tmp_path / "run", progress=False)
    with pytest.raises(InputError, match="contains a run already; choose another folder"):
        gridworld.train("agent=value_iteration", folder=tmp_path / "run", progress=False)
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="choose another folder"):
        gridworld.train("agent=value_iteration", folder=tmp_path / "file" / "run", progress=False)
    with pytest.raises(InputError, match="no such folder"):
        gridworld.open_run(tmp_path / "none")


def test_ctrl_c_leaves_a_run_that_the_same_call_goes_on_with(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words, handler = SHORT["dqn"], signal.getsignal(signal.SIGINT)
    on_step = Session._on_step

    def press(session: Session, steps: int) -> bool:
        if 1000 <= steps < 1100:
            signal.raise_signal(signal.SIGINT)
        return on_step(session, steps)

    with monkeypatch.context() as patch:
        patch.setattr(Session, "_on_step", press)
        with pytest.raises(KeyboardInterrupt, match="make the same call to resume"):
            gridworld.train(*words, folder=tmp_path / "run", progress=False)
        with pytest.raises(KeyboardInterrupt):
            gridworld.train(*words, progress=False)
    assert signal.getsignal(signal.SIGINT) is handler
    manifest = json.loads((tmp_path / "run" / "manifest.json").read_text())
    assert (manifest["status"], manifest["checkpoint"]) == ("interrupted", manifest["reached"])
    with pytest.raises(InputError, match="contains an unfinished run with other settings"):
        gridworld.train(*words, seed=5, folder=tmp_path / "run", progress=False)

    continued = gridworld.train(*words, folder=tmp_path / "run", progress=False)
    whole = gridworld.train(*words, progress=False)
    assert timeless(continued.summary) == timeless(whole.summary)
    assert np.array_equal(continued.policy.q, whole.policy.q)


def test_calls_in_threads_have_the_same_results_and_torch_keeps_its_number_of_threads() -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        alone = gridworld.train(*SHORT["dqn"], progress=False)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
    found: list[gridworld.RunResult] = []
    threads = [
        threading.Thread(target=lambda: found.append(gridworld.train(*SHORT["dqn"], progress=False)))
        for _ in range(2)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [np.array_equal(run.policy.q, alone.policy.q) for run in found] == [True] * 2


def test_a_program_that_uses_hydra_keeps_its_own() -> None:
    gridworld.compose("agent=ppo")
    assert not GlobalHydra.instance().is_initialized()
    OmegaConf.register_new_resolver("slug", lambda text: f"mine {text}", replace=True)
    with hydra.initialize_config_dir(version_base="1.2", config_dir=str(CONF)):
        own = GlobalHydra.instance().hydra
        assert gridworld.compose("agent=ppo").agent.name == "ppo"
        with pytest.raises(InputError):
            gridworld.compose("agent=nothing")
        assert GlobalHydra.instance().hydra is own
        assert str(getbase()) == "1.2"
        assert hydra.compose("train", ["seed=4"]).seed == 4
    assert OmegaConf.create({"a": "${slug:b}"}).a == "mine b"


def test_progress_is_shown_or_not(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gridworld.base.console._SECONDS_BETWEEN_LINES", 0.0)
    gridworld.train(*SHORT["q_learning"], progress=False)
    assert capsys.readouterr().err == ""
    gridworld.train(*SHORT["q_learning"])
    assert "q_learning on classic: step 2,000 of 2,000" in capsys.readouterr().err


def test_a_run_is_opened_within_the_budget_and_ones_own_needs_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("GRIDWORLD_BUDGET", "1MB")
    words = ("agent=dqn", "env=cliff_walking_v1", "agent.policy_kwargs.net_arch=[512,512]", *NO_FILES)
    few = {"total_timesteps": 20, "agent.learning_starts": 10, "n_envs": 10}
    own = gridworld.train(*words, few, folder=tmp_path / "run", progress=False)
    assert own.model is not None  # whatever it takes
    opened = gridworld.open_run(tmp_path / "run")
    with pytest.raises(InputError, match=r"its network: would take about .*set GRIDWORLD_BUDGET=1GB"):
        _ = opened.model
    with pytest.raises(InputError, match="its network: would take about"):
        gridworld.diagnose(tmp_path / "run")
    with (tmp_path / "run" / "world.npz").open("r+b") as file:
        file.truncate(500_000)
    for read in (gridworld.open_run, gridworld.diagnose):
        with pytest.raises(
            InputError, match=r"world\.npz: would take about 1\.5 MB of memory, but the budget"
        ):
            read(tmp_path / "run")
