"""How many files a newcomer has to read to follow one run: those of which a function is called."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.support import ROOT

MOST = 70

COUNTED = """
import inspect, runpy, sys, threading
import gymnasium, hydra, PIL.Image, scipy.sparse.linalg, stable_baselines3  # not counted, and at full speed
package, seen = sys.argv[1], set()

def called(frame, event, argument):
    code = frame.f_code
    is_function = code.co_flags & inspect.CO_OPTIMIZED and code.co_name[0] != "<"  # no class body
    if event == "call" and is_function and code.co_filename.startswith(package):
        seen.add(code.co_filename)

sys.argv = sys.argv[2:]
threading.setprofile(called)
sys.setprofile(called)
try:
    runpy.run_path(sys.argv[0], run_name="__main__")
finally:
    sys.setprofile(None)
    print("files:", *sorted(path[len(package) + 1 :] for path in seen))
"""


@pytest.mark.slow
def test_a_run_that_was_never_interrupted_calls_few_files_and_none_of_resuming(tmp_path: Path) -> None:
    few = ("total_timesteps=4000", "evaluation.every=1000", "agent.learning_starts=1000")  # no certificate
    words = [str(ROOT / "scripts" / "train.py"), "agent=dqn", *few, "hydra.run.dir=run"]
    done = subprocess.run(
        [sys.executable, "-c", COUNTED, str(ROOT / "gridworld"), *words],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    files = done.stdout.splitlines()[-1].split()[1:]
    assert "training/session.py" in files
    assert not [path for path in files if path.startswith("training/resume")]
    assert len(files) <= MOST, "\n".join(files)
