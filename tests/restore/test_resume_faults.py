"""What goes wrong around a run: a full disk, lost files, numbers that are none. It says so and can go on."""

import errno
import os
import random
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from helpers.resuming import begin, differences, go_on, left_behind, stopped_after
from helpers.support import ROOT, SHORT, script, train_on_full_disk

from gridworld.engine.dqn import DQN
from gridworld.errors import InputError
from gridworld.run import checkpoints as checkpoint
from gridworld.run import writer as run
from gridworld.run.checkpoints import Checkpoints
from gridworld.storage.atomic_write import AppendLog

DAMAGES = int(os.environ.get("GRIDWORLD_DAMAGES", "8"))
LESS = ["recording.frames=false", "recording.gif=false"]
WORDS = [*SHORT["q_learning"], *LESS, "checkpoint.every=400"]


@pytest.fixture(scope="module")
def calm(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    folder = tmp_path_factory.mktemp("calm")
    begin(folder, *WORDS)
    return left_behind(folder)


@pytest.mark.parametrize("agent", ["dqn", "ppo", "a2c"])
def test_numbers_that_are_none_stop_a_run(agent: str, tmp_path: Path) -> None:
    words = [*SHORT[agent], *LESS, "checkpoint.every=100"]
    rate = "agent.arguments.learning_rate" if agent == "a2c" else "agent.learning_rate"
    with pytest.raises(
        InputError, match=r"training diverged at update [\d,]+, after [\d,]+ steps: .* is not finite"
    ):
        begin(tmp_path / "run", *words, f"{rate}=1e38")
    assert '"status": "failed"' in (tmp_path / "run" / "manifest.json").read_text()


def test_the_last_good_state_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    words = [*SHORT["dqn"], *LESS, "checkpoint.every=100"]
    begin(tmp_path / "calm", *words)
    targets = DQN._targets

    def spoilt(self: DQN, *arguments: Any) -> Any:
        return targets(self, *arguments) * (float("nan") if self.num_timesteps > 1500 else 1)

    with monkeypatch.context() as patched:
        patched.setattr(DQN, "_targets", spoilt)
        with pytest.raises(
            InputError, match=r"training diverged at update 64, after 1,536 steps: the gradient"
        ):
            begin(tmp_path / "run", *words)
    go_on(tmp_path / "run")
    assert differences(left_behind(tmp_path / "run"), left_behind(tmp_path / "calm")) == []


@pytest.mark.parametrize("name", ["events.out.tfevents.*", "curve.csv", ""])
def test_a_file_deleted_under_us_is_told(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save, run = Checkpoints.save, tmp_path / "run"

    def deleting(self: Checkpoints, *arguments: Any, **options: Any) -> None:
        save(self, *arguments, **options)
        for path in run.glob(name) if name else [run]:
            path.unlink() if path.is_file() else shutil.rmtree(path)

    monkeypatch.setattr(Checkpoints, "save", deleting)
    with pytest.raises(InputError, match="was deleted or replaced during the run"):
        begin(run, *WORDS)


def failing(original: Callable[..., Any], number: int, code: int) -> Callable[..., Any]:
    calls = 0

    def fails(*arguments: Any, **options: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls >= number:
            raise OSError(code, os.strerror(code))
        return original(*arguments, **options)

    return fails


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EROFS, errno.EIO])
def test_a_curve_that_cannot_be_written_ends_the_run(
    code: int, calm: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patched:
        patched.setattr(AppendLog, "append", failing(AppendLog.append, 30, code))
        with pytest.raises(InputError, match=rf"{os.strerror(code)}; fix that, then resume with .*resume="):
            begin(tmp_path, *WORDS)
    go_on(tmp_path)
    assert differences(left_behind(tmp_path), calm) == []


def test_without_room_for_checkpoints_it_goes_on(
    calm: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: Any
) -> None:
    monkeypatch.setattr(checkpoint, "encode", failing(checkpoint.encode, 2, errno.ENOSPC))
    begin(tmp_path, *WORDS)
    assert "no checkpoint after step 800, No space left on device" in caplog.text
    assert differences({**left_behind(tmp_path), "state": None}, {**calm, "state": None}) == []


def test_a_really_full_disk(tmp_path: Path, calm: dict[str, Any]) -> None:
    """Of the event file's last record there would be half."""
    done = train_on_full_disk(15_000, *WORDS, "hydra.run.dir=run", cwd=tmp_path)
    assert done.returncode == 2
    assert (
        f"error: run: File too large; fix that, then resume with python {ROOT}/scripts/train.py"
        in done.stderr
    )
    again = script("train.py", "resume=run", cwd=tmp_path)
    assert again.returncode == 0, again.stderr
    assert differences(left_behind(tmp_path / "run"), calm) == []


def test_no_room_for_the_manifest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patched:
        patched.setattr(run, "write_json", failing(run.write_json, 1, errno.ENOSPC))
        with pytest.raises(InputError, match=r"run: No space left on device; .* run the command again$"):
            begin(tmp_path / "run", *WORDS)
    begin(tmp_path / "run", *WORDS)


def test_what_was_changed_in_the_source_is_that_of_the_run(tmp_path: Path) -> None:
    begin(tmp_path, *WORDS)
    (tmp_path / "source.diff").write_text("of another time")
    run.clear(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"manifest.json"}


def test_frames_that_are_a_link_are_replaced(tmp_path: Path) -> None:
    (tmp_path / "outside").mkdir()
    (tmp_path / "outside" / "kept.png").write_text("kept")
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "frames").symlink_to(tmp_path / "outside")
    begin(tmp_path / "run", *WORDS, "recording.frames=true")
    assert not (tmp_path / "run" / "frames").is_symlink()
    assert [path.name for path in (tmp_path / "outside").iterdir()] == ["kept.png"]


def test_a_clock_that_jumps(calm: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now, chance = time.time, random.Random(0)
    monkeypatch.setattr(time, "time", lambda: max(0.0, now() + chance.uniform(-1e8, 1e8)))
    monkeypatch.setattr(time, "time_ns", lambda: int(time.time() * 1e9))
    stopped_after(2, tmp_path / "run", *WORDS)
    go_on(tmp_path / "run")
    assert differences(left_behind(tmp_path / "run"), calm) == []
    begin(tmp_path / "dqn", *SHORT["dqn"], *LESS)


def damage(folder: Path, number: int) -> str:
    """Do one of the things that happen to folders; returns what it was."""
    chance = random.Random(number)
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    path = files[number % len(files)]
    content = path.read_bytes()
    at = chance.randrange(len(content))
    kind = ("deleted", "cut", "flipped", "emptied", "longer", "other")[number // len(files) % 6]
    if kind == "deleted":
        path.unlink()
    else:
        path.write_bytes(
            {
                "cut": content[:at],
                "flipped": content[:at] + bytes([content[at] ^ 1 << chance.randrange(8)]) + content[at + 1 :],
                "emptied": b"",
                "longer": content + chance.randbytes(100),
                "other": chance.randbytes(len(content)),
            }[kind]
        )
    return f"{path.name} {kind}"


def test_a_damaged_folder_ends_the_same_or_is_refused(calm: dict[str, Any], tmp_path: Path) -> None:
    stopped_after(3, tmp_path / "whole", *WORDS)
    refused = []
    for number in range(DAMAGES):
        folder = tmp_path / "run"
        shutil.copytree(tmp_path / "whole", folder)
        what = damage(folder, number * (5 if DAMAGES < 30 else 1))
        try:
            go_on(folder)
        except InputError:
            refused.append(what)
        else:
            assert differences(left_behind(folder), calm) == [], what
        shutil.rmtree(folder)
    assert all("manifest.json" in what for what in refused), refused
