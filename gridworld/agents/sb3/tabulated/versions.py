"""Which of SB3's classes have a version that runs the network once per state."""

from __future__ import annotations

import importlib

from stable_baselines3.common.base_class import BaseAlgorithm

# By the modules that define SB3's classes: sb3-contrib, which need not be installed, is not imported to know.
_MODULES = {
    "stable_baselines3.a2c.a2c": "a2c",
    "stable_baselines3.dqn.dqn": "dqn",
    "stable_baselines3.ppo.ppo": "ppo",
    "sb3_contrib.qrdqn.qrdqn": "qrdqn",
    "sb3_contrib.trpo.trpo": "trpo",
}


def tabulated_version(algorithm: type[BaseAlgorithm]) -> type[BaseAlgorithm] | None:
    """Find the class that learns the same as one of SB3's with the network run once per state.

    Args:
        algorithm: SB3's class.

    Returns:
        The class; None: there is none for this one.
    """
    module = _MODULES.get(algorithm.__module__)
    if module is None:
        return None
    found = importlib.import_module(f"gridworld.agents.sb3.tabulated.{module}")
    version: type[BaseAlgorithm] = getattr(found, f"Tabulated{algorithm.__name__}")
    return version
