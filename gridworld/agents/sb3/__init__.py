"""Stable-Baselines3: DQN, PPO, and the adapter that lets them learn on the native batch.

Settings are checked without importing torch, as far as they can be; building an agent imports it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from gridworld.agents.sb3.checks import check

if TYPE_CHECKING:
    from pathlib import Path
    from typing import Any

    from numpy.typing import NDArray

    from gridworld.agent_config import AgentConfig
    from gridworld.agents import Agent, Seat

__all__ = ["build", "check", "weights"]


def build(config: AgentConfig, seat: Seat) -> Agent:
    """An SB3 model on the seat's environments."""
    from gridworld.agents.sb3.agent import SB3Agent

    return SB3Agent(config, seat)


def weights(path: Path, most: int) -> dict[str, NDArray[Any]]:
    """The tensors of a model file, those of the optimiser too."""
    from gridworld.agents.sb3.model_file import read_weights

    return read_weights(path, most)
