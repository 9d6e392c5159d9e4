"""The settings that every tabular agent has. Those of one algorithm stand in its own module."""

from __future__ import annotations

from dataclasses import dataclass

from gridworld.bounds import within
from gridworld.config.agents import AgentConfig
from gridworld.config.texts import Word


@dataclass
class TabularConfig(AgentConfig):
    """An agent that keeps a table over the states."""

    family: Word = "tabular"
    gamma: float = 0.99  # the discount it learns with

    def check(self) -> None:
        """Check the values of these settings."""
        within("agent.gamma", self.gamma, 0, 1)
