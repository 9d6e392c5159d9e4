"""Resuming as a user meets it: by command, by the same command again, longer, in a sweep, after a signal."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from helpers.resuming import begin, differences, go_on, left_behind, stopped_after
from helpers.support import ROOT, SHORT, script, start, wait_for

from gridworld.base.atomic_write import AppendLog, locked
from gridworld.base.errors import InputError
from gridworld.base.serialization import decode, encode
from gridworld.commands.train import resume
from gridworld.run import provenance
from gridworld.run.checkpoints import Checkpoints
from gridworld.run.folder import LOCK, RunFolder
from gridworld.run.provenance import Source
from gridworld.training.resume import open_unfinished

LESS = ["recording.frames=false", "recording.gif=false"]
WORDS = [*SHORT["q_learning"], *LESS, "checkpoint.every=600"]


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that was killed after 1,200 of 2,000 steps, to be looked at."""
    folder = tmp_path_factory.mktemp("killed") / "run"
    stopped_after(2, folder, *WORDS)
    return folder


@pytest.fixture
def stopped(killed: Path, tmp_path: Path) -> Path:
    """The same, to be resumed."""
    return Path(shutil.copytree(killed, tmp_path / "run"))


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of the same settings that was not interrupted, to be looked at."""
    folder = tmp_path_factory.mktemp("calm") / "run"
    begin(folder, *WORDS)
    return folder


@pytest.fixture(scope="module")
def calm(whole: Path) -> dict[str, object]:
    return left_behind(whole)


@pytest.fixture
def finished(whole: Path, tmp_path: Path) -> Path:
    """The same, to be made longer."""
    return Path(shutil.copytree(whole, tmp_path / "run"))


def manifest(folder: Path) -> dict[str, object]:
    content = json.loads((folder / "manifest.json").read_text())
    assert isinstance(content, dict)
    return content


@pytest.mark.slow
def test_resume_and_the_same_command_again(stopped: Path, calm: dict[str, object]) -> None:
    shutil.copytree(stopped, stopped.with_name("other"))
    cwd = stopped.parent
    done = script("train.py", "resume=run", "logging.progress=false", cwd=cwd)
    assert done.returncode == 0, done.stderr
    assert "run: resumes after 1,200 of 2,000 steps" in done.stderr
    assert "q_learning on classic, seed 0: 2,000 steps" in done.stdout
    assert differences(left_behind(stopped), calm) == []

    before = left_there(cwd / "other")
    refused = script("train.py", *WORDS, "hydra.run.dir=other", "seed=3", "env.slip=0.2", cwd=cwd)
    assert refused.returncode == 2
    assert left_there(cwd / "other") == {**before, ".lock": b""}
    expected = "unfinished run with other settings (seed=3 instead of 0, env.slip=0.2 instead of 0.0); choose"
    assert expected in refused.stderr
    again = script("train.py", *WORDS, "hydra.run.dir=other", cwd=cwd)
    assert again.returncode == 0, again.stderr
    assert differences(left_behind(cwd / "other"), calm) == []
    third = script("train.py", *WORDS, "hydra.run.dir=other", cwd=cwd)
    assert third.returncode == 2
    assert "other: contains a run already; choose another folder, or make that run" in third.stderr


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["resume="], "resume=: must be the folder of a run"),
        (["resume=nowhere"], "nowhere: no such folder"),
        (["resume=.."], "resume=..: leads out of the current folder"),
        (["resume=run", "seed=1"], "seed=1: a run is resumed with its own settings; besides"),
        (["-m", "resume=run"], "-m: a run is resumed with its own settings"),
        (["resume=run", "total_timesteps=1.5"], "total_timesteps=1.5: must be a number of environment steps"),
        (["resume=run", "total_timesteps=1000"], "has done 1,200 of 2,000 steps; it can be made longer"),
        (["resume=run", "resume=other"], "resume=other: resume is given twice; give it once"),
        (["resume=run", "anyway=maybe"], "anyway=maybe: must be true or false"),
    ],
)
def test_mistakes(words: list[str], expected: str, killed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(killed.parent)
    before = left_there(killed)
    with pytest.raises(InputError, match=re.escape(expected)):
        resume(words)
    assert left_there(killed) | {".lock": b""} == before | {".lock": b""}


def test_a_run_is_one_process_alone(stopped: Path) -> None:
    """Also before there is a manifest."""
    (stopped.with_name("begun") / ".hydra").mkdir(parents=True)
    for name, words in (("run", ["resume=run"]), ("begun", [*WORDS, "hydra.run.dir=begun"])):
        folder = stopped.with_name(name)
        with locked(folder / LOCK, wait=0):
            before = left_there(folder)
            done = script("train.py", *words, cwd=stopped.parent)
            assert done.returncode == 2
            assert f"{name}: another process is using it" in done.stderr
            assert left_there(folder) == before


def left_there(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_what_a_killed_process_had_half_written_is_taken_away(tmp_path: Path) -> None:
    """Also where it was killed before there was a manifest."""
    folder = tmp_path / "run"
    folder.mkdir()
    half = folder / f".manifest.json.{os.uname().nodename}.{2**22 + 1}.part"
    half.write_text("{")
    (folder / ".notes.part").write_text("mine")
    refused = script("train.py", *WORDS, "hydra.run.dir=run", "seed=-1", cwd=tmp_path)
    other = script("train.py", *WORDS, "hydra.run.dir=other", "seed=-1", cwd=tmp_path)
    assert refused.returncode == other.returncode == 2
    assert list(tmp_path.iterdir()) == [folder]  # a start that comes to nothing leaves none
    assert [path.name for path in folder.iterdir()] == [".notes.part"]
    half.write_text("{")
    begin(folder, *WORDS)
    assert [path.name for path in folder.rglob("*.part")] == [".notes.part"]


@pytest.mark.parametrize(
    ("words", "total", "longer"),
    [
        (["agent=q_learning", "n_envs=16", "evaluation.every=220"], 1760, 4000),  # due at the last step
        ([*SHORT["ppo"], "evaluation.every=128"], 600, 2000),  # due thrice between 600 and 1,024, the last
        (["agent=a2c", "agent.arguments.learning_rate=0.005", "n_envs=4", "evaluation.every=100"], 484, 1000),
        ([*SHORT["dqn"], "n_envs=32", "agent.exploration_fraction=1e-9", "evaluation.every=500"], 1001, 1500),
    ],
    ids=["q_learning", "ppo", "a2c", "dqn"],
)
def test_a_run_made_longer_is_the_one_of_that_length(
    words: list[str], total: int, longer: int, tmp_path: Path
) -> None:
    """Without settings that fall over training; also where an evaluation is due at the shorter one's end."""
    words = [*words, *LESS]
    begin(tmp_path / "long", *words, f"total_timesteps={longer}", "logging.policy_map_every=2")
    begin(tmp_path / "run", *words, f"total_timesteps={total}", "logging.policy_map_every=2")
    go_on(tmp_path / "run", longer)
    one, other = left_behind(tmp_path / "run"), left_behind(tmp_path / "long")
    for left in (one, other):  # of one step, they may be in another order in the file
        left["points"] = sorted(left["points"], key=lambda point: (point[0], point[1]))
    assert differences(one, other) == []


