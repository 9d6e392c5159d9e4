"""What makes a run this run, and what the machine adds to it.

Two runs of one identity do the same, as far as it is up to their settings. To the last bit they do it only in
the same environment: other versions or another processor round differently.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import platform
from typing import Any

from gridworld.agent_config import AgentConfig, SB3Config
from gridworld.config import TrainConfig
from gridworld.provenance import code, versions

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
    return hashlib.sha256(text.encode()).hexdigest()


def environment(agent: AgentConfig) -> dict[str, str]:
    """Versions, our own code, and what the processor is used for; torch's too if the agent needs it."""
    import numpy as np  # here, as torch below, to be light where nobody asks

    found = {name: str(versions().get(name)) for name in _MATTER}
    found["source code"] = code()[:12]
    found["machine"] = platform.machine()
    found["processor for numpy"] = " ".join(np.show_config(mode="dicts")["SIMD Extensions"]["found"])
    if isinstance(agent, SB3Config):
        import torch

        found |= {name: str(versions().get(name)) for name in _MATTER_TO_NETWORKS}
        found["processor for torch"] = torch.backends.cpu.get_cpu_capability()
    return found
