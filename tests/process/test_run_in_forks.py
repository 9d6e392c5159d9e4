"""Tasks in forks of this process: what comes back, in what order, and what a killed fork leaves."""

import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from gridworld.process.parallel.forks import LostError, can_fork, run_in_forks

from gridworld.storage.file_lock import is_locked, locked

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="forks are used on Linux only")


class UnpicklableError(Exception):
    def __init__(self, one: str, other: str) -> None:
        super().__init__(one + other)


def write(folder: Path, number: int) -> int:
    (folder / f"{number}").write_text(f"{os.getpid()}")
    return number


def test_results_come_in_the_order_of_the_tasks(tmp_path: Path) -> None:
    tasks = [partial(write, tmp_path, number) for number in range(7)]
    assert run_in_forks(tasks, 2) == list(range(7))
    processes = {path.read_text() for path in tmp_path.iterdir()}
    assert len(processes) <= 2
    assert str(os.getpid()) not in processes
    for process in processes:
        with pytest.raises(ChildProcessError):  # it has been waited for
            os.waitpid(int(process), os.WNOHANG)


@pytest.mark.parametrize("unpicklable", [False, True])
def test_what_a_task_raises_is_raised_once_the_others_have_ended(unpicklable: bool, tmp_path: Path) -> None:
    def fails() -> None:
        raise UnpicklableError("it ", "broke") if unpicklable else KeyError("it broke")

    def ends_later() -> None:
        time.sleep(0.2)
        write(tmp_path, 1)

    tasks: list[Callable[[], Any]] = [fails, ends_later, partial(write, tmp_path, 2)]
    with pytest.raises(RuntimeError if unpicklable else KeyError, match="it broke"):
        run_in_forks(tasks, 2)
    assert {path.name for path in tmp_path.iterdir()} == {"1"}  # the third did not begin


def test_a_fork_that_is_killed_is_told_of(tmp_path: Path) -> None:
    def is_killed() -> None:
        os.kill(os.getpid(), signal.SIGKILL)

    with pytest.raises(LostError):
        run_in_forks([is_killed, partial(write, tmp_path, 1)], 2)
    assert {path.name for path in tmp_path.iterdir()} == {"1"}


@pytest.mark.parametrize("reaches", ["parent", "both"])
def test_a_signal_counts_once_and_all_forks_end_before_this_process_goes_on(
    reaches: str, tmp_path: Path
) -> None:
    def works(number: int) -> None:
        (tmp_path / f"begun {number} {os.getpid()}").touch()
        try:
            time.sleep(30)
        except SystemExit:
            time.sleep(0.2)  # a second signal would end this too
            (tmp_path / f"closed {number}").touch()
            raise

    def interrupt() -> None:
        while len(begun := list(tmp_path.glob("begun *"))) < 2:
            time.sleep(0.01)
        others = [int(path.name.split()[-1]) for path in begun] if reaches == "both" else []
        for process in (os.getpid(), *others):
            os.kill(process, signal.SIGTERM)

    thread = threading.Thread(target=interrupt)
    thread.start()
    with pytest.raises(SystemExit) as ended:
        run_in_forks([partial(works, number) for number in range(3)], 2)
    thread.join()
    assert ended.value.code == 128 + signal.SIGTERM
    assert {path.name for path in tmp_path.glob("closed *")} == {"closed 0", "closed 1"}


def test_a_lock_is_this_processs_alone(tmp_path: Path) -> None:
    def is_free() -> bool:
        return len(os.listdir("/proc/self/fd")) > 0 and not _has_open(tmp_path / ".lock")

    with locked(tmp_path / ".lock", wait=1) as is_ours:
        assert is_ours
        assert run_in_forks([is_free] * 2, 2) == [True, True]
        assert is_locked(tmp_path / ".lock")  # a fork that ends does not release it


def _has_open(path: Path) -> bool:
    files = [f"/proc/self/fd/{number}" for number in os.listdir("/proc/self/fd")]
    return any(os.path.exists(file) and os.path.samefile(file, path) for file in files)


def test_a_debugger_keeps_all_in_this_process() -> None:
    before = sys.gettrace()
    sys.settrace(lambda *_: None)
    try:
        assert not can_fork()
    finally:
        sys.settrace(before)