@pytest.mark.parametrize("harm", ["empty", "another format", "no format", "other columns"])
def test_a_finished_run_without_a_checkpoint_that_fits_is_kept(harm: str, finished: Path) -> None:
    for file in Checkpoints(finished).files():
        state = decode(file.read_bytes())
        if harm == "another format":
            state["format"] += 1
        elif harm == "no format":
            del state["format"]
        elif harm == "other columns":
            content = (finished / "curve.csv").read_bytes()
            curve = AppendLog(finished / "curve.csv")
            curve.append(content.replace(b"online_return\n", b"online\n"))
            state["marks"]["curve"] = curve.mark()
            curve.close()
        file.write_bytes(b"" if harm == "empty" else encode(state))
    before = left_there(finished)
    with pytest.raises(InputError, match=r"is finished, but checkpoints/ has no checkpoint .*a new run of"):
        go_on(finished, 1000 if harm == "empty" else 4000)
    assert left_there(finished) == before


def test_a_run_is_made_longer_on_request_only_and_what_falls_over_training_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    begin(tmp_path, *SHORT["dqn"], *LESS, "agent.learning_rate=lin_0.004")
    (older,) = Checkpoints(tmp_path).files()
    content = older.read_bytes()
    with pytest.raises(InputError, match=r"is finished; to make it longer: .*=4000"):
        go_on(tmp_path)
    go_on(tmp_path, 4000)
    told = capsys.readouterr().err
    assert "4,000 steps instead of 2,000; as in a run of that length: learning_rate, exploration_frac" in told
    with pytest.raises(InputError, match="it can be made longer, not shorter"):
        go_on(tmp_path, 3000)
    go_on(tmp_path, 4500)
    assert manifest(tmp_path)["config"]["total_timesteps"] == 4500  # type: ignore[index]
    for file in Checkpoints(tmp_path).files():
        file.write_bytes(b"")
    older.write_bytes(content)
    with pytest.raises(InputError, match="was made longer after 4,096 steps and has no checkpoint left"):
        go_on(tmp_path, 8000)
    assert "skipped, it is older than the lengthening after 4,096 steps" in capsys.readouterr().err


