"""Every command that is printed runs as it stands, from where it was printed, and in the same world."""

import json
import re
import shlex
import subprocess
from pathlib import Path

import pytest
from helpers import hostile
from helpers.support import NO_FILES, script

import gridworld
from gridworld.base.errors import InputError

COMMAND = re.compile(r"(?:python \S*/(\w+)\.py|gridworld (train|diagnose)) (.*)")
LAYOUT = "env.layout=my maps/one map.txt"
SPOILT = ["agent=q_learning", "agent.learning_rate=0.001", "total_timesteps=300", "env.goal_reward=2"]


@pytest.fixture
def home(tmp_path: Path) -> Path:
    """A folder with a map, a world and a search space of the user's own, all with blanks in their paths."""
    folder = tmp_path / "my home"
    for path, text in (
        ("my maps/one map.txt", "S..\n.T.\n..G\n"),
        ("my conf/env/icy.yaml", "layout: my maps/one map.txt\nslip: 0.2\n"),
        ("my conf/tune/narrow.yaml", "# @package tune.space\nagent.gamma: {type: float, low: 0, high: 1}\n"),
    ):
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_text(text)
    (tmp_path / "elsewhere").mkdir()
    return folder


def called(line: list[str], cwd: Path, code: int = 0) -> subprocess.CompletedProcess[str]:
    """What a script printed that ended with this exit code."""
    name, *words = line
    done = script(f"{name}.py", *words, cwd=cwd)
    assert done.returncode == code, (line, done.stderr)
    return done


def run_printed(text: str, cwd: Path) -> list[str]:
    """Run the commands in a text, in their own folders of results; returns what each of them printed."""
    found = [[first or second, *shlex.split(rest)] for first, second, rest in COMMAND.findall(text)]
    assert found, text
    return [called(line, cwd).stdout for line in found]


def worlds(folder: Path) -> set[tuple[str, float]]:
    """The worlds of all runs at or below a folder: map and slip."""
    manifests = [json.loads(path.read_text()) for path in folder.rglob("manifest.json")]
    return {("\n".join(each["layout"]), each["config"]["env"]["slip"]) for each in manifests}


@pytest.mark.slow
@pytest.mark.parametrize("words", [[LAYOUT], ["--config-dir", "my conf", "env=icy"]])
def test_what_train_and_diagnose_print(words: list[str], home: Path, tmp_path: Path) -> None:
    done = called(["train", *words, *SPOILT, *NO_FILES, "hydra.run.dir=runs/a run"], home)
    the_world = worlds(home / "runs" / "a run")
    run_printed(done.stdout[done.stdout.index("try:") :].partition("files:")[0], home)
    elsewhere, run = tmp_path / "elsewhere", "../my home/runs/a run"
    refused = called(["diagnose", run], elsewhere)
    assert "diagnose it with --trust" in refused.stdout
    assert not COMMAND.search(refused.stdout)
    for cwd, path in ((home, "runs/a run"), (elsewhere, run)):
        run_printed(called(["diagnose", path, "--trust"], cwd).stdout, cwd)
    assert worlds(tmp_path) == the_world


def test_from_python_no_script_is_named(home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(home)
    run = gridworld.train(LAYOUT, *SPOILT, *NO_FILES, folder="runs/a run", progress=False)
    monkeypatch.chdir(tmp_path / "elsewhere")
    found = gridworld.diagnose(gridworld.open_run(home / "runs" / "a run", trust=True))
    assert all(line.startswith("gridworld train ") for line in found.commands)
    run_printed("\n".join(found.commands), tmp_path / "elsewhere")
    assert len(worlds(tmp_path)) == 1
    for same in (run, run.policy):
        assert gridworld.evaluate(same, run).regret == run.summary["regret"]
    with pytest.raises(InputError, match=r"the run's policy: has shape \(9,\); cliff has 48 states"):
        gridworld.evaluate(run, "cliff")


def test_an_unfinished_run_is_resumed_from_another_folder(home: Path, tmp_path: Path) -> None:
    called(["train", *SPOILT, *NO_FILES, "hydra.run.dir=runs/a run"], home)
    manifest = home / "runs" / "a run" / "manifest.json"
    hostile.manifest(manifest.parent, lambda content: content.update(status="interrupted"))
    refused = called(["evaluate", "../my home/runs/a run"], tmp_path / "elsewhere", code=2)
    run_printed(refused.stderr, tmp_path / "elsewhere")
    assert json.loads(manifest.read_text())["status"] == "finished"


@pytest.mark.slow
def test_what_a_sweep_and_a_study_print(home: Path) -> None:
    own = ["--config-dir", "my conf", "env=icy", *SPOILT, *NO_FILES]
    done = called(["train", "-m", *own, "seed=0,1", "hydra.sweep.dir=runs/a sweep"], home)
    run_printed(done.stdout, home)
    small = ["tune.trials=2", "tune.seeds=1", "tune.final_seeds=0", "tune.confirm_seeds=2", "tune.workers=1"]
    done = called(["tune", *own, "tune=narrow", *small, "tune.folder=runs/a study"], home)
    run_printed(done.stdout, home)
    for run in (home / "runs" / "a study" / "confirm").glob("*,seed=1"):
        config = json.loads((run / "manifest.json").read_text())["config"]
        found = gridworld.open_run(run, trust=True)
        again = [word for word in found.overrides if not word.startswith("--")]
        conf = f"hydra.searchpath=[file://{home / 'my conf'}]"
        assert gridworld.compose(*again, conf).agent.gamma == config["agent"]["gamma"]
    assert {slip for _, slip in worlds(home)} == {0.2}
