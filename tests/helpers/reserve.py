"""Forks in reserve, for which multiprocessing starts Python anew: workers of a search or a sweep.

They are forked before a script runs, so that they know no more of it than a Python that is started, and wait
for what it would be started with. Where the reserve is used up, Python is started.
"""

import _posixsubprocess
import fcntl
import json
import os
import runpy
import signal
import socket
import sys
from collections.abc import Callable, Sequence
from typing import Any, NoReturn

Run = Callable[[list[str], str, dict[str, str], Callable[[], object]], NoReturn]

_start_python = _posixsubprocess.fork_exec
_FIRST, _SECOND = 700, 800  # numbers of files that nobody has


def keep(count: int, run: Run) -> None:
    """Have so many forks of this process wait.

    Args:
        count: how many.
        run: what a fork ends with; it takes its command line, its folder, its environment and the program.
    """
    waiting = [_fork(run) for _ in range(count)]

    def start(words: Sequence[Any], executables: Any, close: bool, files: Sequence[int], *more: Any) -> int:
        _, environment = more[:2]
        words = list(map(os.fsdecode, words))
        if waiting and {"-c", "-m"} & set(words):
            request = {
                "words": words,
                "files": list(files),
                "cwd": os.getcwd(),
                "environment": _by_name(environment) if environment else dict(os.environ),
                "blocked": list(signal.pthread_sigmask(signal.SIG_BLOCK, [])),
                "ignored": [n for n in signal.valid_signals() if signal.getsignal(n) is signal.SIG_IGN],
            }
            process, end = waiting.pop(0)
            with end:
                socket.send_fds(end, [json.dumps(request).encode()], files)
            return process
        return int(_start_python(words, executables, close, files, *more))

    _posixsubprocess.fork_exec = start  # `subprocess` has its own reference to it


def _by_name(environment: list[bytes]) -> dict[str, str]:
    pairs = (os.fsdecode(entry).partition("=") for entry in environment)
    return {name: value for name, _, value in pairs}


def _fork(run: Run) -> tuple[int, socket.socket]:
    ours, others = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    process = os.fork()
    if process == 0:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        end = socket.socket(fileno=fcntl.fcntl(others.detach(), fcntl.F_DUPFD_CLOEXEC, _FIRST))
        os.closerange(3, _FIRST)
        content, files, _, _ = socket.recv_fds(end, 2**20, 64)
        if not content:
            os._exit(0)  # the script has ended
        end.close()
        _work(json.loads(content), files, run)
    others.close()
    return process, ours


def _work(request: dict[str, Any], files: list[int], run: Run) -> NoReturn:
    apart = [fcntl.fcntl(file, fcntl.F_DUPFD, _SECOND) for file in files]
    os.closerange(3, _FIRST)
    for file, number in zip(apart, request["files"], strict=True):
        os.dup2(file, number)
        os.close(file)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for number in request["ignored"]:
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_SETMASK, request["blocked"])
    words = request["words"]
    at = min(words.index(option) for option in ("-c", "-m") if option in words)
    what = words[at + 1]

    def program() -> object:
        if words[at] == "-m":
            return runpy.run_module(what, run_name="__main__", alter_sys=True)
        return exec(what, sys.modules["__main__"].__dict__)

    run(["-c", *words[at + 2 :]], request["cwd"], request["environment"], program)
