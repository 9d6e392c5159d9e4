"""Algorithms of Stable-Baselines3, of sb3-contrib and custom ones, which learn on the native batch.

The functions are those of `gridworld.agents.Family`. Only building an agent imports torch.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from gridworld.agents.sb3.settings import SCHEMAS, SB3Config, check

if TYPE_CHECKING:
    from pathlib import Path
    from typing import Any

    from numpy.typing import NDArray

    from gridworld.agents import Agent, TrainingContext
    from gridworld.config.train import AgentConfig

__all__ = ["build", "check", "import_for", "on_processor", "schemas", "weights"]


def schemas() -> dict[str, type[AgentConfig]]:
    """See `gridworld.agents.Family`, as for the others."""
    return SCHEMAS


def import_for(config: AgentConfig) -> None:
    """Nothing is computed, which would keep torch from forking."""
    from gridworld.agents.sb3 import agent  # noqa: F401


def on_processor(device: str) -> bool:
    """True of names that `build` refuses."""
    from stable_baselines3.common.utils import get_device

    try:
        return get_device(device).type == "cpu"
    except RuntimeError:
        return True


def build(config: AgentConfig, context: TrainingContext) -> Agent:
    """In the engine or in SB3's own loop."""
    from gridworld.agents.sb3.agent import build

    assert isinstance(config, SB3Config)
    return build(config, context)


def weights(path: Path, most: int) -> dict[str, NDArray[Any]]:
    """The optimiser's tensors are among them."""
    from gridworld.agents.sb3.model_file import read_weights

    return read_weights(path, most)
