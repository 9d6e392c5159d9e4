"""Train agents on worlds small enough to solve exactly, and know whether they are optimal.

    run = gridworld.train("agent=dqn")      # as on the command line; has .summary, .curve, .policy, .model
    gridworld.diagnose(run)                 # why it is not optimal, and what to try
    gridworld.evaluate(model, "cliff")      # the exact score of a Stable-Baselines3 model or a table
    gridworld.make_vec_env("cliff")         # an environment for Stable-Baselines3
    gridworld.ExactEvalCallback()           # exact curves in its own training
    gridworld.check("my_package.MyPPO")     # tests an algorithm on worlds with known answers
    gym.make("gridworld:GridWorld-v0")      # the environment alone

Importing it registers the environment and loads nothing else; torch is imported when a name needs it.
"""

from __future__ import annotations

import importlib

from gridworld.envs.registration import ENV_ID, register_envs
from gridworld.workarounds import when_gymnasium_is_imported

TYPE_CHECKING = False  # what type checkers take for True; `typing` itself would double the import's cost
if TYPE_CHECKING:
    from gridworld.agents.sb3.exact_eval import ExactEvalCallback as ExactEvalCallback
    from gridworld.agents.sb3.vec_env import make_vec_env as make_vec_env
    from gridworld.api.runs import RunResult as RunResult
    from gridworld.api.runs import diagnose as diagnose
    from gridworld.api.runs import open_run as open_run
    from gridworld.api.runs import train as train
    from gridworld.api.settings import compose as compose
    from gridworld.api.worlds import compile_env as compile_env
    from gridworld.api.worlds import evaluate as evaluate
    from gridworld.api.worlds import make_vec as make_vec
    from gridworld.checking.run import CheckResult as CheckResult
    from gridworld.checking.run import check as check
    from gridworld.envs.env import GridWorldEnv as GridWorldEnv
    from gridworld.envs.observations import CoordinateObservation as CoordinateObservation
    from gridworld.envs.observations import ImageObservation as ImageObservation
    from gridworld.envs.observations import OneHotObservation as OneHotObservation
    from gridworld.envs.observations import VectorCoordinateObservation as VectorCoordinateObservation
    from gridworld.envs.observations import VectorImageObservation as VectorImageObservation
    from gridworld.envs.observations import VectorOneHotObservation as VectorOneHotObservation
    from gridworld.envs.vector_env import GridWorldVectorEnv as GridWorldVectorEnv
    from gridworld.errors import InputError as InputError
    from gridworld.world.evaluation import Evaluator as Evaluator
    from gridworld.world.evaluation import Score as Score
    from gridworld.world.grid import compile_mdp as compile_mdp
    from gridworld.world.layout import Layout as Layout
    from gridworld.world.layout import load as load
    from gridworld.world.layout import shipped_layouts as shipped_layouts
    from gridworld.world.mdp import Mdp as Mdp
    from gridworld.world.sources.arrays import load_world as load_world

__version__ = "0.1.0"  # pyproject.toml reads it here

_NAMES = {  # the public names of each module
    "agents.sb3.exact_eval": "ExactEvalCallback",
    "agents.sb3.vec_env": "make_vec_env",
    "api.runs": "RunResult diagnose open_run train",
    "api.settings": "compose",
    "api.worlds": "compile_env evaluate make_vec",
    "checking.run": "CheckResult check",
    "envs.env": "GridWorldEnv",
    "envs.observations": (
        "CoordinateObservation ImageObservation OneHotObservation "
        "VectorCoordinateObservation VectorImageObservation VectorOneHotObservation"
    ),
    "envs.vector_env": "GridWorldVectorEnv",
    "errors": "InputError",
    "world.evaluation": "Evaluator Score",
    "world.grid": "compile_mdp",
    "world.layout": "Layout load shipped_layouts",
    "world.mdp": "Mdp",
    "world.sources.arrays": "load_world",
}
_HOME = {name: module for module, names in _NAMES.items() for name in names.split()}

__all__ = ["ENV_ID", "register_envs", *sorted(_HOME)]


def __dir__() -> list[str]:
    return __all__


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module 'gridworld' has no attribute {name!r}")
    return getattr(importlib.import_module(f"gridworld.{_HOME[name]}"), name)


when_gymnasium_is_imported(register_envs)
