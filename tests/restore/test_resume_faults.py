"""What goes wrong around a run: a full disk, lost files, numbers that are none. It says so and can go on."""

import errno
import os
import random
import shutil
import time
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from helpers.hostile import damaged
from helpers.resuming import at_call, begin, differences, go_on, left_behind, stopped_after
from helpers.support import ROOT, SHORT, script, train_on_full_disk

from gridworld.base.atomic_write import AppendLog
from gridworld.base.errors import InputError
from gridworld.engine.dqn import DQN
from gridworld.run import checkpoints as checkpoint
from gridworld.run import writer as run
from gridworld.run.checkpoints import Checkpoints

DAMAGES = int(os.environ.get("GRIDWORLD_DAMAGES", "8"))
LESS = ["recording.frames=false", "recording.gif=false"]
WORDS = [*SHORT["q_learning"], *LESS, "checkpoint.every=400"]


@pytest.fixture(scope="module")
def calm(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    folder = tmp_path_factory.mktemp("calm")
    begin(folder, *WORDS)
    return left_behind(folder)


@pytest.mark.parametrize(
    ("agent", "rate"), [("ppo", "agent.learning_rate"), ("a2c", "agent.arguments.learning_rate")]
)
def test_numbers_that_are_none_stop_a_run(agent: str, rate: str, tmp_path: Path) -> None:
    told = r"training diverged at update [\d,]+, after [\d,]+ steps: .* is not finite"
    with pytest.raises(InputError, match=told):
        begin(tmp_path / "run", *SHORT[agent], *LESS, "checkpoint.every=100", f"{rate}=1e38")
    assert '"status": "failed"' in (tmp_path / "run" / "manifest.json").read_text()


def test_the_last_good_state_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    words = [*SHORT["dqn"], *LESS, "checkpoint.every=100"]
    begin(tmp_path / "calm", *words)
    targets = DQN._targets

    def spoilt(self: DQN, *arguments: Any) -> Any:
        return targets(self, *arguments) * (float("nan") if self.num_timesteps > 1500 else 1)

    told = "training diverged at update 64, after 1,536 steps: the gradient"
    with monkeypatch.context() as patched:
        patched.setattr(DQN, "_targets", spoilt)
        with pytest.raises(InputError, match=told):
            begin(tmp_path / "run", *words)
    go_on(tmp_path / "run")
    assert differences(left_behind(tmp_path / "run"), left_behind(tmp_path / "calm")) == []


def test_a_file_deleted_under_us_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save, run = Checkpoints.save, tmp_path / "run"

    def deleting(self: Checkpoints, *arguments: Any, **options: Any) -> None:
        save(self, *arguments, **options)
        for path in run.glob("events.out.tfevents.*"):
            path.unlink()

    monkeypatch.setattr(Checkpoints, "save", deleting)
    with pytest.raises(InputError, match="was deleted or replaced during the run"):
        begin(run, *WORDS)


def fail(code: int) -> None:
    raise OSError(code, os.strerror(code))


def test_a_curve_that_cannot_be_written_ends_the_run(
    calm: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patched:
        patched.setattr(AppendLog, "append", at_call(30, partial(fail, errno.EIO), AppendLog.append))
        with pytest.raises(InputError, match=r"Input/output error; fix that, .* with .*resume="):
            begin(tmp_path, *WORDS)
    go_on(tmp_path)
    assert differences(left_behind(tmp_path), calm) == []


def test_without_room_for_checkpoints_it_goes_on(
    calm: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: Any
) -> None:
    monkeypatch.setattr(checkpoint, "encode", at_call(2, partial(fail, errno.ENOSPC), checkpoint.encode))
    begin(tmp_path, *WORDS)
    assert "no checkpoint after step 800, No space left on device" in caplog.text
    assert differences({**left_behind(tmp_path), "state": None}, {**calm, "state": None}) == []


def test_a_really_full_disk(tmp_path: Path, calm: dict[str, Any]) -> None:
    """Of the event file's last record there would be half."""
    done = train_on_full_disk(15_000, *WORDS, "hydra.run.dir=run", cwd=tmp_path)
    assert done.returncode == 2
    assert f"error: run: File too large; fix that, then resume with python {ROOT}/scripts" in done.stderr
    again = script("train.py", "resume=run", cwd=tmp_path)
    assert again.returncode == 0, again.stderr
    assert differences(left_behind(tmp_path / "run"), calm) == []


def test_no_room_for_the_manifest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patched:
        patched.setattr(run, "write_json", at_call(1, partial(fail, errno.ENOSPC), run.write_json))
        with pytest.raises(InputError, match=r"run: No space left on device; .* run the command again$"):
            begin(tmp_path / "run", *WORDS)
    begin(tmp_path / "run", *WORDS)


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


def test_a_damaged_folder_ends_the_same_or_is_refused(calm: dict[str, Any], tmp_path: Path) -> None:
    stopped_after(3, tmp_path / "whole", *WORDS)
    names = sorted(path.relative_to(tmp_path) for path in (tmp_path / "whole").rglob("*") if path.is_file())
    for number in range(DAMAGES):
        shutil.copytree(tmp_path / "whole", tmp_path / "run")
        name, chance = names[number % len(names)].relative_to("whole"), random.Random(number)
        content = damaged(chance, (tmp_path / "run" / name).read_bytes())
        (tmp_path / "run" / name).unlink()
        if chance.random() < 0.8:
            (tmp_path / "run" / name).write_bytes(content)
        try:
            go_on(tmp_path / "run")
        except InputError:
            assert name.name == "manifest.json", (number, name)
        else:
            assert differences(left_behind(tmp_path / "run"), calm) == [], (number, name)
        shutil.rmtree(tmp_path / "run")
