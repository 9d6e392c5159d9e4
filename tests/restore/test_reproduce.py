"""The same command gives the same bits, in whatever process; and reproduce.py says so, or where they part."""

import csv
import json
import re
import shutil
import signal
import subprocess
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from helpers.hostile import manifest, seal, weights
from helpers.own_class import OWN_CLASS, any_class
from helpers.resuming import at_call, go_on, in_a_process, kill, stopped_after
from helpers.support import ROOT, SHORT, script, train_in

from gridworld.base.errors import InputError
from gridworld.base.signals import exiting
from gridworld.commands import reproduce as command
from gridworld.commands.reproduce import main
from gridworld.config.train import TrainConfig
from gridworld.run.checkpoints import Checkpoints
from gridworld.run.folder import SOURCE_DIFF, alone_in
from gridworld.run.provenance import describe, differences, source_of
from gridworld.run.reader import read_run
from gridworld.training.reproduce import compare
from gridworld.training.saved_run import SavedRun
from gridworld.training.tensorboard import EventWriter, read_scalars
from gridworld.world.mdp import Mdp

PARTS = ["learning curve", "final weights", "best weights", "visits", "summary", "TensorBoard points"]
PLAIN = ["recording.frames=false", "recording.gif=false", "env.slip=0.1", "seed=3"]


def verdicts(shown: str) -> dict[str, str]:
    """Of every part that was compared."""
    words = "identical|DIFFERENT|UNKNOWN|differs|the same"
    return dict(re.findall(rf"^  (\w[\w ]*?) {{2,}}({words})", shown, re.MULTILINE))


def reproduce(run: Path, capsys: pytest.CaptureFixture[str], *words: str, code: int = 0) -> str:
    """Run the command in this process; returns what it printed."""
    capsys.readouterr()
    if code:
        with pytest.raises(SystemExit) as ended:
            main([str(run), *words])
        assert ended.value.code == code
    else:
        main([str(run), *words])
    return capsys.readouterr().out


