"""Random generators: independent ones from one seed, and their exact state as a value."""

from __future__ import annotations

import random
from typing import Any

import numpy as np

from gridworld.storage.serialization import State


def independent_generator(seed: int) -> np.random.Generator:
    """A generator that is independent of the one that the seed itself gives, `np.random.default_rng(seed)`.

    Two generators with the same seed are one stream of numbers used twice. Where both an environment and who
    acts in it draw, actions, slips and starts would depend on each other; one of them takes this generator.

    Returns:
        The generator of the seed's first spawned child; see `numpy.random.SeedSequence.spawn`.
    """
    return np.random.default_rng(np.random.SeedSequence(seed).spawn(1)[0])


def generator_state(generator: np.random.Generator) -> State:
    """The state of one of numpy's generators."""
    state: State = plain_state(generator.bit_generator.state)
    return state


def set_generator_state(generator: np.random.Generator, state: State) -> None:
    """Set a generator to the state of another of its kind.

    Raises:
        ValueError: the state is of another kind.
    """
    generator.bit_generator.state = _as_numpy(state)


def global_state() -> State:
    """The state of the global generators, Python's and numpy's."""
    version, numbers, gauss = random.getstate()
    return {
        "python": {"version": version, "numbers": np.array(numbers, dtype=np.uint32), "gauss": gauss},
        "numpy": plain_state(np.random.get_state(legacy=False)),
    }


def set_global_state(state: State) -> None:
    """Set the global generators to a state.

    Raises:
        ValueError: the state is not of these generators.
    """
    python = state["python"]
    if state["numpy"].keys() != np.random.get_state(legacy=False).keys():
        raise ValueError("numpy's generator has other parts")
    random.setstate((python["version"], tuple(map(int, python["numbers"])), python["gauss"]))
    np.random.set_state(_as_numpy(state["numpy"]))


def set_plain_state(generator: np.random.RandomState, state: State) -> None:
    """Set one of numpy's legacy generators to the state of another.

    Raises:
        ValueError: the state is not of such a generator.
    """
    if state.keys() != generator.get_state(legacy=False).keys():
        raise ValueError("numpy's generator has other parts")
    generator.set_state(_as_numpy(state))


def plain_state(node: Any) -> Any:
    """Replace integers of more than 53 bits by text, so that any reader of JSON keeps them."""
    if isinstance(node, dict):
        return {key: plain_state(value) for key, value in node.items()}
    if isinstance(node, int) and not isinstance(node, bool) and node.bit_length() > 53:
        return f"{node:#x}"
    return node


def _as_numpy(node: Any) -> Any:
    if isinstance(node, dict):
        return {key: _as_numpy(value) for key, value in node.items()}
    return int(node, 16) if isinstance(node, str) and node.startswith("0x") else node
