"""GridWorld, solved exactly: environments, observations, agents and their true scores.

Importing this package registers `GridWorld-v0` with Gymnasium and imports nothing else: a public name is
loaded when it is first asked for, so that the command line answers `--help` at once and a program that only
steps the environment never pays for torch.
"""

from __future__ import annotations

import importlib

from gridworld.envs.registration import ENV_ID, register_envs, register_when_gymnasium_is_imported

TYPE_CHECKING = False  # what type checkers take for True; `typing` itself would double the import's cost
if TYPE_CHECKING:
    from gridworld.agents.sb3.exact_eval import ExactEvalCallback
    from gridworld.agents.sb3.vec_env import make_vec_env
    from gridworld.api.checking import CheckResult, check
    from gridworld.api.diagnosis import diagnose
    from gridworld.api.runs import RunResult, open_run, train
    from gridworld.api.scores import evaluate
    from gridworld.api.settings import compose
    from gridworld.api.worlds import compile_env, make_vec
    from gridworld.envs.env import GridWorldEnv
    from gridworld.envs.observations import (
        CoordinateObservation,
        ImageObservation,
        OneHotObservation,
        VectorCoordinateObservation,
        VectorImageObservation,
        VectorOneHotObservation,
    )
    from gridworld.envs.vector_env import GridWorldVectorEnv
    from gridworld.errors import InputError
    from gridworld.world.exact.evaluation import Evaluator, Score
    from gridworld.world.grid import compile_mdp
    from gridworld.world.layout import Layout, load, shipped_layouts
    from gridworld.world.mdp import Mdp
    from gridworld.world.sources.arrays import load_world

__version__ = "0.1.0"

_HOME = {
    "CheckResult": "api.checking",
    "CoordinateObservation": "envs.observations",
    "Evaluator": "world.exact.evaluation",
    "ExactEvalCallback": "agents.sb3.exact_eval",
    "GridWorldEnv": "envs.env",
    "GridWorldVectorEnv": "envs.vector_env",
    "ImageObservation": "envs.observations",
    "InputError": "errors",
    "Layout": "world.layout",
    "Mdp": "world.mdp",
    "OneHotObservation": "envs.observations",
    "RunResult": "api.runs",
    "Score": "world.exact.evaluation",
    "VectorCoordinateObservation": "envs.observations",
    "VectorImageObservation": "envs.observations",
    "VectorOneHotObservation": "envs.observations",
    "check": "api.checking",
    "compile_env": "api.worlds",
    "compile_mdp": "world.grid",
    "compose": "api.settings",
    "diagnose": "api.diagnosis",
    "evaluate": "api.scores",
    "load": "world.layout",
    "load_world": "world.sources.arrays",
    "make_vec": "api.worlds",
    "make_vec_env": "agents.sb3.vec_env",
    "open_run": "api.runs",
    "shipped_layouts": "world.layout",
    "train": "api.runs",
}

__all__ = [
    "ENV_ID",
    "CheckResult",
    "CoordinateObservation",
    "Evaluator",
    "ExactEvalCallback",
    "GridWorldEnv",
    "GridWorldVectorEnv",
    "ImageObservation",
    "InputError",
    "Layout",
    "Mdp",
    "OneHotObservation",
    "RunResult",
    "Score",
    "VectorCoordinateObservation",
    "VectorImageObservation",
    "VectorOneHotObservation",
    "check",
    "compile_env",
    "compile_mdp",
    "compose",
    "diagnose",
    "evaluate",
    "load",
    "load_world",
    "make_vec",
    "make_vec_env",
    "open_run",
    "register_envs",
    "shipped_layouts",
    "train",
]


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module 'gridworld' has no attribute {name!r}")
    return getattr(importlib.import_module(f"gridworld.{_HOME[name]}"), name)


register_when_gymnasium_is_imported()
