"""Scripts in forks of one process that has imported everything: a process each, at the cost of none.

The process starts with the first script that any of pytest's processes asks for, serves them all, and ends
with the process that started them.
"""

import atexit
import fcntl
import functools
import json
import os
import select
import signal
import socket
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from multiprocessing.reduction import send_handle
from pathlib import Path
from typing import Any

_SCRIPTS = Path(__file__).resolve().parents[2] / "scripts"
_FRESH = dict(os.environ)


@dataclass(frozen=True)
class Ended:
    """How a script ended."""

    code: int
    stdout: str
    stderr: str
    seconds: float


@dataclass(frozen=True)
class Watched(Ended):
    """The same, and what was seen on the way."""

    megabytes: float = 0  # at most, above what the process had to begin with
    deeds: list[str] = field(default_factory=list)  # what the audit hook saw and nobody may do

    @property
    def output(self) -> str:
        """Both streams."""
        return self.stdout + self.stderr


def run(
    name: str,
    *words: str,
    cwd: Path,
    environment: dict[str, str],
    timeout: float,
    stdout: Path | None = None,
) -> Ended:
    """Run one of the scripts in `cwd`, which prints to the file `stdout`, or to what comes back.

    Raises:
        subprocess.TimeoutExpired: It took longer than `timeout` seconds, and was killed.
    """
    return _warm().run(name, words, cwd, {**os.environ, **environment}, timeout, None, stdout)[0]


def run_watched(
    name: str, *words: str, cwd: Path, secret: Path, environment: dict[str, str], timeout: float
) -> Watched:
    """The same of a script that may write to `cwd` and nowhere else; whoever opens `secret` is noted."""
    environment = {**os.environ, "TMPDIR": str(_warm().scratch), **environment}
    ended, seen = _warm().run(name, words, cwd, environment, timeout, str(secret))
    return Watched(**vars(ended), **seen)


class Started:
    """A script at work, like `subprocess.Popen`: its standard error is a pipe, its output is dropped."""

    def __init__(self, name: str, words: tuple[str, ...], cwd: Path, environment: dict[str, str]) -> None:
        """Start it in `cwd`, in a session of its own."""
        end, other = os.pipe()
        self.stderr = os.fdopen(end, encoding="utf-8")
        self.pid = _warm().start(name, words, cwd, {**os.environ, **environment}, other)
        os.close(other)
        self.returncode: int | None = None

    def poll(self) -> int | None:
        """Its exit code; None while it is at work."""
        if self.returncode is None:
            self.returncode = _warm().reap(self.pid)
        return self.returncode

    def wait(self, timeout: float) -> int:
        """Its exit code. Raises `subprocess.TimeoutExpired`."""
        end = time.monotonic() + timeout
        while (code := self.poll()) is None:
            if time.monotonic() > end:
                raise subprocess.TimeoutExpired(str(self.pid), timeout)
            time.sleep(0.01)
        return code

    def communicate(self, timeout: float) -> tuple[None, str]:
        """What is left of its standard error, which its children may hold too, once it has ended."""
        end, told = time.monotonic() + timeout, b""
        while True:
            if not select.select([self.stderr], [], [], max(0.0, end - time.monotonic()))[0]:
                raise subprocess.TimeoutExpired(str(self.pid), timeout, stderr=told)
            part = os.read(self.stderr.fileno(), 2**16)
            if not part:
                break
            told += part
        self.wait(max(1.0, end - time.monotonic()))
        return None, told.decode()

    def send_signal(self, number: int) -> None:
        """Send a signal, unless it has ended."""
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        """Send SIGKILL, unless it has ended."""
        self.send_signal(signal.SIGKILL)

    def __enter__(self) -> "Started":
        return self

    def __exit__(self, kind: object, *error: object) -> None:
        if kind is not None:
            self.kill()
        self.stderr.close()
        self.wait(60)


@functools.cache
def _warm() -> "_Warm":
    return _Warm()


class _Warm:
    """A process of this one's own that forks, and the connection to it. It ends when this one does."""

    def __init__(self) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="forks-")
        self.scratch = Path(self._folder.name) / "scratch"
        self.scratch.mkdir()
        self._connection: Connection[Any, Any] = Connection(_connected().detach())
        self._process = int(self._connection.recv())
        atexit.register(self._end)

    def run(
        self,
        name: str,
        words: tuple[str, ...],
        cwd: Path,
        environment: dict[str, str],
        timeout: float,
        secret: str | None,
        stdout: Path | None = None,
    ) -> tuple[Ended, dict[str, Any]]:
        out, err, report = (Path(self._folder.name) / name for name in ("out", "err", "report"))
        for path in (out, err, report):
            path.write_bytes(b"")
        streams = (os.open(stdout or out, os.O_WRONLY), os.open(err, os.O_WRONLY))
        watched = None if secret is None else {"secret": secret, "report": str(report)}
        process = self._fork(name, words, cwd, environment, streams, watched)
        for stream in streams:
            os.close(stream)
        self._connection.send({"reap": process, "within": timeout})
        code, seconds = self._connection.recv()
        if seconds >= timeout:
            raise subprocess.TimeoutExpired([name, *words], timeout, out.read_bytes(), err.read_bytes())
        ended = Ended(code, _text(out), _text(err), seconds)
        return ended, json.loads(report.read_bytes() or b"{}")

    def start(
        self, name: str, words: tuple[str, ...], cwd: Path, environment: dict[str, str], errors: int
    ) -> int:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        process = self._fork(name, words, cwd, environment, (nowhere, errors), None, session=True)
        os.close(nowhere)
        return process

    def reap(self, process: int) -> int | None:
        self._connection.send({"reap": process, "within": None})
        code, _ = self._connection.recv()
        return code if code is None else int(code)

    def _fork(
        self,
        name: str,
        words: tuple[str, ...],
        cwd: Path,
        environment: dict[str, str],
        streams: tuple[int, int],
        watched: dict[str, str] | None,
        session: bool = False,
    ) -> int:
        self._connection.send(
            {
                "script": str(_SCRIPTS / name),
                "words": list(words),
                "cwd": str(cwd),
                "environment": environment,
                "watched": watched,
                "session": session,
            }
        )
        for stream in streams:
            send_handle(self._connection, stream, self._process)
        return int(self._connection.recv())

    def _end(self) -> None:
        self._connection.close()
        self._folder.cleanup()


def _connected() -> socket.socket:
    """A connection to the warm process, which is started where there is none."""
    owner = os.getppid() if "PYTEST_XDIST_WORKER" in os.environ else os.getpid()
    folder = Path(tempfile.gettempdir()) / f"forks-of-{owner}"
    folder.mkdir(mode=0o700, exist_ok=True)
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        path = folder / "socket"
        ours = socket.socket(socket.AF_UNIX)
        try:
            ours.connect(str(path))
        except OSError:
            path.unlink(missing_ok=True)
            _start(owner, path)
            ours.connect(str(path))
    return ours


def _start(owner: int, path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(path))
        listener.listen()
        listener.set_inheritable(True)
        program = str(Path(__file__).with_name("warm_process.py"))
        os.posix_spawn(
            sys.executable,
            [sys.executable, program, str(listener.fileno()), str(owner)],
            _FRESH,
            file_actions=[
                (os.POSIX_SPAWN_OPEN, 0, os.devnull, os.O_RDONLY, 0),
                (os.POSIX_SPAWN_OPEN, 1, os.devnull, os.O_WRONLY, 0),
            ],
        )


def _text(path: Path) -> str:
    """As `subprocess` would read it."""
    return path.read_text("utf-8")
