"""Tabular agents: Q-learning, SARSA, expected SARSA, and the exact optimum.

Nothing here needs more than numpy: a run of these agents never imports torch.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from gridworld.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from gridworld.agents import Agent, TrainingContext
    from gridworld.config.train import AgentConfig, TrainConfig


def schemas() -> dict[str, type[AgentConfig]]:
    """The schema of each algorithm by the algorithm's name."""
    from gridworld.agents.tabular.algorithms import ALGORITHMS

    return {name: schema for name, (schema, _) in ALGORITHMS.items()}


def check(config: TrainConfig) -> None:
    agent = config.agent
    if config.observation.kind != "none":
        what = f"observation={config.observation.kind}"
        raise InputError(f"{what}: agent={agent.name} keeps a table over states; must be none")
    if config.callbacks:
        raise InputError(
            f"callbacks: agent={agent.name} does not call Stable-Baselines3's callbacks; leave them out"
        )
    if config.device not in ("cpu", "auto"):
        raise InputError(f"device={config.device}: agent={agent.name} runs on the CPU; must be cpu")


def import_for(config: AgentConfig) -> None:
    """See `gridworld.agents.Family.import_for`. There is nothing that takes time."""


def on_processor(device: str) -> bool:
    return True


def build(config: AgentConfig, context: TrainingContext) -> Agent:
    from gridworld.agents.tabular.algorithms import ALGORITHMS

    agent: Agent = ALGORITHMS[config.algorithm][1](config, context)
    return agent


def weights(path: Path, most: int) -> dict[str, NDArray[Any]]:
    from gridworld.agents.tabular.td_control import read_arrays

    return read_arrays(path, most)
