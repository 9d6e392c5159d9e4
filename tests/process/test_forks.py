"""How the tests start scripts: in a fork of a warm process one runs as in a process of its own."""

import json
import os
import signal
from multiprocessing import forkserver
from pathlib import Path

import pytest
from helpers.support import script

PROBE = """
import atexit, json, os, random, signal, sys, threading
import multiprocessing, __main__, numpy, torch
child = multiprocessing.get_context("fork").Process(target=int)
child.start(), child.join()
atexit.register(print, "at the end")
threading.Timer(1, print, ["a thread"]).start()
print(json.dumps({
    "argv": sys.argv, "path": sys.path, "cwd": os.getcwd(), "main": __main__.__file__, "name": __name__,
    "environment": {k: v for k, v in os.environ.items() if k not in ("_", "LC_CTYPE", "PYTEST_CURRENT_TEST")},
    "handlers": [str(signal.getsignal(number)) for number in signal.valid_signals()],
    "blocked": [int(number) for number in signal.pthread_sigmask(signal.SIG_BLOCK, [])],
    "streams": [(s.encoding, s.errors, s.line_buffering, s.isatty()) for s in (sys.stdout, sys.stderr)],
    "stdin": sys.stdin.read(), "threads": torch.get_num_threads(), "child": child.exitcode,
}))
print(random.random(), numpy.random.random(), torch.rand(1).item())
raise RuntimeError("on purpose")
"""


@pytest.mark.slow
def test_a_fork_starts_and_ends_as_a_process_of_its_own(tmp_path: Path) -> None:
    (tmp_path / "probe.py").write_text(PROBE)
    (tmp_path / "own").mkdir()
    chance, told = [], []
    for real in (True, False, False):
        if len(told) == 2:  # a server that has died is started again
            os.kill(forkserver._forkserver._forkserver_pid, signal.SIGKILL)
            os.waitid(os.P_PID, forkserver._forkserver._forkserver_pid, os.WEXITED | os.WNOWAIT)
        own = {"PYTHONPATH": str(tmp_path / "own"), "ONE": "1"}
        done = script(str(tmp_path / "probe.py"), "a word", cwd=tmp_path, real=real, **own)
        state, numbers, *ends = done.stdout.splitlines()
        assert ends == ["a thread", "at the end"]
        chance += numbers.split()
        told.append((done.returncode, json.loads(state), done.stderr.splitlines()[-1:]))
    assert told[2] == told[1] == told[0]
    assert len(set(chance)) == len(chance) == 9
