"""Train agents on worlds small enough to solve exactly, and know whether they are optimal.

    run = gridworld.train("agent=dqn")      # as on the command line; has .summary, .curve, .policy, .model
    gridworld.diagnose(run)                 # why it is not optimal, and what to try
    gridworld.evaluate(model, "cliff")      # the exact score of a Stable-Baselines3 model or a table
    gridworld.make_vec_env("cliff")         # an environment for Stable-Baselines3
    gridworld.ExactEvalCallback()           # exact curves in its own training
    gridworld.check("my_package.MyPPO")     # tests an algorithm on worlds with known answers
    gridworld.examine(env)                  # why nothing learns in an environment, and what to change
    gridworld.playground("cliff")           # a page on which you draw worlds and watch Q-learning
    gym.make("gridworld:GridWorld-v0")      # the environment alone

Importing it registers the environment and loads nothing else; torch is imported when a name needs it.
The names are in `__init__.pyi`.
"""

from gridworld.base.workarounds import when_gymnasium_is_imported as _when_gymnasium_is_imported
from gridworld.envs.registration import register_envs as _register_envs

__version__ = "0.1.0"  # pyproject.toml reads it here

with open(f"{__file__}i", encoding="utf-8") as _file:  # "from MODULE import NAME as NAME"
    _MODULES = {line.split()[-1]: line.split()[1] for line in _file if line.startswith("from ")}

__all__ = list(_MODULES)


def __dir__() -> list[str]:
    return __all__


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f"module 'gridworld' has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(_MODULES[name]), name)


_when_gymnasium_is_imported(_register_envs)
