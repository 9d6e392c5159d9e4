"""GridWorld, solved exactly: environments, observations, agents and their true scores.

Importing this package is free: a public name is loaded when it is first asked for, so that the command
line answers `--help` at once and a program that only steps the environment never pays for torch.
"""

from __future__ import annotations

import importlib

from gridworld.plugin import ENV_ID, register_envs, register_when_gymnasium_is_imported

TYPE_CHECKING = False  # what type checkers take for True; `typing` itself would double the import's cost
if TYPE_CHECKING:
    from gridworld.env import GridWorldEnv
    from gridworld.errors import InputError
    from gridworld.layout import Layout, shipped_layouts
    from gridworld.mdp import Mdp
    from gridworld.observations import (
        CoordinateObservation,
        ImageObservation,
        OneHotObservation,
        VectorCoordinateObservation,
        VectorImageObservation,
        VectorOneHotObservation,
    )
    from gridworld.vector_env import GridWorldVectorEnv

__version__ = "0.1.0"

_HOME = {
    "CoordinateObservation": "observations",
    "GridWorldEnv": "env",
    "GridWorldVectorEnv": "vector_env",
    "ImageObservation": "observations",
    "InputError": "errors",
    "Layout": "layout",
    "Mdp": "mdp",
    "OneHotObservation": "observations",
    "VectorCoordinateObservation": "observations",
    "VectorImageObservation": "observations",
    "VectorOneHotObservation": "observations",
    "shipped_layouts": "layout",
}

__all__ = [
    "ENV_ID",
    "CoordinateObservation",
    "GridWorldEnv",
    "GridWorldVectorEnv",
    "ImageObservation",
    "InputError",
    "Layout",
    "Mdp",
    "OneHotObservation",
    "VectorCoordinateObservation",
    "VectorImageObservation",
    "VectorOneHotObservation",
    "register_envs",
    "shipped_layouts",
]


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module 'gridworld' has no attribute {name!r}")
    return getattr(importlib.import_module(f"gridworld.{_HOME[name]}"), name)


register_when_gymnasium_is_imported()
