"""GridWorld, solved exactly: environments, observations, agents and their true scores.

Importing this package registers `GridWorld-v0` with Gymnasium and imports nothing else: a public name is
loaded when it is first asked for, so that the command line answers `--help` at once and a program that only
steps the environment never pays for torch. The names are in `__init__.pyi`.
"""

from gridworld.envs.registration import register_envs as _register_envs
from gridworld.workarounds import when_gymnasium_is_imported as _when_gymnasium_is_imported

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
