"""What several tests of resuming need: runs that stop where they are told to, and everything a run leaves."""

import contextlib
import csv
import gc
import itertools
import json
import os
import signal
import struct
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.support import configure
from helpers.support import train_in as begin
from tensorboard.compat.proto.event_pb2 import Event

from gridworld.base.serialization import decode
from gridworld.run.checkpoints import Checkpoints
from gridworld.run.reader import is_started
from gridworld.training.resume import open_unfinished, unfinished_of
from gridworld.training.together import run_together
from gridworld.training.train import training

OF_THE_CLOCK = {"train_seconds", "evaluation_seconds"}
TIMED_FILES = (
    *(".", "events.", "manifest", "summary", "checkpoints/", "model", "best_model"),
    *("source.diff", "train.log"),
)
TIMED_TAGS = ("time/fps", "_hparams_", "run/command", "run/settings")


def in_a_process(work: Callable[[], None], seconds: float | None = None) -> int:
    """What became of a process of its own, killed after so long: 0 it ended well, below 0 it was killed."""
    process = os.fork()
    if process == 0:
        try:
            gc.disable()
            with open(os.devnull, "w") as nowhere:
                sys.stderr = nowhere
                work()
            os._exit(0)
        except BaseException:
            import traceback

            traceback.print_exc(file=sys.__stderr__)
            os._exit(1)
    if seconds is not None:
        time.sleep(seconds)
        os.kill(process, signal.SIGKILL)
    return os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])


def kill() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


class Crash(BaseException):
    """Stands in for the process being killed."""


def begin_all(runs: Sequence[tuple[Path, Sequence[str]]]) -> list[Any]:
    """The same of several runs that train together; returns their summaries, or how they failed."""
    for folder, _ in runs:
        folder.mkdir(parents=True, exist_ok=True)
    return run_together([training(configure(*words), folder, list(words)) for folder, words in runs])


def go_on(folder: Path, total_timesteps: int | None = None) -> None:
    open_unfinished(folder, trust=True).resume(total_timesteps)


def begin_or_go_on(folder: Path, *overrides: str) -> None:
    """As the same command does in a folder that may hold an unfinished run."""
    if is_started(folder):
        unfinished_of(folder, configure(*overrides)).resume()
    else:
        begin(folder, *overrides)


def stopped_after(number: int, folder: Path, *overrides: str) -> None:
    """A run whose process dies right after so many checkpoints."""
    with crashing_after(number):
        begin(folder, *overrides)


def crash(*arguments: object) -> None:
    raise Crash


@contextlib.contextmanager
def crashing_after(number: int) -> Iterator[None]:
    """The same of whatever is done in here."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(Checkpoints, "save", at_call(number, crash, Checkpoints.save, after=True))
        with pytest.raises(Crash):
            yield


def at_call(
    number: int, act: Callable[[], object], original: Callable[..., Any], after: bool = False
) -> Callable[..., Any]:
    """The function, where this happens too in its n-th call and all later ones, before or after its work."""
    calls = itertools.count(1)

    def call(*arguments: Any, **options: Any) -> Any:
        is_due = next(calls) >= number
        if is_due and not after:
            act()
        answer = original(*arguments, **options)
        if is_due and after:
            act()
        return answer

    return call


def points(folder: Path) -> list[tuple[Any, ...]]:
    """Every point, picture and setting for TensorBoard, in the order of the file, without wall times."""
    paths = list(folder.glob("events.out.tfevents.*"))
    assert len(paths) <= 1
    content, found = b"".join(path.read_bytes() for path in paths), []
    while content:
        (length,) = struct.unpack_from("<Q", content)
        event = Event.FromString(content[12 : 12 + length])
        content = content[16 + length :]
        for value in event.summary.value:
            kind = value.WhichOneof("value")
            number = None if kind is None else getattr(value, kind)
            if kind not in ("simple_value", None):
                number = number.SerializeToString()
            timed = value.tag.startswith(TIMED_TAGS)
            found.append((value.tag, event.step, None if timed else number))
    return found


def left_behind(folder: Path) -> dict[str, Any]:
    """All that must be the same of two runs, whatever happened to them on the way."""
    found: dict[str, Any] = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.is_file() and not name.startswith(TIMED_FILES):
            found[name] = path.read_bytes()
    summary = json.loads((folder / "summary.json").read_text())
    found["summary"] = {key: value for key, value in summary.items() if key not in OF_THE_CLOCK}
    found["model"] = weights((folder / "model.zip").read_bytes(), folder)
    found["best model"] = weights((folder / "best_model.zip").read_bytes(), folder)
    found["points"] = points(folder)
    found["state"] = last_state(folder)
    assert len({row["step"] for row in rows(folder)}) == len(rows(folder))
    return found


def weights(content: bytes, folder: Path) -> dict[str, Any]:
    """The arrays in the bytes of a model file, which itself has the time of the clock."""
    if not content:
        return {}
    path = folder / ".model_to_compare"
    path.write_bytes(content)
    agent = configure("agent=sarsa" if b"algorithm.npy" in content else "agent=dqn").agent
    found = agent.weights(path, 10**8)
    path.unlink()
    return found


def rows(folder: Path) -> list[dict[str, str]]:
    with (folder / "curve.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def last_state(folder: Path) -> dict[str, Any] | None:
    """The final checkpoint, without what the clock says: weights, optimiser, replay, generators."""
    files = Checkpoints(folder).files()
    if not files:
        return None
    state = decode(files[0].read_bytes())
    for key in ("seconds", "marks"):
        del state[key]
    curve = state["curve"]
    del curve["seconds"]
    curve["best"]["content"] = weights(curve["best"]["content"].tobytes(), folder)
    if curve["held"] is not None:
        curve["held"]["model"] = weights(curve["held"]["model"].tobytes(), folder)
    agent = state["agent"]
    agent.pop("seconds", None)
    return state


def differences(one: Any, other: Any, path: str = "") -> list[str]:
    """Where two values differ, to the last bit."""
    if isinstance(one, dict) and isinstance(other, dict):
        found = [f"{path}.{key} in one only" for key in one.keys() ^ other.keys()]
        for key in one.keys() & other.keys():
            found += differences(one[key], other[key], f"{path}.{key}")
        return found
    if isinstance(one, list | tuple) and isinstance(other, list | tuple):
        if len(one) != len(other):
            return [f"{path}: {len(one)} and {len(other)} items"]
        pairs = enumerate(zip(one, other, strict=True))
        return [each for index, pair in pairs for each in differences(*pair, f"{path}[{index}]")]
    if isinstance(one, np.ndarray) and isinstance(other, np.ndarray):
        equal = one.dtype == other.dtype and one.shape == other.shape and one.tobytes() == other.tobytes()
        return [] if equal else [f"{path}: arrays"]
    equal = one == other or (one != one and other != other)
    return [] if equal else [f"{path}: {str(one)[:50]} and {str(other)[:50]}"]
