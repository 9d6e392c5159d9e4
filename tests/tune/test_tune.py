"""Tuning as its user meets it: commands, kills, continuations and mistakes, on a real SQLite study."""

import contextlib
import csv
import json
import os
import shutil
import signal
import sqlite3
import sys
from pathlib import Path

import optuna
import pytest
import yaml
from helpers import forks
from helpers.support import ROOT, script, start, wait_for
from optuna.trial import TrialState, create_trial

from gridworld.base.errors import InputError
from gridworld.commands import report as report_command
from gridworld.commands import tune as tune_command
from gridworld.run.folder import claimed
from gridworld.sweeps.tune import study as tune_study
from gridworld.sweeps.tune import study_spec

QUICK = (
    *("agent=q_learning", "total_timesteps=1500", "recording.gif=false", "recording.learning=false"),
    *("tune.seeds=2", "tune.finalists=2", "tune.final_seeds=1", "tune.confirm_seeds=2"),
    *("tune.folder=study", "tune.workers=1"),
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
    assert f"  train it: python {ROOT}/scripts/train.py recipe=study\n" in done.stdout
    told = "  curves over seeds: tensorboard --logdir study/_over_seeds  (of each run: study/confirm)\n"
    assert told in done.stdout
    assert any(folder.glob("study/_over_seeds/* on */events.out.tfevents.*"))
    return folder


@pytest.mark.slow
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


def test_its_winner_is_a_recipe_of_train_py(studied: Path) -> None:
    winner = json.loads((studied / "study" / "study.json").read_text())["winner"]
    for words in (["recipe=study"], ["--config-dir", "study/experiment/..", "experiment=winner"]):
        done = script("train.py", *words, "--cfg", "job", cwd=studied)
        assert done.returncode == 0, done.stderr
        config = yaml.safe_load(done.stdout)
        for key, value in winner["values"].items():
            assert config["agent"][key.removeprefix("agent.")] == value, key
        assert config["total_timesteps"] == 1500


@pytest.mark.slow
def test_a_study_of_a_world_by_its_id_leaves_a_recipe_that_trains_there(tmp_path: Path) -> None:
    world = ("env=gymnasium", "env.id=FrozenLake-v1", "env.kwargs.is_slippery=false", "tuned=none")
    done = script("tune.py", *QUICK, *world, "tune.trials=2", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    winner = json.loads((tmp_path / "study" / "study.json").read_text())["winner"]["values"]
    trained = script("train.py", "recipe=study", "hydra.run.dir=run", cwd=tmp_path)
    assert trained.returncode == 0, trained.stderr
    config = json.loads((tmp_path / "run" / "manifest.json").read_text())["config"]
    assert (config["env"]["id"], config["env"]["kwargs"]) == ("FrozenLake-v1", {"is_slippery": False})
    assert {key: config["agent"][key.removeprefix("agent.")] for key in winner} == winner


def test_the_same_line_goes_on_with_the_study(studied: Path) -> None:
    before = rows(studied)
    more = script("tune.py", *QUICK, "tune.trials=8", cwd=studied)
    assert "6 of them already there" in more.stderr
    assert [row["trial"] for row in rows(studied)] == [str(number) for number in range(8)]
    assert rows(studied)[:6] == before


@pytest.mark.slow
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
        assert told.endswith("; it runs again")
    confirmed = json.loads((tmp_path / "study" / "study.json").read_text())["confirmation"]
    assert "left out" not in confirmed["sentence"]
    report_command.main([str(tmp_path / "study"), "--formats"])


@pytest.mark.slow
def test_the_report_shows_the_study(studied: Path, tmp_path: Path) -> None:
    report_command.main([str(studied / "study"), "--out", str(tmp_path / "out")])
    page = (tmp_path / "out" / "report.html").read_text()
    study = json.loads((studied / "study" / "study.json").read_text())
    assert study["confirmation"]["sentence"].split(":")[0] in page
    for figure in ("Score by trial", "Importance of each key", "Parallel coordinates"):
        assert f"{figure}, tuning q_learning on classic" in page
    assert "<script" not in page
    assert len(list((tmp_path / "out" / "figures").glob("*parallel*.png"))) == 1


@pytest.mark.parametrize(
    ("more", "sentence"),
    [
        ("tune=narrow", "was started with another search space: agent.exploration_final_eps was"),
        ("agent.gamma=0.8", "was started with another configuration: agent.gamma was 0.9, now it is 0.8"),
        ("tune.seeds=3", "was started with another objective: seeds was [0, 1], now it is [0, 1, 2]"),
    ],
)
def test_a_study_of_another_search_is_refused(
    studied: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, more: str, sentence: str
) -> None:
    (tmp_path / "tune").mkdir()
    space = "# @package tune.space\nagent.learning_rate: {type: float, low: 0.1, high: 0.9}\n"
    (tmp_path / "tune" / "narrow.yaml").write_text(space)
    before = (studied / "study" / "trials.csv").read_bytes()
    assert sentence in refusal(monkeypatch, studied, *QUICK, more, "--config-dir", str(tmp_path))
    assert (studied / "study" / "trials.csv").read_bytes() == before


def test_a_folder_of_another_study_is_refused(
    studied: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(studied / "study", tmp_path / "study")
    told = refusal(monkeypatch, tmp_path, *QUICK, "agent=sarsa", "total_timesteps=50", "tune.trials=2")
    assert "study: is the folder of the study tune_q_learning_classic; choose another tune.folder" in told
    (tmp_path / "study" / "study.db").unlink()
    before = sorted(tmp_path.rglob("*"))
    told = refusal(monkeypatch, tmp_path, *QUICK)
    assert "study.db: does not have the study tune_q_learning_classic, which has started; restore" in told
    assert sorted(tmp_path.rglob("*")) == before
    with claimed(tmp_path / "study"):
        assert "another process is using it" in refusal(monkeypatch, tmp_path, *QUICK)


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
    def all_fail(spec: object, study: optuna.Study, *more: object) -> None:
        study.add_trial(create_trial(state=TrialState.FAIL, user_attrs={"error": "training diverged"}))

    monkeypatch.setattr(tune_study, "search", all_fail)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [str(ROOT / "scripts" / "tune.py"), *QUICK])
    with pytest.raises(SystemExit) as ended:
        tune_command.main(QUICK)
    assert ended.value.code == 1
    told = capsys.readouterr().err.splitlines()[-1]
    assert told == "error: study: no trial got a score; all 1 failed, the first: training diverged"


def refused(title: str) -> list[list[str]]:
    """The cases of a section of `refused.txt`."""
    sections = Path(__file__).with_name("refused.txt").read_text("utf-8").split("\n\n")
    lines = next(section for section in sections if section.startswith(f"# {title}:")).splitlines()
    return [line.split("  =>  ") for line in lines[1:]]


@pytest.mark.parametrize(("yaml", "sentence"), refused("search space"))
def test_a_search_space_that_makes_no_sense(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, yaml: str, sentence: str
) -> None:
    (tmp_path / "tune").mkdir()
    head = "" if yaml.startswith("# @") else "# @package tune.space\n"
    (tmp_path / "tune" / "bad.yaml").write_text(head + yaml.replace("|", "\n"))
    monkeypatch.setattr(study_spec, "_CORNERS", 5)  # it goes with none of them
    told = refusal(monkeypatch, tmp_path, "agent=q_learning", "tune=bad", "--config-dir", ".")
    assert sentence in told
    assert "\n" not in told
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(("words", "sentence"), refused("command line"))
def test_a_command_line_that_cannot_be_meant(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: str, sentence: str
) -> None:
    told = refusal(monkeypatch, tmp_path, "agent=q_learning", "env=classic", *words.split())
    assert sentence in told
    assert "secret" not in told
    assert not list(tmp_path.glob("runs/*"))


def test_without_optuna_it_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    told = refusal(monkeypatch, tmp_path, "agent=q_learning")
    assert told == f"tune.py: optuna is not installed; pip install -e '{ROOT}[tune]'"


LONG = (
    *("total_timesteps=40000", "env=river_swim", "tune.pruner=none", "tune.stop_after=null"),
    *("tune.trials=3", "tune.workers=2"),
)


def workers_of(process: int, hundredths: int = 5) -> list[int]:
    """The processes that it has started and that have worked for so long."""
    found = []
    for file in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            name, fields = file.parent.name, file.read_text().rpartition(")")[2].split()
            if int(fields[1]) == process and fields[0] != "Z" and int(fields[11]) >= hundredths:
                found.append(int(name))
    return found


def wait_for_workers(process: forks.Started, count: int, but: int = 0) -> list[int]:
    found: list[int] = []

    def are_at_work() -> bool:
        found[:] = [worker for worker in workers_of(process.pid) if worker != but]
        return len(found) >= count

    wait_for(are_at_work, "workers", process)
    return found


def check_ended(processes: list[int]) -> None:
    """They are gone, or will be in a moment."""

    def is_gone(process: int) -> bool:
        try:
            return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
        except OSError:
            return True

    wait_for(lambda: all(map(is_gone, processes)), "the workers' end")


@pytest.mark.slow
def test_a_worker_is_killed_and_the_search_interrupted_and_gone_on_with(tmp_path: Path) -> None:
    with start("tune.py", *QUICK, *LONG, cwd=tmp_path) as process:
        killed = wait_for_workers(process, 2)[0]
        os.kill(killed, signal.SIGKILL)
        told = next(line for line in process.stderr if "died" in line)
        assert told.strip() == "a worker died (exit code -9), attempt 1 of 4 at its task"
        others = wait_for_workers(process, 2, but=killed)
        process.send_signal(signal.SIGINT)
        told = process.stderr.read()  # until the last worker has let go of it
    assert process.returncode == 130
    assert "stopped by SIGINT; finished trials are kept; resume with: python" in told
    check_ended(others)
    ended = rows(tmp_path)

    again = script("tune.py", *QUICK, *LONG, cwd=tmp_path)
    assert again.returncode == 0, again.stderr
    found = rows(tmp_path)
    assert found[: len(ended)] == ended
    assert [row["status"] for row in found] == ["done"] * 3


@pytest.mark.slow
def test_a_search_of_one_worker_is_the_same_however_it_is_killed(tmp_path: Path) -> None:
    words = [*QUICK, "env=river_swim", "total_timesteps=12000", "tune.trials=3"]

    def outcome(folder: Path) -> tuple[list[dict[str, str]], object]:
        found = rows(folder)
        for row in found:
            del row["worker"], row["seconds"]
        study = json.loads((folder / "study" / "study.json").read_text())
        return found, (study["winner"]["values"], study["confirmation"])

    def has_ended_a_trial(folder: Path) -> bool:
        file = folder / "study" / "study.db"
        with contextlib.suppress(sqlite3.Error), contextlib.closing(sqlite3.connect(file)) as study:
            return len(study.execute("SELECT * FROM trials").fetchall()) > 0
        return False

    for name in ("calm", "killed"):
        folder = tmp_path / name
        folder.mkdir()
        if name == "killed":
            with start("tune.py", *words, cwd=folder) as process:
                wait_for(lambda: has_ended_a_trial(tmp_path / "killed"), "a trial", process)
                worker = wait_for_workers(process, 1)[0]
                os.kill(worker, signal.SIGKILL)
                workers = wait_for_workers(process, 1, but=worker)
                process.kill()
                process.stderr.read()  # until the last worker has let go of it
                check_ended(workers)
        done = script("tune.py", *words, cwd=folder)
        assert done.returncode == 0, done.stderr
    assert outcome(tmp_path / "killed") == outcome(tmp_path / "calm")


@pytest.mark.slow
def test_a_database_that_disappears_is_one_sentence_and_no_worker_is_left(tmp_path: Path) -> None:
    with start("tune.py", *QUICK, *LONG, cwd=tmp_path) as process:
        workers = wait_for_workers(process, 2)
        (tmp_path / "study" / "study.db").unlink()
        told = process.stderr.read().splitlines()
    assert process.returncode == 1
    errors = [line for line in told if "study can no longer be reached" in line]
    assert len(errors) == 1
    assert errors[0].startswith("error: tune.storage=sqlite:////")
    assert not [line for line in told if "Traceback" in line or "Error" in line]
    check_ended(workers)


@pytest.mark.parametrize(("threads", "children"), [(1, 1), (2, 2)])  # workers are forks, or new processes
def test_ctrl_c_while_workers_start_is_one_sentence(threads: int, children: int, tmp_path: Path) -> None:
    with start("tune.py", *QUICK, *LONG, f"threads={threads}", cwd=tmp_path) as process:
        wait_for(lambda: len(workers_of(process.pid, 0)) >= children, "workers", process)
        os.killpg(process.pid, signal.SIGINT)  # as a terminal does
        told = process.stderr.read()
    assert process.returncode == 130
    assert "Traceback" not in told
    assert "stopped by SIGINT; finished trials are kept; resume with: python" in told
