"""The identity of a run, from its settings, and the environment that its numbers depend on.

Two runs of one identity do the same as far as their settings decide it. To the last bit they do so only in
the same environment: other versions or another processor round differently.
"""

from __future__ import annotations

import dataclasses
import json
from typing import Any

from gridworld.config.agents import AgentConfig
from gridworld.config.fields import Effect
from gridworld.config.settings import ON_RESULT, with_effects
from gridworld.config.train import TrainConfig
from gridworld.run.identity.provenance import code, processor, versions
from gridworld.storage.safe_read import sha256

_FIXED = frozenset(Effect) - {Effect.LENGTH, Effect.NOTHING}
_PACKAGES = ("python", "gridworld", "gymnasium", "numpy", "scipy")  # that every agent depends on


def settings(config: TrainConfig) -> dict[str, Any]:
    """The settings that are fixed for a run: all but its length and those without an effect on its files."""
    return with_effects(_FIXED, dataclasses.asdict(config))


def identity(config: TrainConfig, layout: str) -> str:
    """A hash of a run's fixed settings and of its map.

    Args:
        config: The settings.
        layout: The map's text.

    Returns:
        SHA-256 as hexadecimal digits.
    """
    text = json.dumps([settings(config), layout], sort_keys=True, default=str)
    return sha256(text.encode())


def settings_hash(settings: dict[str, Any], layout: str) -> str:
    """A hash of a run's settings and its map's text; the same for settings read from a manifest."""
    text = json.dumps([with_effects(ON_RESULT, settings), layout], sort_keys=True, default=str)
    return sha256(text.encode())[:32]


def environment(agent: AgentConfig) -> dict[str, str]:
    """What the last bits of an agent's numbers depend on beside its settings.

    Args:
        agent: The agent's settings; one with networks depends on torch, which is then imported.

    Returns:
        Names and values: versions, a hash of the package's source, the processor's instructions.
    """
    found = {name: str(versions().get(name)) for name in _PACKAGES}
    found["source code"] = code()[:12]
    found |= {name: str(versions().get(name)) for name in agent.libraries}
    if "torch" in agent.libraries:
        import torch  # noqa: F401  # `processor` asks it once it is imported

        found["processor for torch"] = str(processor()["torch"])
    found["machine"] = processor()["machine"]
    found["processor for numpy"] = " ".join(processor()["numpy"])
    return found
