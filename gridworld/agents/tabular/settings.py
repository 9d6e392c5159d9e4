"""The settings that every tabular agent has. Those of one algorithm are in its own module."""

from __future__ import annotations

from dataclasses import dataclass, field

from gridworld.config.agents import AgentConfig
from gridworld.config.fields import Word, bounds


@dataclass
class TabularConfig(AgentConfig):
    """An agent that keeps a table over the states."""

    family: Word = "tabular"
    gamma: float = field(default=0.99, metadata=bounds(0, 1))  # the discount it learns with
