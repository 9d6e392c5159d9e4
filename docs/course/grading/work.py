"""A student's notebook in a process of its own, asked by plain data over a socket.

What comes back is read as JSON within bounds, never unpickled, and compared in this process. The other
process (`notebook`) has limits on time and memory, and its group ends with it. It may read any file: only a
container keeps it from the solutions.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

import numpy as np

from gridworld.base.errors import InputError
from gridworld.base.safe_read import LARGEST_JSON, as_object
from gridworld.world.mdp import FloatArray, Mdp

_TABLES = ("num_states", "num_actions", "next_state", "probability", "reward", "terminal", "start", "number")
_MOST_STOPPED = 3  # cells; what comes after so many is not run
_ENVIRONMENT = {
    "PATH": os.defpath,
    "LC_ALL": "C.UTF-8",
    "MPLBACKEND": "Agg",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
}


class WrongAnswerError(Exception):
    """An answer that earns no points; the message is the sentence that says why."""


class Work:
    """A student's notebook, whose functions can be called.

    Args:
        cells: the source of each code cell, by its number.
        seconds: for each cell, and for each exercise.
        memory: bytes that its process may address.

    Attributes:
        failed: by the number of a cell, why it could not be run.
    """

    def __init__(self, cells: Mapping[int, str], seconds: float, memory: int) -> None:
        self.failed: dict[int, str] = {}
        self._cells, self._seconds, self._memory = dict(cells), seconds, memory
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._end()

    def begin(self) -> None:
        """Begin an exercise: its time counts from now. If the process was lost, the cells run again."""
        while self._process is None:
            self._start()
        self._until = time.monotonic() + self._seconds

    def run(self, source: str) -> None:
        """Run further code of the marking's own in the notebook, which can change it there."""
        self._ask("the notebook", {"cell": 0, "source": source})

    def call(self, function: str, *arguments: Any) -> Any:
        """Call a function with numbers, text, lists, arrays and worlds.

        A world arrives with its tables as attributes, named as those of an `Mdp` are.

        Returns:
            What it returned, as plain data: arrays are lists.

        Raises:
            WrongAnswerError: it is missing, raised an exception, took too long, or returned something else.
        """
        return self._ask(f"`{function}`", {"name": function, "arguments": [*map(_encoded, arguments)]})

    def array(self, function: str, *arguments: Any, shape: tuple[int, ...]) -> FloatArray:
        """Call a function that must return finite numbers of this shape; see `call` and `numbers`."""
        return numbers(f"what `{function}` returned", self.call(function, *arguments), shape)

    def value(self, name: str) -> Any:
        """The value of a variable, as plain data; see `call`."""
        return self._ask(f"`{name}`", {"name": name})

    def _start(self) -> None:
        """Start the process and run the cells; a cell that has to be stopped is left out the next time."""
        self._folder = tempfile.TemporaryDirectory(prefix="gridworld-", ignore_cleanup_errors=True)
        self._socket, theirs = socket.socketpair()
        self._received, self._number = b"", 0
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-I", "-B", str(Path(__file__).with_name("notebook.py")), f"{self._memory}"],
                stdin=theirs.fileno(),
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                cwd=self._folder.name,
                env=_ENVIRONMENT | {"HOME": self._folder.name},
                start_new_session=True,
            )
        for number, source in list(self._cells.items()):
            self._until = time.monotonic() + self._seconds
            try:
                self._ask("it", {"cell": number, "source": source})
            except WrongAnswerError as error:
                self.failed[number] = str(error).removeprefix("it ")
            if self._process is None:
                del self._cells[number]
                if len(self.failed.keys() - self._cells.keys()) >= _MOST_STOPPED:
                    for each in [each for each in self._cells if each > number]:
                        self.failed[each] = "was not run, since others had to be stopped"
                        del self._cells[each]
                return

    def _ask(self, what: str, request: Mapping[str, Any]) -> Any:
        reply = self._exchange(what, request)
        if "result" not in reply:
            raise WrongAnswerError(f"{what} {str(reply.get('error'))[:300]}")
        return reply["result"]

    def _exchange(self, what: str, request: Mapping[str, Any]) -> dict[str, Any]:
        """Send a request and read the reply; if that fails, the process is lost."""
        if self._process is None:
            raise WrongAnswerError(f"{what} could not be asked, since the notebook's process has ended")
        self._number += 1
        try:
            self._wait()
            self._socket.sendall(json.dumps({**request, "number": self._number}).encode() + b"\n")
            while True:  # what else it may have sent is not the reply
                reply = as_object(self._line(), Path("the reply"))
                if reply.get("number") == self._number:
                    return reply
        except TimeoutError:
            why = f"took more than {self._seconds:g} s"
        except OSError:
            why = "ended its process: it exited, crashed or had no memory"
        except InputError:
            why = "gave an answer other than finite numbers, text and lists"
        self._end()
        raise WrongAnswerError(f"{what} {why}")

    def _line(self) -> bytes:
        while b"\n" not in self._received:
            self._wait()
            self._received += (part := self._socket.recv(2**16))
            if not part:
                raise BrokenPipeError
            if len(self._received) > LARGEST_JSON:
                raise InputError("the reply is too large")
        line, _, self._received = self._received.partition(b"\n")
        return line

    def _wait(self) -> None:
        """Let the next call of the socket wait until the deadline, and none begin after it."""
        if (left := self._until - time.monotonic()) <= 0:
            raise TimeoutError
        self._socket.settimeout(left)

    def _end(self) -> None:
        if self._process is None:
            return
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        self._process = None
        self._socket.close()
        with contextlib.suppress(RecursionError):  # of a folder in a folder in a folder ...
            self._folder.cleanup()


def numbers(what: str, found: Any, shape: tuple[int, ...]) -> FloatArray:
    """The array of finite numbers that plain data is.

    Args:
        what: begins the sentence of the error.
        found: numbers, or lists of them; text such as "nan" is none.
        shape: which it must have.

    Raises:
        WrongAnswerError: it is something else.
    """
    try:
        array = np.array(found)
    except ValueError:  # lists of several lengths
        array = np.array(None)
    if array.dtype.kind not in "biuf" or not np.isfinite(array).all():
        raise WrongAnswerError(f"{what} must be finite numbers, in an array of the shape {shape}")
    if array.shape != shape:
        raise WrongAnswerError(f"{what} has the shape {array.shape}, must be {shape}")
    return array.astype(np.float64)


def _encoded(value: Any) -> Any:
    if isinstance(value, Mdp):
        return {name: _encoded(getattr(value, name)) for name in _TABLES}
    if isinstance(value, np.ndarray):
        return {"array": value.tolist(), "type": value.dtype.str}
    return value
