"""A student's notebook in a process of its own, asked by plain data over a pipe.

What comes back is untrusted: it is read as JSON within bounds, never unpickled, and compared in this process.
The other process has limits on memory and time (`fence`), and what it has started ends with it.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import selectors
import signal
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

_TABLES = ("num_states", "num_actions", "next_state", "probability", "reward", "terminal", "start")
_MOST_STOPPED = 3  # cells; what comes after so many is not run
_SECONDS_TO_START = 60.0
_TAKE_ORPHANS = 36  # for prctl: whose parent has ended becomes this process's child
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
        self._until = 0.0

    def __enter__(self) -> Self:
        self._others = _children()
        _prctl(_TAKE_ORPHANS, 1)
        return self

    def __exit__(self, *error: object) -> None:
        self._end()
        _prctl(_TAKE_ORPHANS, 0)

    def begin(self) -> None:
        """Begin an exercise: its time counts from now. If the process was lost, the cells run again."""
        while self._process is None:
            self._start()
        self._until = time.monotonic() + self._seconds

    def call(self, function: str, *arguments: Any) -> Any:
        """Call a function with numbers, text, lists, arrays and worlds.

        A world arrives with its tables as attributes: `next_state`, `probability`, `reward`, `terminal`,
        `start`, `num_states` and `num_actions`, as an `Mdp` has them.

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
        self._process = subprocess.Popen(
            [sys.executable, "-I", "-B", str(Path(__file__).with_name("fence.py"))],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            cwd=self._folder.name,
            env=_ENVIRONMENT | {"HOME": self._folder.name},
            start_new_session=True,
        )
        self._until = time.monotonic() + _SECONDS_TO_START
        hello = self._exchange("its process", self._settings)
        self.fenced = bool(hello.get("fenced"))
        for number, source in list(self._cells.items()):
            self._until = time.monotonic() + self._seconds
            try:
                self._ask("it", {"cell": number, "source": source})
            except WrongAnswerError as error:
                self.failed[number] = str(error).removeprefix("it ")
            if self._process is None:
                del self._cells[number]
                if len(self.failed.keys() - self._cells.keys()) >= _MOST_STOPPED:
                    rest = [each for each in self._cells if each > number]
                    self.failed |= dict.fromkeys(rest, "was not run, since others had to be stopped")
                    self._cells = {each: self._cells[each] for each in self._cells if each < number}
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
        try:
            return as_object(self._transfer(json.dumps(request).encode() + b"\n"), Path("the reply"))
        except TimeoutError:
            self._end()
            raise WrongAnswerError(f"{what} took more than {self._seconds:g} s") from None
        except OSError:
            self._end()
            raise WrongAnswerError(f"{what} ended its process: it exited, crashed or had no memory") from None
        except InputError:
            self._end()
            raise WrongAnswerError(
                f"{what} gave an answer other than finite numbers, text and lists"
            ) from None

    def _transfer(self, request: bytes) -> bytes:
        """Write a line to the process and read one; raises `TimeoutError` at the deadline."""
        assert self._process is not None
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        into, out_of = self._process.stdin.fileno(), self._process.stdout.fileno()
        os.set_blocking(into, False)
        reply = bytearray()
        with selectors.DefaultSelector() as selector:
            selector.register(into, selectors.EVENT_WRITE)
            selector.register(out_of, selectors.EVENT_READ)
            while True:
                ready = selector.select(max(0.0, self._until - time.monotonic()))
                if not ready:
                    raise TimeoutError
                for key, _ in ready:
                    if key.fd == into:
                        request = request[os.write(into, request) :]
                        if not request:
                            selector.unregister(into)
                        continue
                    reply += (part := os.read(out_of, 2**16))
                    if not part:
                        raise BrokenPipeError
                    if len(reply) > LARGEST_JSON:
                        raise InputError("the reply is too large")
                if reply.endswith(b"\n"):
                    return bytes(reply)

    def _end(self) -> None:
        """Kill the process and all that it has started."""
        process, self._process = self._process, None
        if process is None:
            return
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        for pipe in (process.stdin, process.stdout):
            if pipe is not None:
                pipe.close()
        while left := _children() - self._others:
            for pid in left:
                with contextlib.suppress(ProcessLookupError, ChildProcessError):
                    os.kill(pid, signal.SIGKILL)
                    os.waitpid(pid, 0)
        self._folder.cleanup()


def _encoded(value: Any) -> Any:
    if isinstance(value, Mdp):
        return {name: _encoded(getattr(value, name)) for name in _TABLES}
    if isinstance(value, np.ndarray):
        return {"array": value.tolist(), "type": value.dtype.str}
    return value


def _children() -> set[int]:
    """The children of this process that have left its session."""
    found, own = set(), (str(os.getpid()), str(os.getsid(0)))
    for process in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            _, parent, _, session = process.read_text().rpartition(")")[2].split()[:4]
            if parent == own[0] and session != own[1]:
                found.add(int(process.parent.name))
    return found


def _prctl(option: int, value: int) -> None:
    ctypes.CDLL(None).prctl(option, value, 0, 0, 0)
