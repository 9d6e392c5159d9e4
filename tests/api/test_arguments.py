"""Arguments that are none of a kind, and amounts that no machine has, are answered in a sentence."""

import inspect
import io
import os
import subprocess
import sys
import traceback
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import gridworld
from gridworld import InputError

WRONG = (None, 5, "x", [], object(), -1.5, b"q")
OWN_WORDS = ("train", "sweep", "tune")  # whose arguments are settings
FUNCTIONS = [
    name
    for name in gridworld.__all__
    if name not in OWN_WORDS and (inspect.isfunction(getattr(gridworld, name)) or name == "Evaluator")
]


@pytest.mark.parametrize("name", FUNCTIONS)
def test_no_public_function_answers_in_the_words_of_a_library(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A wrong argument is refused by ours or by Python's own call, never by what is called inside."""
    monkeypatch.chdir(tmp_path)
    function: Any = getattr(gridworld, name)
    needed = [each for each in inspect.signature(function).parameters.values() if each.default is each.empty]
    count = max(1, sum(each.kind in (0, 1) for each in needed))
    for value in WRONG:
        told, depth = "", 1
        try:
            function(*[value] * count)
        except InputError as error:
            told = str(error)
        except TypeError as error:
            depth = len(traceback.extract_tb(error.__traceback__))
        assert "\n" not in told
        assert depth == 1, (name, value)


def test_amounts_are_refused_before_they_are_made(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"^num_envs=1000000000: must be from 1 to"):
        gridworld.make_vec_env(n_envs=10**9)
    for name, shape in (("start", (2**27,)), ("next_state", (2**17, 2**40)), ("reward", (2**62,))):
        header = io.BytesIO()  # and no numbers after it
        np.lib.format.write_array_header_1_0(header, {"descr": "<i8", "fortran_order": False, "shape": shape})
        with zipfile.ZipFile(tmp_path / "world.npz", "w") as archive:
            archive.writestr(f"{name}.npy", header.getvalue())
        with pytest.raises(InputError, match=r"world.npz: not an .npz file of arrays that can be read"):
            gridworld.load_world(tmp_path / "world.npz")


@pytest.mark.parametrize("name", OWN_WORDS)
def test_a_folder_that_is_no_path_or_the_root_is_refused(name: str) -> None:
    call, before = getattr(gridworld, name), os.listdir("/")
    for folder in (5, ["x"], b"x", "a\0b"):
        with pytest.raises(InputError, match=f"^{name}: folder=.*: must be a path, a str or a Path$"):
            call("agent=q_learning", "total_timesteps=64", folder=folder)
    with pytest.raises(InputError, match=r"^folder=/: is the root of the file system"):
        call("agent=q_learning", "total_timesteps=64", folder="/")
    assert os.listdir("/") == before


def test_a_path_that_is_too_long_is_no_folder() -> None:
    with pytest.raises(InputError, match="no such folder; give the folder of a run"):
        gridworld.open_run("x" * 5000)


def test_too_little_memory_is_said() -> None:
    limits = "import resource; resource.setrlimit(resource.RLIMIT_AS, (400_000_000,) * 2)"
    code = f"{limits}; from gridworld.commands import call; call('train')"
    words = [sys.executable, "-c", code, "agent=dqn"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=180)
    assert done.returncode == 2
    assert "not enough memory" in done.stderr.splitlines()[-1]
    assert "Traceback" not in done.stderr
