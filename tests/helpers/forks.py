"""Scripts in forks of one process that has imported everything: a process each, at the cost of none.

The process is multiprocessing's fork server, which imports `helpers.warm` when the first script is started.
"""

import importlib
import json
import multiprocessing
import os
import signal
import subprocess
import threading
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

TESTS = Path(__file__).resolve().parents[1]
_FRESH = dict(os.environ)
_CONTEXT = multiprocessing.get_context("forkserver")
_CONTEXT.set_forkserver_preload(["helpers.warm"])


@dataclass(frozen=True)
class Ended:
    """How a script ended."""

    code: int
    stdout: str
    stderr: str
    # Of one that was watched: the most memory, above what the process had to begin with; processor time, its
    # children's included; and what the audit hook saw and nobody may do.
    megabytes: float = 0
    seconds: float = 0
    deeds: list[str] = field(default_factory=list)

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
    secret: Path | None = None,
) -> Ended:
    """Run one of the scripts in `cwd`, which prints to the file `stdout`, or to what comes back.

    With `secret` it may write to `cwd` and nowhere else, and whoever opens a file of that name is noted.
    Where it takes longer than `timeout` seconds it is killed, and `subprocess.TimeoutExpired` raised.
    """
    with TemporaryDirectory(prefix="forks-") as place:
        out, err, report = stdout or Path(place) / "out", Path(place) / "err", Path(place) / "report"
        watched = None
        if secret is not None:
            environment = {"TMPDIR": place, **environment}
            watched = (str(secret), str(report))
        process = _start(name, words, cwd, environment, str(out), str(err), watched)
        process.join(timeout)
        if process.exitcode is None:
            process.kill()
            process.join()
            raise subprocess.TimeoutExpired([name, *words], timeout, None, err.read_bytes())
        seen = json.loads(report.read_text()) if report.is_file() else {}
        printed = "" if stdout is not None else out.read_text("utf-8")  # of /dev/full there would be no end
        return Ended(process.exitcode, printed, err.read_text("utf-8"), **seen)


class Started:
    """A script at work, like `subprocess.Popen`: its standard error is a pipe, its output is dropped."""

    def __init__(self, name: str, words: tuple[str, ...], cwd: Path, environment: dict[str, str]) -> None:
        """Start it in `cwd`, in a session of its own."""
        ours, theirs = multiprocessing.Pipe(duplex=False)
        self.stderr = os.fdopen(os.dup(ours.fileno()), encoding="utf-8")
        self._process = _start(name, words, cwd, environment, os.devnull, theirs, None)
        theirs.close()
        ours.close()
        self.pid: int = self._process.pid

    @property
    def returncode(self) -> int | None:
        """Its exit code; None while it is at work."""
        return self._process.exitcode

    def poll(self) -> int | None:
        """The same, as `subprocess.Popen` has it."""
        return self.returncode

    def wait(self, timeout: float) -> int:
        """Its exit code. Raises `subprocess.TimeoutExpired`."""
        self._process.join(timeout)
        if self.returncode is None:
            raise subprocess.TimeoutExpired(str(self.pid), timeout)
        return self.returncode

    def communicate(self, timeout: float) -> tuple[None, str]:
        """What is left of its standard error, which its children may hold too, once it has ended."""
        killer = threading.Timer(timeout, os.killpg, (self.pid, signal.SIGKILL))
        killer.start()
        told = self.stderr.read()
        killer.cancel()
        self.wait(timeout)
        return None, told

    def send_signal(self, number: int) -> None:
        """Send a signal, unless it has ended."""
        if self.returncode is None:
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
        self.wait(180)


def megabytes(name: str) -> float:
    """A number of this process's memory, as /proc has it."""
    return int(Path("/proc/self/status").read_text().split(f"{name}:")[1].split()[0]) / 1024


def _start(
    name: str,
    words: tuple[str, ...],
    cwd: Path,
    environment: dict[str, str],
    out: str,
    err: "str | Connection[Any, Any]",
    watched: tuple[str, str] | None,
) -> Any:
    script = str(TESTS.parent / "scripts" / name)
    given = ([script, *words], str(cwd), {**os.environ, **environment}, watched)
    process = _CONTEXT.Process(target=_run, args=(out, err, *given), daemon=True)
    now = dict(os.environ)
    path = os.pathsep.join([str(TESTS), _FRESH.get("PYTHONPATH", "")])
    try:  # the server is started here, at first and where it has died, and knows nothing of the test
        os.environ.clear()
        os.environ.update(_FRESH, PYTHONPATH=path)
        process.start()
    finally:
        os.environ.clear()
        os.environ.update(now)
    return process


def _run(out: str, err: "str | Connection[Any, Any]", *given: Any) -> None:
    files = [os.open(name, os.O_WRONLY | os.O_CREAT) for name in (out, err) if isinstance(name, str)]
    os.dup2(files[0], 1)
    os.dup2(files[1] if isinstance(err, str) else err.fileno(), 2)
    if not isinstance(err, str):
        err.close()
        os.setsid()
    for file in files:
        os.close(file)
    importlib.import_module("helpers.warm").run(*given)  # the server's; or says why that has none