def test_another_environment_is_refused_or_noted(
    stopped: Path, calm: dict[str, object], monkeypatch: pytest.MonkeyPatch
) -> None:
    versions = {**provenance.versions(), "numpy": "0.1"}
    told = r"numpy \S+ is now 0\.1", "source code [0-9a-f]{12} is now 0{12}"
    with monkeypatch.context() as patched:
        patched.setattr(provenance, "versions", lambda: versions)
        patched.setattr(provenance, "code", lambda: "0" * 64)
        refused = r"started in another environment \({}; {}\).*anyway=true".format(*told)
        with pytest.raises(InputError, match=refused):
            go_on(stopped)
        open_unfinished(stopped).resume(anyway=True)
    (again,) = manifest(stopped)["resumed"]  # type: ignore[misc, attr-defined]
    assert re.fullmatch("{}\n{}".format(*told), "\n".join(again["differs"]))
    assert differences({**left_behind(stopped), "state": None}, {**calm, "state": None}) == []


def test_another_commit_is_told_and_noted(
    stopped: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The code is the same, as after a commit to the README."""
    monkeypatch.setattr(provenance, "source", lambda: Source("abc", b"some changes"))
    go_on(stopped)
    told = capsys.readouterr().err
    assert "run: the source code has changed, as its manifest will say:  commit: " in told
    assert " then, abc now; uncommitted source: " in told
    (again,) = manifest(stopped)["resumed"]  # type: ignore[misc, attr-defined]
    assert again["git"]["commit"] == "abc"
    assert (stopped / again["git"]["diff"]["file"]).read_bytes() == b"some changes"
    go_on(stopped, 3000)
    assert "git" not in manifest(stopped)["resumed"][1]  # type: ignore[index]
    assert "the source code" not in capsys.readouterr().err


def test_a_map_that_changed_meanwhile(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    world = tmp_path / "world.txt"
    world.write_text("S..\n..G\n")
    words = [*WORDS, "env.layout=world.txt", "hydra.run.dir=run"]
    stopped_after(1, tmp_path / "run", *words[:-1])
    world.write_text("S..\nT.G\n")
    refused = script("train.py", *words, cwd=tmp_path)
    assert refused.returncode == 2
    assert "(the world world.txt has changed); choose another" in refused.stderr
    done = script("train.py", "resume=run", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "its world world.txt has changed; the run continues with its original world" in done.stderr
    assert manifest(tmp_path / "run")["layout"] == ["S..", "..G"]


@pytest.mark.parametrize(
    ("number", "times", "rollout", "told"),
    [
        (signal.SIGINT, 1, 32, "stopped by SIGINT: all {:,} steps are saved; resume with"),
        (signal.SIGTERM, 1, 32, "stopped by SIGTERM: all {:,} steps are saved; resume with"),
        # A rollout of many seconds cannot be saved in its middle: the first signal waits for its end.
        (signal.SIGTERM, 2, 30000, "stopped by SIGTERM: nothing is saved, so it will start over; resume"),
    ],
    ids=["ctrl-c", "terminated", "twice"],
)
def test_a_signal_saves_and_ends_soon(
    number: signal.Signals, times: int, rollout: int, told: str, tmp_path: Path
) -> None:
    words = ("agent=a2c", f"agent.arguments.n_steps={rollout}", "total_timesteps=100000000")
    curve = tmp_path / "run" / "curve.csv"
    with start("train.py", *words, "evaluation.every=1000", "hydra.run.dir=run", cwd=tmp_path) as process:
        wait_for(lambda: curve.exists() and curve.read_text().count("\n") > 2, "its curve", process)
        for _ in range(times):
            process.send_signal(number)
            time.sleep(0.1)
        _, printed = process.communicate(timeout=180)
    assert process.returncode == 128 + number
    left = manifest(tmp_path / "run")
    assert left["status"] == "interrupted"
    assert told.format(left["reached"]) in printed
    assert times == 2 or left["checkpoint"] == left["reached"] > 0  # type: ignore[operator]
    assert list((tmp_path / "run").rglob("*.part")) == []


STOPPED_BETWEEN = """
import os, signal, sys
from gridworld.commands import call
from gridworld.run.checkpoints import Pace
is_due = Pace.is_due
def sending(pace, steps):
    if steps >= 64:  # after the safe point has asked whether a signal came
        os.kill(os.getpid(), signal.SIGTERM)
    return is_due(pace, steps)
Pace.is_due = sending
call("train")
"""


@pytest.mark.slow
def test_a_signal_between_two_questions_of_a_safe_point_loses_nothing(tmp_path: Path) -> None:
    words = ("agent=a2c", "total_timesteps=10000", "evaluation.every=32", "hydra.run.dir=run")
    command = [sys.executable, "-c", STOPPED_BETWEEN, *words]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 128 + signal.SIGTERM, done.stderr
    left = manifest(tmp_path / "run")
    assert left["checkpoint"] == left["reached"] > 64  # type: ignore[operator]


STOPPED_EARLY = """
import os, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job would ignore it
from gridworld.base.signals import at_work, listen
listen()
if sys.argv[1] == "before":
    os.kill(os.getpid(), int(sys.argv[2]))
try:
    with at_work():
        if sys.argv[1] == "at work":
            os.kill(os.getpid(), int(sys.argv[2]))
except KeyboardInterrupt:
    sys.exit(130)
os.kill(os.getpid(), int(sys.argv[2]))
"""


@pytest.mark.parametrize(
    ("when", "number"),
    [
        ("before", signal.SIGINT),
        ("at work", signal.SIGINT),
        ("at work", signal.SIGTERM),
        ("afterwards", signal.SIGTERM),
    ],
)
def test_a_signal_that_comes_early_or_late(when: str, number: signal.Signals) -> None:
    """At work it is an exit code, since something may be cleaned up first."""
    command = [sys.executable, "-c", STOPPED_EARLY, when, str(int(number))]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == (128 + number if when == "at work" else -number)
    assert "Traceback" not in done.stderr


def test_scripts_listen_before_what_takes_time_to_import() -> None:
    for path in {*(ROOT / "scripts").glob("*.py")} - {ROOT / "scripts" / "check_certificate.py"}:
        code = [line for line in path.read_text().splitlines()[1:] if line]
        assert code[0] == "from gridworld.base.signals import listen"
        assert code[2] == "    listen()  # before what takes time to import"


@pytest.mark.parametrize(
    ("agent", "more"),
    [
        ({"policy_kwargs": {"features_extractor_class": "a.B"}}, " trust=true"),
        ({"algorithm": "DQN", "policy_kwargs": {"optimizer_class": "torch.optim.SGD"}}, ""),
    ],
)
def test_only_settings_that_name_code_have_to_be_trusted(agent: dict[str, object], more: str) -> None:
    command = RunFolder(Path("runs/it")).resume_command({"agent": agent})
    assert command == f"gridworld train resume=runs/it{more}"
