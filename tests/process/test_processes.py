"""Tasks in processes and signals: what comes back, and what a killed process or an interruption leaves."""

import io
import os
import signal
import threading
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from gridworld.base.processes import Processes
from gridworld.base.signals import Interrupted, StopRequest


def run(tasks: Sequence[Callable[[], Any]], count: int = 2, forks: bool = True) -> list[Any]:
    found: dict[int, Any] = {}
    Processes(count, forks).run(tasks, lambda task, result: found.update({tasks.index(task): result}))
    return [found[number] for number in range(len(tasks))]


def write(folder: Path, number: int) -> int:
    (folder / f"{number}").write_text(f"{os.getpid()}")
    return number


@pytest.mark.parametrize("forks", [True, False])
def test_each_task_has_its_result_and_all_processes_end(forks: bool, tmp_path: Path) -> None:
    assert run([partial(write, tmp_path, number) for number in range(7)], 2, forks) == list(range(7))
    processes = {path.read_text() for path in tmp_path.iterdir()}
    assert len(processes) <= 2
    assert str(os.getpid()) not in processes
    for process in processes:
        with pytest.raises(ProcessLookupError):
            os.kill(int(process), 0)


def works(folder: Path, number: int) -> None:
    (folder / f"begun {number}").touch()
    try:
        time.sleep(30)
    except SystemExit:
        time.sleep(0.2)  # a second signal would end this too
        (folder / f"closed {number}").touch()
        raise


def test_a_signal_is_passed_on_once_and_all_processes_end_first(tmp_path: Path) -> None:
    def interrupt() -> None:
        while len(list(tmp_path.glob("begun *"))) < 2:
            time.sleep(0.01)
        os.kill(os.getpid(), signal.SIGTERM)

    thread = threading.Thread(target=interrupt)
    thread.start()
    with pytest.raises(SystemExit) as ended:
        run([partial(works, tmp_path, number) for number in range(3)])
    thread.join()
    assert ended.value.code == 128 + signal.SIGTERM
    assert {path.name for path in tmp_path.glob("closed *")} == {"closed 0", "closed 1"}


class Interruptible(io.BytesIO):
    """A file that SIGTERM comes for once it has some bytes."""

    asked = False

    def write(self, data: Any) -> int:
        if self.tell() and not self.asked:
            self.asked = True
            os.kill(os.getpid(), signal.SIGTERM)
        return super().write(data)


def test_an_interruption_stays_one_where_a_cleanup_fails() -> None:
    """torch's writer, interrupted, raises an error of its own as it closes its file."""
    import torch  # which the processes above need not import

    def save() -> None:
        with StopRequest().listening():
            torch.save({"weights": torch.zeros(100)}, Interruptible())

    with pytest.raises(Interrupted, match="stopped by SIGTERM"):
        save()


def test_another_failure_stays_what_it_is() -> None:
    def fail() -> None:
        with StopRequest().listening():
            try:
                raise KeyError("cause")
            except KeyError:
                raise ZeroDivisionError  # noqa: B904

    with pytest.raises(ZeroDivisionError) as caught:
        fail()
    assert isinstance(caught.value.__context__, KeyError)
    assert not caught.value.__suppress_context__
