"""Tuning as its user meets it: commands, kills, continuations and mistakes, on a real SQLite study."""

import contextlib
import csv
import dataclasses
import json
import os
import shutil
import signal
import sqlite3
import sys
import time
from pathlib import Path

import pytest
from helpers.support import CONF, ROOT, script, start
from optuna.trial import TrialState, create_trial

from gridworld.commands import report as report_command
from gridworld.commands import tune as tune_command
from gridworld.errors import InputError
from gridworld.storage.sealed_json import sealed
from gridworld.tune.search.objective import ERROR
from gridworld.tune.search.worker import StudyContext

QUICK = (
    *("agent=q_learning", "total_timesteps=1500", "recording.gif=false", "recording.learning=false"),
    *("tune.seeds=2", "tune.finalists=2", "tune.final_seeds=1", "tune.confirm_seeds=2"),
    *("tune.folder=study", "tune.workers=1", "tune.heartbeat=1"),
)


def rows(folder: Path) -> list[dict[str, str]]:
    with (folder / "study" / "trials.csv").open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def studied(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which a small search has come to its end."""
    folder = tmp_path_factory.mktemp("tune")
    done = script("tune.py", *QUICK, "tune.trials=6", cwd=folder)
    assert done.returncode == 0, done.stderr
    assert "held-out seeds" in done.stdout
    assert "  train it: python scripts/train.py recipe=study\n" in done.stdout
    told = "  curves over seeds: tensorboard --logdir study/_over_seeds  (of each run: study/confirm)\n"
    assert told in done.stdout
    assert any(folder.glob("study/_over_seeds/* on */events.out.tfevents.*"))
    return folder


def test_a_search_leaves_a_row_per_trial_and_a_verdict(studied: Path) -> None:
    found = rows(studied)
    assert [row["trial"] for row in found] == [str(number) for number in range(6)]
    assert {row["status"] for row in found} <= {"done", "pruned"}
    assert found[0]["agent.learning_rate"] == "0.5"  # the shipped settings come first
    study = json.loads((studied / "study" / "study.json").read_text())
    best = min((row for row in found if row["status"] == "done"), key=lambda row: float(row["score"]))
    assert int(best["trial"]) in [finalist["trial"] for finalist in study["finalists"]]
    assert study["seeds"] == [0, 1]
    assert {finalist["seeds"] for finalist in study["finalists"]} == {3}
    assert 0 in [finalist["trial"] for finalist in study["finalists"]]
    assert study["winner"]["trial"] == study["finalists"][0]["trial"]
    confirmed = sorted(path.name for path in (studied / "study" / "confirm").glob("*,seed=*"))
    seeds = [name.rpartition(",")[2] for name in confirmed if name.startswith("default,")]
    assert seeds == ["seed=3", "seed=4"]


@pytest.mark.parametrize(
    "words", [["recipe=study"], ["--config-dir", "study/experiment/..", "experiment=winner"]]
)
def test_its_winner_is_a_recipe_of_train_py(words: list[str], studied: Path) -> None:
    out = f"hydra.run.dir=won by {len(words)}"
    done = script("train.py", *words, out, "recording.gif=false", cwd=studied)
    assert done.returncode == 0, done.stderr
    config = json.loads((studied / f"won by {len(words)}" / "manifest.json").read_text())["config"]
    winner = json.loads((studied / "study" / "study.json").read_text())["winner"]
    for key, value in winner["values"].items():
        assert config["agent"][key.removeprefix("agent.")] == value, key
    assert config["total_timesteps"] == 1500


def test_the_same_line_goes_on_with_the_study(studied: Path) -> None:
    before = rows(studied)
    more = script("tune.py", *QUICK, "tune.trials=8", cwd=studied)
    assert "6 of them there already" in more.stderr
    assert [row["trial"] for row in rows(studied)] == [str(number) for number in range(8)]
    assert rows(studied)[:6] == before


def test_damaged_runs_of_the_confirmation_are_run_again(studied: Path, tmp_path: Path) -> None:
    shutil.copytree(studied / "study", tmp_path / "study")
    runs = sorted((tmp_path / "study" / "confirm").glob("*,seed=*"))
    harmed = [runs[0] / "manifest.json", runs[1] / "visits.npy", runs[2] / "summary.json"]
    for file in harmed:
        os.truncate(file, 5)
    again = script("tune.py", *QUICK, "tune.trials=6", cwd=tmp_path)
    assert again.returncode == 0, again.stderr
    for file in harmed:
        (told,) = [line for line in again.stderr.splitlines() if f"{file.parent.name}/{file.name}: " in line]
        assert told.endswith("; it is run again" if file != harmed[0] else ".state")  # a checkpoint's copy
    confirmed = json.loads((tmp_path / "study" / "study.json").read_text())["confirmation"]
    assert "left out" not in confirmed["sentence"]
    report_command.main([str(tmp_path / "study"), "--formats"])


def test_the_report_shows_the_study(studied: Path, tmp_path: Path) -> None:
    report_command.main([str(studied / "study"), "--out", str(tmp_path / "out")])
    page = (tmp_path / "out" / "report.html").read_text()
    study = json.loads((studied / "study" / "study.json").read_text())
    assert study["confirmation"]["sentence"].split(":")[0] in page
    for figure in ("Score by trial", "Importance of each key", "Parallel coordinates"):
        assert f"{figure}, tuning q_learning on classic" in page
    assert "<script" not in page
    assert len(list((tmp_path / "out" / "figures").glob("*parallel*.png"))) == 1


def test_a_changed_study_is_reported_as_damaged(studied: Path, tmp_path: Path) -> None:
    from gridworld.report.tuning_study import find_tunings

    study = json.loads((studied / "study" / "study.json").read_text())
    study["space"]["agent.learning_rate"]["low"] = "<b>"
    (tmp_path / "trials.csv").write_bytes((studied / "study" / "trials.csv").read_bytes())
    for content, words in (
        (study, "study.json: was changed or damaged, its seal is not that of its content"),
        (sealed(study), "study.json: has no search that came to an end, or was changed"),
    ):
        (tmp_path / "study.json").write_text(json.dumps(content))
        found, problems = find_tunings([tmp_path])
        assert not found
        assert words in problems[0]


@pytest.mark.parametrize(
    ("more", "sentence"),
    [
        (["tune=narrow"], "was begun with another search space: agent.exploration_final_eps was"),
        (["agent.gamma=0.8"], "was begun with another configuration: agent.gamma was 0.9, now it is 0.8"),
        (["tune.seeds=3"], "was begun with another objective: seeds was [0, 1], now it is [0, 1, 2]"),
    ],
)
def test_a_study_of_another_search_is_refused(
    studied: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, more: list[str], sentence: str
) -> None:
    own = tmp_path / "tune"
    own.mkdir()
    (own / "narrow.yaml").write_text(
        "# @package tune.space\nagent.learning_rate: {type: float, low: 0.1, high: 0.9}\n"
    )
    before = (studied / "study" / "trials.csv").read_bytes()
    assert sentence in refusal(monkeypatch, studied, *QUICK, *more, "--config-dir", str(tmp_path))
    assert (studied / "study" / "trials.csv").read_bytes() == before


def test_a_folder_of_another_study_is_refused(
    studied: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(studied / "study", tmp_path / "study")
    told = refusal(monkeypatch, tmp_path, *QUICK, "agent=sarsa", "total_timesteps=50", "tune.trials=2")
    assert "study: is the folder of the study tune_q_learning_classic; choose another tune.folder" in told
    for name in ("search.json", "study.json"):  # either of them tells
        (tmp_path / "study" / "study.db").unlink(missing_ok=True)
        before = sorted(tmp_path.rglob("*"))
        told = refusal(monkeypatch, tmp_path, *QUICK)
        assert "study: is of the study tune_q_learning_classic, which sqlite:////" in told
        assert "study.db does not have; bring its database back" in told
        assert sorted(tmp_path.rglob("*")) == before
        (tmp_path / "study" / name).unlink()


def refusal(monkeypatch: pytest.MonkeyPatch, folder: Path, *arguments: str) -> str:
    """What tune.py says to such a command line."""
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "argv", [str(ROOT / "scripts" / "tune.py"), *arguments])
    with pytest.raises(InputError) as caught:
        tune_command.main(list(arguments))
    return str(caught.value)


def test_a_search_that_comes_to_nothing_is_no_mistake_of_the_command_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def all_fail(main: object, context: StudyContext, *more: object) -> None:
        study = context.storage.load()
        study.add_trial(create_trial(state=TrialState.FAIL, user_attrs={ERROR: "training diverged"}))

    monkeypatch.setattr("gridworld.tune.study.run_workers", all_fail)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [str(ROOT / "scripts" / "tune.py"), *QUICK])
    with pytest.raises(SystemExit) as ended:
        tune_command.main(QUICK)
    assert ended.value.code == 1
    told = capsys.readouterr().err.splitlines()[-1]
    assert told == "error: study: no trial came to a score; all 1 failed, the first: training diverged"


FLOAT = "agent.learning_rate: {type: float, low: 1e-3, high: 1e-2}"


@pytest.mark.parametrize(
    ("yaml", "sentence"),
    [
        (FLOAT, "Key 'agent.learning_rate' not in 'TuneConfig'"),  # without the line that says where it goes
        ("# @package tune.space\n", "there is nothing to search"),
        ("# @package tune.space\nagent.x: {type: float\n b", "bad.yaml: line 3, column 3: cannot be read"),
        ("# @package tune.space\nagent.gamma: 3", "int is not a subclass of DimensionConfig"),
        ("# @package tune.space\nagent.gamma: {type: flaot, low: 0, high: 1}", "type=flaot must be"),
        (
            "# @package tune.space\nagent.gamma: {type: float, lo: 0}",
            "Key 'lo' not in 'DimensionConfig'",
        ),
        ("# @package tune.space\nagent.gamma: {type: float, low: 1, high: 0}", "the first below the second"),
        ("# @package tune.space\nagent.gamma: {type: float, low: 0, high: 1, log: true}", "a positive low"),
        ("# @package tune.space\nagent.gamma: {type: float, low: 0, high: 1, step: 0.3}", "must lead from"),
        ("# @package tune.space\nagent.gamma: {type: categorical, choices: [0.9, 0.9]}", "different values"),
        ("# @package tune.space\nagent.gamma: {type: categorical, low: 1}", "must be a list"),
        ("# @package tune.space\nn_envs: {type: int, low: 1.5, high: 3}", "takes whole numbers"),
        ("# @package tune.space\nn_envs: {type: categorical, choices: [many]}", "n_envs=many"),
        (
            "# @package tune.space\nagent.gamma: {type: float, low: 0.5, high: 5}",
            "agent.gamma=5.0: must be from",
        ),
        (
            "# @package tune.space\nagent.learning_rate: {type: float, low: -3, high: -1}",
            "tune=bad: agent.learning_rate=-3.0: must be a number of at least 0",
        ),
        (
            "# @package tune.space\nagent.learning_rate: {type: categorical, choices: [0.1, abc]}",
            "tune=bad: agent.learning_rate=abc",
        ),
        (
            "# @package tune.space\nobservation.kind: {type: categorical, choices: [one_hot, coordinates]}",
            "tune=bad: observation=one_hot: agent=q_learning keeps a table",
        ),
        ("# @package tune.space\nagent.gama: {type: float, low: 0, high: 1}", "agent.gama"),
        ("# @package tune.space\nenv.slip: {type: float, low: 0, high: 1}", "is part of the task"),
        (
            "# @package tune.space\ncheckpoint.every: {type: int, low: 100, high: 1000}",
            "checkpoint.every: changes nothing about what is learnt",
        ),
    ],
)
def test_a_search_space_that_makes_no_sense(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, yaml: str, sentence: str
) -> None:
    (tmp_path / "tune").mkdir()
    (tmp_path / "tune" / "bad.yaml").write_text(yaml)
    monkeypatch.setattr("gridworld.tune.search.search_space._CORNERS", 5)  # it goes with none of them
    told = refusal(monkeypatch, tmp_path, "agent=q_learning", "tune=bad", "--config-dir", ".")
    assert sentence in told
    assert "\n" not in told
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["agent=nobody"], "agent=nobody: there is no such choice; there are a2c"),
        (["agent=value_iteration"], "tune=value_iteration: there is no such choice; there are a2c"),
        (["agent=dqn,ppo"], "agent=dqn,ppo: a study searches from one configuration"),
        (["tune.trails=3"], "Key 'trails' not in 'TuneConfig'; did you mean trials"),
        (["tune.trials=0"], "tune.trials=0: must be at least 1"),
        (["tune.together=0"], "tune.together=0: must be at least 1"),
        (["tune.pruner=axe"], "tune.pruner=axe: must be median, hyperband or none"),
        (["tune.storage=nonsense"], "tune.storage=nonsense: is no URL of a database"),
        (["tune.storage=sqlite://"], "tune.storage=sqlite://: is a database in the memory of one process"),
        (
            ["tune.storage=sqlite:///:memory:"],
            "where no worker finds it; name a file, e.g. sqlite:////shared",
        ),
        (["tune.storage='sqlite:///file:x?mode=memory&uri=true'"], "in the memory of one process"),
        (["tune.storage=sqlite:////no/such/x.db"], "cannot be reached (unable to open database file)"),
        (["tune.storage=postgresql://me:secret@127.0.0.1:1/x"], "tune.storage=postgresql://me:***@127.0.0.1"),
        (["tune.study=a/b"], "tune.study=a/b: must be of letters"),
        (["hydra.run.dir=x"], "tune.py makes its own folder"),
        (["--config-dir", "nowhere", "env=cliff"], "--config-dir nowhere: no such folder"),
    ],
)
def test_a_command_line_that_cannot_be_meant(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: list[str], sentence: str
) -> None:
    told = refusal(monkeypatch, tmp_path, "agent=q_learning", "env=classic", *words)
    assert sentence in told
    assert "secret" not in told
    assert not list(tmp_path.glob("runs/*"))


def test_without_optuna_it_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    told = refusal(monkeypatch, tmp_path, "agent=q_learning")
    assert told == "tune.py: optuna is not installed; pip install 'gridworld-sb3[tune]'"


LONG = (
    "total_timesteps=20000",  # so that a trial outlasts the time between two tables in a fork, 0.3 seconds
    "tune.pruner=none",
    "tune.stop_after=null",
    "tune.trials=3",
    "tune.workers=2",
)


def running(folder: Path) -> list[int]:
    """The processes that are in a trial."""
    if not (folder / "study" / "trials.csv").exists():
        return []
    found = [row["worker"] for row in rows(folder) if row["status"] == "running" and row["worker"]]
    return [int(worker.split(":")[1]) for worker in found]


def wait_for_a_trial(folder: Path) -> list[int]:
    end = time.monotonic() + 60
    while time.monotonic() < end:
        if found := running(folder):
            return found
        time.sleep(0.05)
    raise AssertionError("no trial began")


def is_alive(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_a_worker_is_killed_and_the_search_interrupted_and_gone_on_with(tmp_path: Path) -> None:
    with start("tune.py", *QUICK, *LONG, cwd=tmp_path) as process:
        killed = wait_for_a_trial(tmp_path)[0]
        os.kill(killed, signal.SIGKILL)
        told = next(line for line in process.stderr if "lost" in line)
        assert told.strip() == "a worker was lost to SIGKILL; its trial is run again"
        end = time.monotonic() + 60
        while not (others := [worker for worker in running(tmp_path) if worker != killed]):
            assert time.monotonic() < end, "no other trial begins"
            time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        told = process.stderr.read()  # until the last worker has let go of it
    assert process.returncode == 130
    assert "stopped by SIGINT; nothing that ended is lost; go on with: python" in told
    assert not any(map(is_alive, others))
    ended = [row for row in rows(tmp_path) if row["status"] == "done"]

    again = script("tune.py", *QUICK, *LONG, cwd=tmp_path)
    assert again.returncode == 0, again.stderr
    found = rows(tmp_path)
    assert [row for row in found if row in ended] == ended
    lost = [row for row in found if row["status"] == "lost"]
    assert killed in [int(row["worker"].split(":")[1]) for row in lost]
    assert [row["status"] for row in found if row not in lost] == ["done"] * 3
    keys = [key for key in found[0] if key.startswith("agent.")]
    for row in lost:
        repeated = next(other for other in found if other["repeats"] == row["trial"])
        chosen = [key for key in keys if row[key]]  # the worker may have been lost before it chose all
        assert [repeated[key] for key in chosen] == [row[key] for key in chosen]


def test_a_search_of_one_worker_is_the_same_however_it_is_killed(tmp_path: Path) -> None:
    words = [*QUICK, "env=river_swim", "total_timesteps=6000", "tune.trials=5", "tune.heartbeat=60"]

    def outcome(folder: Path) -> tuple[list[dict[str, str]], object]:
        found = [row for row in rows(folder) if row["status"] != "lost"]
        for row in found:
            del row["trial"], row["worker"], row["seconds"], row["repeats"]
        study = json.loads((folder / "study" / "study.json").read_text())
        return found, (study["winner"]["values"], study["confirmation"])

    for name, kills in (("calm", 0), ("killed", 2)):
        (tmp_path / name).mkdir()
        for ended in range(kills):
            with start("tune.py", *words, cwd=tmp_path / name) as process:
                database = tmp_path / name / "study" / "study.db"
                worker = under_way(database, ended)
                os.kill(worker, signal.SIGKILL)
                under_way(database, ended, after=worker)
                process.kill()
                process.stderr.read()  # until the last worker has let go of it
        done = script("tune.py", *words, cwd=tmp_path / name)
        assert done.returncode == 0, done.stderr
    assert outcome(tmp_path / "killed") == outcome(tmp_path / "calm")
    assert [row["status"] for row in rows(tmp_path / "killed")].count("lost") >= 1


def under_way(database: Path, ended: int, after: int = 0) -> int:
    """The process that is in a trial, after so many have ended, and is another than `after`."""
    found = "SELECT value_json FROM trials JOIN trial_user_attributes USING (trial_id) WHERE key = 'worker' "
    end = time.monotonic() + 60
    while time.monotonic() < end:
        if not database.exists():
            continue
        with contextlib.suppress(sqlite3.Error), contextlib.closing(sqlite3.connect(database)) as study:
            states = [state for (state,) in study.execute("SELECT state FROM trials")]
            workers = study.execute(f"{found} AND state = 'RUNNING' ORDER BY number DESC").fetchall()
            if sum(state in ("COMPLETE", "PRUNED") for state in states) >= ended and workers:
                worker = int(json.loads(workers[0][0]).split(":")[1])
                if worker != after:
                    return worker
    raise AssertionError("no such trial began")


def test_a_database_that_disappears_is_one_sentence(tmp_path: Path) -> None:
    with start("tune.py", *QUICK, *LONG, cwd=tmp_path) as process:
        wait_for_a_trial(tmp_path)
        (tmp_path / "study" / "study.db").unlink()
        told = process.stderr.read().splitlines()
    assert process.returncode == 1
    errors = [line for line in told if "study cannot be reached any more" in line]
    assert len(errors) == 1
    assert errors[0].startswith("error: tune.storage=sqlite:////")
    assert not [line for line in told if "Traceback" in line or "Error" in line]


def test_no_worker_outlives_a_search_that_is_killed(tmp_path: Path) -> None:
    with start("tune.py", *QUICK, *LONG, cwd=tmp_path) as process:
        workers = wait_for_a_trial(tmp_path)
        process.kill()
        process.stderr.read()  # until the last worker has let go of it
    assert not any(map(is_alive, workers))


def test_every_key_of_the_settings_stands_in_its_yaml() -> None:
    from omegaconf import OmegaConf

    from gridworld.config.tune import TuneConfig

    given = OmegaConf.load(CONF / "tune.yaml")["tune"]
    assert set(given) == {field.name for field in dataclasses.fields(TuneConfig)} - {"space"}
    for field in dataclasses.fields(TuneConfig):
        if field.name != "space":
            assert given[field.name] == field.default, field.name
