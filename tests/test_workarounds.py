"""What has changed in a dependency when one of `gridworld.base.workarounds` breaks."""

import argparse
import subprocess
import sys

import gymnasium as gym
import numpy as np

from gridworld.base.workarounds import blas_threads, generator_of, let_hydra_parse


def python(code: str) -> str:
    """What a Python that is started anew prints."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return done.stdout.strip()


def test_gymnasium_is_told_of_the_environment_when_it_is_imported() -> None:
    code = "import sys, gridworld; print('gymnasium' in sys.modules); import gymnasium; "
    code += "print(gymnasium.make('GridWorld-v0').spec.id)"
    assert python(code).split() == ["False", "GridWorld-v0"], (
        "the registry's module is another, or has another order"
    )


def test_a_help_that_is_turned_into_text_later_is_taken() -> None:
    class Later:  # as Hydra has one
        def __repr__(self) -> str:
            return "text"

    let_hydra_parse()
    parser = argparse.ArgumentParser()
    parser.add_argument("--completion", help=Later())  # type: ignore[arg-type]
    assert not parser.parse_args([]).completion


def test_what_has_drawn_nothing_has_no_generator() -> None:
    space = gym.spaces.Discrete(2)
    assert generator_of(space) is None
    space.sample()
    assert generator_of(space) is space.np_random, "Gymnasium keeps generators elsewhere"


def test_the_threads_of_numpys_openblas_are_set() -> None:
    if "openblas" not in np.show_config(mode="dicts")["Build Dependencies"]["blas"]["name"]:
        return
    tell, limit = blas_threads()
    before = tell()
    limit(before + 1)
    limited = tell()
    limit(before)
    assert hasattr(tell, "argtypes"), "OpenBLAS's functions have other names"
    assert limited in (before, before + 1)  # it may have been built for so many only


def test_an_optimiser_that_makes_no_step_imports_no_compiler() -> None:
    code = """
import sys, torch
from gridworld.base.workarounds import keep_compiler_out
keep_compiler_out()
weights = torch.ones(2, requires_grad=True)
optimizer = torch.optim.Adam([weights])
optimizer.load_state_dict(optimizer.state_dict())
print("torch._dynamo" in sys.modules)
"""
    assert python(code) == "False", "torch imports its compiler elsewhere"
