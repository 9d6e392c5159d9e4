"""A student's notebook in a process of its own, asked by plain data over a socket.

What comes back is untrusted: it is read as JSON within bounds, never unpickled, and compared in this process.
The other process has limits on memory and time (`fence`), and its group ends with it.
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
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np

from gridworld.base.errors import InputError
from gridworld.base.safe_read import LARGEST_JSON, as_object
from gridworld.world.mdp import FloatArray, Mdp

_TABLES = ("num_states", "num_actions", "next_state", "probability", "reward", "terminal", "start", "number")
_MOST_STOPPED = 3  # cells; what comes after so many is not run
_SECONDS_TO_START = 60.0
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
        hidden: folders that it must not read.

    Attributes:
        failed: by the number of a cell, why it could not be run.
        fenced: whether the system keeps the process away from other files (Linux 5.13 or newer).
    """

    def __init__(
        self, cells: Mapping[int, str], seconds: float, memory: int, hidden: Sequence[Path] = ()
    ) -> None:
        self.failed: dict[int, str] = {}
        self.fenced = True
        self._cells, self._seconds = dict(cells), seconds
        self._settings = {"memory": memory, "hidden": [str(path.resolve()) for path in hidden]}
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
        """Run further code of the marking's own in the notebook, which is no safer there."""
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
        """Call a function that must return an array of numbers of this shape; see `call`."""
        found = self.call(function, *arguments)
        try:
            array = np.array(found, dtype=np.float64)
        except (TypeError, ValueError):
            raise WrongAnswerError(f"`{function}` must return an array of numbers") from None
        if array.shape != shape:
            raise WrongAnswerError(f"`{function}` returned the shape {array.shape}, must be {shape}")
        return array

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
                [sys.executable, "-I", "-B", str(Path(__file__).with_name("fence.py"))],
                stdin=theirs.fileno(),
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                cwd=self._folder.name,
                env=_ENVIRONMENT | {"HOME": self._folder.name},
                start_new_session=True,
            )
        self._until = time.monotonic() + _SECONDS_TO_START
        try:
            self.fenced = bool(self._exchange("the notebook", self._settings).get("fenced"))
        except WrongAnswerError as error:
            raise InputError(f"{error}, before its first cell; give it more memory") from None
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
            while True:  # what else it may have sent is no reply
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
        """Let the next call of the socket wait until the deadline."""
        self._socket.settimeout(max(0.001, self._until - time.monotonic()))

    def _end(self) -> None:
        if self._process is None:
            return
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        self._process = None
        self._socket.close()
        self._folder.cleanup()


def _encoded(value: Any) -> Any:
    if isinstance(value, Mdp):
        return {name: _encoded(getattr(value, name)) for name in _TABLES}
    if isinstance(value, np.ndarray):
        return {"array": value.tolist(), "type": value.dtype.str}
    return value