@pytest.mark.parametrize("agent", ["ppo", "value_iteration"])
def test_an_agent_comes_to_the_same_bits(
    agent: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """That each does is shown by test_resume.py, which compares a run with one that was interrupted."""
    train_in(tmp_path / "run", *SHORT[agent], *PLAIN)
    before = sorted(path.stat().st_mtime_ns for path in (tmp_path / "run").iterdir())
    shown = reproduce(tmp_path / "run", capsys)
    assert verdicts(shown) == dict.fromkeys(PARTS, "identical") | {"environment": "the same"}
    assert shown.splitlines()[-1] == "identical"
    assert sorted(path.stat().st_mtime_ns for path in (tmp_path / "run").iterdir()) == before


@pytest.mark.slow
def test_other_processes_and_hash_seeds_come_to_the_same_bits(tmp_path: Path) -> None:
    words = [*SHORT["ppo"], "hydra.run.dir=run", "env.layout=map.txt"]
    (tmp_path / "map.txt").write_text("S...\n.#T.\n...G\n")
    done = script("train.py", *words, cwd=tmp_path, PYTHONHASHSEED="1")
    assert done.returncode == 0, done.stderr
    (tmp_path / "map.txt").write_text("S.G\n")  # the run has its own
    again = script("reproduce.py", "run", cwd=tmp_path, PYTHONHASHSEED="2")
    assert again.returncode == 0, again.stderr
    assert "PYTHONHASHSEED: 1 then, 2 now" in again.stdout
    assert again.stdout.endswith("identical\n")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["map.txt", "run"]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("reproduce") / "run"
    train_in(folder, *SHORT["dqn"], *PLAIN)
    return folder


@pytest.fixture
def copy(run: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(run, tmp_path / "run"))


def test_the_first_point_of_difference_is_told(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines = list(csv.reader((copy / "curve.csv").read_text().splitlines()))
    lines[2][1] = "0.5"
    seal(copy, "curve.csv", "\n".join(map(",".join, lines)).encode())
    visits = np.load(copy / "visits.npy")
    visits[7, 2] += 1
    np.save(copy / "visits.npy", visits)
    seal(copy, "visits.npy")
    summary = json.loads((copy / "summary.json").read_text())
    summary["sampled"]["value"] = 0.25
    seal(copy, "summary.json", json.dumps(summary).encode())
    weights(copy, lambda content: content["q_net.q_net.0.bias"][3].fill_(0.5))
    seal(copy, "best_model.zip", (copy / "model.zip").read_bytes())
    (copy / "more").mkdir()
    events = EventWriter(copy / "more")
    events.scalars({"eval/value": 0.5}, 7)
    events.close()
    next((copy / "more").iterdir()).rename(copy / "events.out.tfevents.0.first")

    shown = reproduce(copy, capsys, code=1)
    assert verdicts(shown) == dict.fromkeys(PARTS, "DIFFERENT") | {"environment": "the same"}
    for told in (
        r"first at step 512, value: 0\.5 then, -?\d",
        r"first at policy\.q_net\.q_net\.0\.bias\[3\]: 0\.5 then, -?\d",
        r"first at row 2, column 2, down: (\d+) then, (\d+) now",
        r"first at sampled\.value: 0\.25 then, -?\d",
        r"first at step 7, eval/value: step 7, eval/value then, step 0, optimal/",
    ):
        assert re.search(told, shown), told
    assert shown.splitlines()[-1] == "different"


def test_what_differs_in_the_environment_is_told_and_the_run_is_kept_where_it_is_asked_for(
    copy: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("ATEN_CPU_CAPABILITY", raising=False)

    def edit(content: dict[str, dict[str, object]]) -> None:
        content["versions"]["torch"] = "1.0"
        content["processor"]["torch"] = "MMX"
        content["git"] = {"commit": "abc", "diff": {"sha256": "0" * 64, "file": SOURCE_DIFF}}
        content["environment"] = {"ATEN_CPU_CAPABILITY": "\x1b[2Javx2"}
        again = {"step": 512, "differs": ["numpy 1 is now 2\x1b[2J"], "git": {"commit": "later"}}
        content["resumed"] = [again, {"step": 600}]  # type: ignore[assignment]

    manifest(copy, edit)
    kept = copy.with_name("kept")
    shown = reproduce(copy, capsys, "--keep", str(kept))
    for line in (
        "commit: abc then, ",
        f"uncommitted source: changes 000000000000 ({SOURCE_DIFF} has them) then, ",
        "torch: 1.0 then, ",
        "processor torch: MMX then, ",
        "ATEN_CPU_CAPABILITY: \\x1b[2Javx2 then, none now",
        "resumed after step 512: numpy 1 is now 2\\x1b[2J (anyway=true)\n",
        "resumed after step 512: commit: abc then, later now\n",
    ):
        assert f"    {line}" in shown
    assert "step 600" not in shown
    assert not list(differences(describe(), describe()))

    names = [{path.name for path in run.iterdir() if "tfevents" not in path.name} for run in (kept, copy)]
    assert names[0] == names[1] | {".lock"}
    assert (kept / "policy.png").read_bytes() == (copy / "policy.png").read_bytes()
    with pytest.raises(InputError, match=r"--keep=\.\./x: leads out of the current folder"):
        reproduce(copy, capsys, "--keep", "../x")


def test_a_run_that_was_interrupted_and_made_longer_is_made_longer_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Twice: exploration jumps up again at each new length, as it does in no run of one length."""
    folder = tmp_path / "run"
    stopped_after(1, folder, *SHORT["dqn"], *PLAIN, "total_timesteps=1000", "checkpoint.every=600")
    go_on(folder)
    go_on(folder, 1500)
    go_on(folder, 2500)
    shown = reproduce(folder, capsys)
    assert "  made longer: to 1,000, 1,500 steps first, then on to 2,500\n" in shown
    assert verdicts(shown) == dict.fromkeys(PARTS, "identical") | {"environment": "the same"}


def test_a_reproduction_that_is_killed_is_continued_by_the_same_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed before each second checkpoint, at the first length and the later one."""
    folder, kept = tmp_path / "run", tmp_path / "kept"
    train_in(folder, *SHORT["dqn"], *PLAIN, "total_timesteps=1000", "checkpoint.every=300")
    go_on(folder, 1600)

    def killed() -> None:
        monkeypatch.setattr(Checkpoints, "save", at_call(2, kill, Checkpoints.save))
        main([str(folder), "--keep", str(kept)])

    lengths = []
    while in_a_process(killed) == -signal.SIGKILL:
        content = json.loads((kept / "manifest.json").read_text())
        assert content["status"] == "running"
        lengths.append(content["config"]["total_timesteps"])
    assert sorted(set(lengths)) == [1000, 1600]
    found = {finding.part: finding.same for finding in compare(*map(read_run, (folder, kept)), *of(folder))}
    assert found == dict.fromkeys(PARTS, True)


def test_a_reproduction_that_is_killed_once_it_has_finished_is_compared_by_the_same_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed between two lengths, and while it is compared."""
    folder, kept = tmp_path / "run", tmp_path / "kept"
    train_in(folder, *SHORT["q_learning"], *PLAIN, "total_timesteps=1000")
    go_on(folder, 1600)
    for place, length in (("training.reproduce.open_unfinished", 1000), ("commands.reproduce.compare", 1600)):

        def killed(place: str = place) -> None:
            monkeypatch.setattr(f"gridworld.{place}", lambda *_: kill())
            main([str(folder), "--keep", str(kept)])

        assert in_a_process(killed) == -signal.SIGKILL
        content = json.loads((kept / "manifest.json").read_text())
        assert (content["status"], content["config"]["total_timesteps"]) == ("finished", length)
    shown = reproduce(folder, capsys, "--keep", str(kept))
    assert f"  continues the run in {kept}, which had finished\n" in shown
    assert set(verdicts(shown).values()) == {"identical", "the same"}
    for other in (folder, shutil.copytree(folder, tmp_path / "copied")):
        with pytest.raises(InputError, match="contains a run already"):
            main([str(folder), "--keep", str(other)])
    manifest(kept, lambda content: content["config"].update(seed=4))
    with pytest.raises(InputError, match="kept: contains a run already"):
        reproduce(folder, capsys, "--keep", str(kept))


def of(folder: Path) -> tuple[TrainConfig, Mdp]:
    saved = SavedRun(folder)
    return saved.config, saved.mdp


def test_an_unfinished_reproduction_that_cannot_be_continued_gets_no_verdict(
    copy: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = copy.with_name("kept")

    def killed() -> None:
        monkeypatch.setattr(Checkpoints, "save", at_call(1, kill, Checkpoints.save, after=True))
        main([str(copy), "--keep", str(kept)])

    assert in_a_process(killed) == -signal.SIGKILL
    before = (kept / "manifest.json").read_bytes()

    def refused(told: str) -> None:
        capsys.readouterr()
        with pytest.raises(InputError, match=told):
            main([str(copy), "--keep", str(kept)])
        assert "different" not in capsys.readouterr().out
        assert (kept / "manifest.json").read_bytes() == before

    with monkeypatch.context() as patched:
        patched.setattr("gridworld.training.resume.environment", lambda agent: {"torch": "1.0"})
        refused("kept: was started in another environment .*torch")
    with alone_in(kept):
        refused("kept: another process is using it")
    manifest(copy, lambda content: content["config"].update(seed=4))
    refused("kept: contains an unfinished run with other settings .*seed=4 instead of 3")


@pytest.mark.parametrize(
    ("again", "told"),
    [
        ({"step": 1200, "instead_of": 2000}, "its length was changed after 1,200 of 2,000 steps, before its"),
        ({"step": 2000}, r"the lengths \[None, 2000\] .* must grow; was it written by another version"),
        ({"step": 9000, "instead_of": 9000}, "the lengths .* must grow"),
    ],
)
def test_lengths_that_cannot_be_repeated_are_refused_before_training(
    again: dict[str, int], told: str, copy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    again = {**again, "total_timesteps": 2000}
    manifest(copy, lambda content: content.update(resumed=[again]))
    monkeypatch.setattr(command, "repeat", lambda *_: pytest.fail("it trained"))
    with pytest.raises(InputError, match=told):
        main([str(copy)])


def test_a_run_that_cannot_be_repeated_is_no_other_result(
    copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    manifest(copy, lambda content: content["config"].update(device="cuda:99"))
    with pytest.raises(InputError, match="device=cuda:99: torch finds no CUDA device here"):
        reproduce(copy, capsys)
    (copy / "curve.csv").write_text("step\n")
    manifest(copy, lambda content: content["config"].update(device="cpu"))
    with pytest.raises(InputError, match=r"curve\.csv: is not the file that the run wrote"):
        reproduce(copy, capsys)


def test_without_its_event_file_no_run_is_identical(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    next(copy.glob("events*")).unlink()
    with pytest.raises(InputError, match="but files of the run are missing"):
        reproduce(copy, capsys)
    found = verdicts(capsys.readouterr().out)
    assert found == dict.fromkeys(PARTS, "identical") | {
        "environment": "the same",
        "TensorBoard points": "UNKNOWN",
    }


@pytest.mark.parametrize("name", ["curve.csv", "best_model.zip", "events*"])
def test_damage_is_told_before_training(name: str, copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (file,) = copy.glob(name)
    file.write_bytes(file.read_bytes()[:-3])
    monkeypatch.setattr(command, "repeat", lambda *_: pytest.fail("it trained"))
    with pytest.raises(InputError, match="damaged"):
        main([str(copy)])


def test_ones_own_class_needs_trust(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "my_own_agents.py").write_text(OWN_CLASS)
    monkeypatch.syspath_prepend(tmp_path)
    train_in(tmp_path / "run", *any_class("my_own_agents.Mine"))
    with pytest.raises(InputError, match="add --trust if you trust"):
        reproduce(tmp_path / "run", capsys)
    assert reproduce(tmp_path / "run", capsys, "--trust").endswith("identical\n")


def test_a_table_is_repeated_without_torch(tmp_path: Path) -> None:
    train_in(tmp_path / "run", *SHORT["q_learning"])
    manifest(tmp_path / "run", lambda content: content["processor"].update(torch=None))
    (tmp_path / "sitecustomize.py").write_text("import sys; sys.modules['torch'] = None\n")
    done = script("reproduce.py", "run", cwd=tmp_path, real=True, PYTHONPATH=f"{tmp_path}:{ROOT}")
    assert done.returncode == 0, done.stderr


def git(tree: Path, *words: str) -> None:
    who = ("-c", "user.name=x", "-c", "user.email=x@example.org")
    subprocess.run(["git", "-C", str(tree), *who, *words], check=True, capture_output=True)


def test_changes_since_the_commit_are_kept_and_can_be_applied(tmp_path: Path) -> None:
    tree = tmp_path / "tree"
    (tree / "gridworld").mkdir(parents=True)
    (tree / "gridworld" / "a.py").write_text("a = 1\n")
    (tree / "notes.txt").write_text("no part of it\n")
    git(tmp_path, "init", "tree")
    git(tree, "add", ".")
    git(tree, "commit", "-m", "first")
    clean = source_of(tree)
    assert clean is not None
    assert clean.manifest_entry() == {"commit": clean.commit, "dirty": False}

    (tree / "notes.txt").write_text("changed\n")
    assert source_of(tree) == clean
    (tree / "gridworld" / "a.py").write_text("a = 2\n")
    (tree / "gridworld" / "new.py").write_text("b = 3\n")
    dirty = source_of(tree)
    assert dirty is not None
    assert dirty.manifest_entry()["dirty"]
    assert dirty.manifest_entry()["diff"]["bytes"] == len(dirty.diff)
    (tmp_path / "diff").write_bytes(dirty.diff)
    git(tmp_path, "clone", "tree", "copy")
    git(tmp_path / "copy", "apply", str(tmp_path / "diff"))
    for name in ("a.py", "new.py"):
        file = Path("gridworld") / name
        assert (tmp_path / "copy" / file).read_text() == (tree / file).read_text()
    # Nothing was staged in the tree itself.
    status = subprocess.run(["git", "-C", str(tree), "status", "--porcelain"], capture_output=True, text=True)
    assert status.stdout.splitlines() == [" M gridworld/a.py", " M notes.txt", "?? gridworld/new.py"]
    assert source_of(tmp_path) is None


def test_a_signal_waits_until_git_has_answered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A handler that raised within `subprocess.run` could leave a lock taken for which it waits then."""
    (tmp_path / ".git").mkdir()
    fake = tmp_path / "git"
    fake.write_text("#!/bin/sh\nkill -TERM $PPID\nsleep 0.2\ntouch answered\n")
    fake.chmod(0o755)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    had_answered = []
    threading.Thread(target=time.sleep, args=(0.4,)).start()  # which may be the one that gets the signal
    with (
        pytest.raises(SystemExit),
        exiting(signal.SIGTERM, first=lambda _: had_answered.append(Path("answered").exists())),
    ):
        source_of(tmp_path)
    assert had_answered == [True]


def test_a_damaged_event_file_is_named(run: Path, tmp_path: Path) -> None:
    (file,) = run.glob("events*")
    raw = file.read_bytes()
    assert len(list(read_scalars(file))) > 50
    for wrong in (raw[:-3], raw[:5000] + bytes([raw[5000] ^ 1]) + raw[5001:], b"\xff" * 8 + raw[8:]):
        (tmp_path / "events").write_bytes(wrong)
        with pytest.raises(InputError, match=r"events: is damaged or cut off after [\d,]+ bytes"):
            list(read_scalars(tmp_path / "events"))
