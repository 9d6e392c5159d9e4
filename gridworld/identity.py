"""What makes a run this run, and what the machine adds to it.

Two runs of one identity do the same, as far as it is up to their settings. To the last bit they do it only in
the same environment: other versions or another processor round differently.
"""

from __future__ import annotations

import dataclasses
import json
from typing import Any

from gridworld.agent_config import AgentConfig, SB3Config
from gridworld.config import TrainConfig
from gridworld.data_files import sha256
from gridworld.provenance import code, processor, versions

_MATTER = ("python", "gridworld", "gymnasium", "numpy", "scipy")  # to every agent
_MATTER_TO_NETWORKS = ("stable-baselines3", "sb3-contrib", "torch")


def settings(config: TrainConfig) -> dict[str, Any]:
    """Those that a run cannot change on its way: all but its length, its checkpoints and its progress bar."""
    content = dataclasses.asdict(config)
    del content["checkpoint"], content["total_timesteps"], content["logging"]["progress"]
    return content


def identity(config: TrainConfig, layout: str) -> str:
    """A hash of these settings and of the map's text."""
    text = json.dumps([settings(config), layout], sort_keys=True, default=str)
    return sha256(text.encode())


def environment(agent: AgentConfig) -> dict[str, str]:
    """Versions, our own code, and what the processor is used for; torch's too if the agent needs it."""
    found = {name: str(versions().get(name)) for name in _MATTER}
    found["source code"] = code()[:12]
    if isinstance(agent, SB3Config):
        import torch  # noqa: F401  # `processor` knows of it once it is imported

        found |= {name: str(versions().get(name)) for name in _MATTER_TO_NETWORKS}
        found["processor for torch"] = str(processor()["torch"])
    found["machine"] = processor()["machine"]
    found["processor for numpy"] = " ".join(processor()["numpy"])
    return found
