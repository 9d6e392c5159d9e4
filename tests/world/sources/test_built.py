"""Worlds that a function of one's own returns."""

import dataclasses

import numpy as np
import pytest

from gridworld import InputError, compile_mdp, load
from gridworld.world.mdp import Mdp
from gridworld.world.outcomes import Outcomes
from gridworld.world.sources.arrays import build
from gridworld.world.sources.classics import river_swim

ARRAYS = {"next_state": [[0]], "reward": [[1.0]], "terminated": [[True]], "start": [1.0]}


def outcomes(**changed):
    tables = {key: np.array(value)[..., None] for key, value in ARRAYS.items()}
    return Outcomes(**{**tables, "probability": np.ones((1, 1, 1)), "start": np.ones(1), **changed})


def arrays(**more):
    return {**ARRAYS, **more}


def slippery_map(slip=0.2):
    return compile_mdp(load("classic"), slip=slip)


def broken():
    return dataclasses.replace(river_swim(), number=np.arange(6) + 1)


def raising(text="no power"):
    raise RuntimeError(text)


def drawn(length=4, seed=None):
    return arrays(reward=[[float(np.random.default_rng(seed).integers(1, 10**9)) / length]])


def test_a_function_that_draws_its_world_needs_a_seed():
    with pytest.raises(InputError, match=r"^env.builder=drawn: makes another world each time .* env.kwargs"):
        build(drawn)
    assert build(drawn, {"seed": 3}).text() == build(drawn, {"seed": 3}).text()


def test_the_three_things_that_a_function_may_return():
    assert build("gridworld.world.sources.classics.river_swim", {"length": 4}).num_states == 4
    assert (build(arrays).name, build(arrays, {"name": "mine"}).name) == ("arrays", "mine")
    assert build(outcomes).name == "outcomes"
    a_map = build(slippery_map, {"slip": 0.4})
    assert type(a_map) is Mdp
    assert a_map.probability[0, 0].tolist() == [0.6, 0.2, 0.2]


@pytest.mark.parametrize(
    ("builder", "kwargs", "told"),
    [
        ("make", None, "env.builder=make: must be the import path of a function"),
        ("no_such_module.make", None, "env.builder=no_such_module.make: there is no module no_such_module"),
        ("gridworld.world.nothing", None, "env.builder=gridworld.world.nothing: must be the import path"),
        ("gridworld.ENV_ID", None, "env.builder=gridworld.ENV_ID: must be the import path"),
        (3, None, "env.builder=3: must be"),
        (
            "os.getcwd",
            None,
            "env.builder=os.getcwd: returned str, must return an Mdp, Outcomes, or a mapping",
        ),
        (raising, None, "env.builder=raising: raised RuntimeError: no power"),
        (raising, {"txt": 1}, "env.builder=raising: raised TypeError: .*unexpected keyword argument 'txt'"),
        (raising, {"text": "one\ntwo"}, "env.builder=raising: raised RuntimeError: one$"),
        (river_swim, {"length": 1}, "env.builder=river_swim: length=1: must be a whole number from 2"),
        (broken, None, "env.builder=broken: state 5 has a number"),
        (arrays, {"start": [0.5]}, "env.builder=arrays: start is"),
        (outcomes, {"start": [1.0]}, "env.builder=outcomes: start is list"),
    ],
)
def test_what_makes_no_world_is_refused(builder, kwargs, told):
    with pytest.raises(InputError, match=f"^{told}"):
        build(builder, kwargs)
