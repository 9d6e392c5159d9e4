"""Algorithms of Stable-Baselines3, of sb3-contrib and custom ones, which learn on the native batch.

Settings are checked without importing torch, as far as they can be; building an agent imports it.
"""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

from gridworld.agents.sb3.settings import SCHEMAS, SB3Config, check
from gridworld.errors import InputError

if TYPE_CHECKING:
    from pathlib import Path
    from typing import Any

    from numpy.typing import NDArray

    from gridworld.agents import Agent, TrainingContext
    from gridworld.config.train import AgentConfig

__all__ = ["build", "check", "import_for", "on_processor", "schemas", "weights"]


def schemas() -> dict[str, type[AgentConfig]]:
    """See `gridworld.agents.Family.schemas`."""
    return SCHEMAS


def import_for(config: AgentConfig) -> None:
    """See `gridworld.agents.Family.import_for`. Nothing is computed, which would keep torch from forking."""
    from gridworld.agents.sb3 import agent  # noqa: F401
    from gridworld.agents.sb3.factory import algorithm_and_arguments

    assert isinstance(config, SB3Config)
    with contextlib.suppress(InputError):
        algorithm_and_arguments(config)


def on_processor(device: str) -> bool:
    """See `gridworld.agents.Family.on_processor`; true of names that `build` refuses."""
    from stable_baselines3.common.utils import get_device

    try:
        return get_device(device).type == "cpu"
    except RuntimeError:
        return True


def build(config: AgentConfig, context: TrainingContext) -> Agent:
    """See `gridworld.agents.Family.build`."""
    from gridworld.agents.sb3.agent import build

    assert isinstance(config, SB3Config)
    return build(config, context)


def weights(path: Path, most: int) -> dict[str, NDArray[Any]]:
    """See `gridworld.agents.Family.weights`; the optimiser's tensors are among them."""
    from gridworld.agents.sb3.model_file import read_weights

    return read_weights(path, most)
