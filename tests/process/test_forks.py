"""How the tests start scripts: in a fork of a warm process one runs as in a process of its own."""

import json
import re
from pathlib import Path

import pytest
from helpers.resuming import differences, left_behind
from helpers.support import SHORT, script

PROBE = """
import atexit, json, os, random, signal, sys, threading
import __main__
chances, libraries = [random.random()], {}
if sys.argv[1] == "nothing":  # the same for every end, and importing them takes long
    import numpy, torch
    from hydra.core.global_hydra import GlobalHydra
    chances += [numpy.random.random(), torch.rand(1).item()]
    libraries = {"threads": torch.get_num_threads(), "hydra": GlobalHydra.instance().is_initialized()}
atexit.register(print, "at the end")
threading.Timer(1, print, ["a thread"]).start()
print(json.dumps({
    "argv": sys.argv, "path": sys.path, "cwd": os.getcwd(), "main": __main__.__file__, "name": __name__,
    "environment": {k: v for k, v in os.environ.items() if k not in ("_", "LC_CTYPE", "PYTEST_CURRENT_TEST")},
    "handlers": [str(signal.getsignal(number)) for number in signal.valid_signals()],
    "blocked": [int(number) for number in signal.pthread_sigmask(signal.SIG_BLOCK, [])],
    "streams": [(s.encoding, s.errors, s.line_buffering, s.isatty()) for s in (sys.stdout, sys.stderr)],
    "stdin": sys.stdin.read(), **libraries,
}))
print(*chances)
if sys.argv[1] == "raise":
    raise RuntimeError("on purpose")
sys.exit({"message": "a message", "number": 7, "nothing": None}[sys.argv[1]])
"""


@pytest.mark.parametrize("end", ["number", "nothing", "raise"])
def test_a_fork_starts_and_ends_as_a_process_of_its_own(end: str, tmp_path: Path) -> None:
    probe = tmp_path / "probe.py"
    probe.write_text(PROBE)
    (tmp_path / "own").mkdir()
    chance, told = [], []
    for real in (True, False, False):
        done = script(str(probe), end, cwd=tmp_path, real=real, PYTHONPATH=str(tmp_path / "own"), ONE="1")
        lines = done.stdout.splitlines()
        chance += next(line for line in lines if re.fullmatch(r"[\d.e-]+( [\d.e-]+){0,2}", line)).split()
        state = json.loads(next(line for line in lines if line.startswith("{")))
        assert lines[-2:] == ["a thread", "at the end"]
        told.append((done.returncode, state, done.stderr.splitlines()[-1:]))
    assert told[1] == told[0]
    assert told[2] == told[0]
    assert len(set(chance)) == len(chance)


def test_a_run_in_a_fork_has_the_same_files_and_output(tmp_path: Path) -> None:
    printed = []
    for real in (True, False):
        cwd = tmp_path / str(real)
        cwd.mkdir()
        done = script("train.py", *SHORT["dqn"], "hydra.run.dir=run", cwd=cwd, real=real)
        assert done.returncode == 0, done.stderr
        printed.append(re.sub(r"[\d.]+ (s|ms|steps/s)\b", "#", done.stdout))
    assert printed[0] == printed[1]
    one, other = (left_behind(tmp_path / name / "run") for name in ("True", "False"))
    assert differences(one, other) == []
