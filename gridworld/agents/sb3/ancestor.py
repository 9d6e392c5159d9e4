"""The library's own class in the place of one that is derived from it."""

from __future__ import annotations

import dataclasses
import inspect

from gridworld.agents.sb3.settings.constructor_arguments import algorithm_class
from gridworld.agents.sb3.settings.schemas import SB3ClassConfig
from gridworld.config.agents import AgentConfig

_LIBRARIES = ("stable_baselines3", "sb3_contrib")


def of_library(config: AgentConfig) -> SB3ClassConfig | None:
    """The same settings for the algorithm of Stable-Baselines3 or sb3-contrib that a class is derived from.

    Returns:
        The settings, without arguments that only the derived class takes; None: it is the library's own, or
        derived from no algorithm that could train.
    """
    if not isinstance(config, SB3ClassConfig):
        return None
    kinds = algorithm_class("agent.algorithm", config.algorithm).__mro__
    first = next((kind for kind in kinds if kind.__module__.split(".")[0] in _LIBRARIES), None)
    if first in (None, kinds[0]) or not getattr(first, "policy_aliases", None):
        return None
    known = inspect.signature(first).parameters
    arguments = {name: value for name, value in config.arguments.items() if name in known}
    path = f"{first.__module__.split('.')[0]}.{first.__name__}"
    return dataclasses.replace(config, algorithm=path, arguments=arguments, engine="tabulated")
