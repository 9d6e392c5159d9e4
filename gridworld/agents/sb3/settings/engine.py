"""Which settings `gridworld.engine` learns with, and which need SB3's own loop."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from stable_baselines3 import DQN
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from torch import nn

from gridworld.agents import TrainingContext
from gridworld.agents.sb3.features import FIXED, LEARNED
from gridworld.agents.sb3.replay_counts import ReplayCounts
from gridworld.agents.sb3.settings.constructor_arguments import algorithm_and_arguments
from gridworld.agents.sb3.settings.schemas import SB3ClassConfig, SB3Config, as_dict
from gridworld.engine.optimizer import ELEMENTWISE
from gridworld.engine.sb3_format import algorithm_of
from gridworld.process.console import tell

# Of torch.nn, what maps every number by itself, in training as in evaluation, and never draws at random.
ACTIVATIONS = (
    *(nn.CELU, nn.ELU, nn.GELU, nn.Hardshrink, nn.Hardsigmoid, nn.Hardswish, nn.Hardtanh, nn.Identity),
    *(nn.LeakyReLU, nn.LogSigmoid, nn.Mish, nn.PReLU, nn.ReLU, nn.ReLU6, nn.SELU, nn.SiLU, nn.Sigmoid),
    *(nn.Softplus, nn.Softshrink, nn.Softsign, nn.Tanh, nn.Tanhshrink),
)
# Of a policy's classes: those that are known to fit, and why another one need not.
_CLASSES: tuple[tuple[str, tuple[type, ...], str], ...] = (
    ("activation_fn", ACTIVATIONS, "is not known to give the same for the same number always"),
    ("features_extractor_class", (*FIXED, *LEARNED), "may keep more than a function of the state"),
    ("optimizer_class", ELEMENTWISE, "may look at more than a weight at a time"),
)


def learns_in_engine(config: SB3Config, context: TrainingContext) -> bool:
    """Whether the engine learns what SB3's own loop would; a line says why not where it is asked for."""
    algorithm, arguments = algorithm_and_arguments(config, context.features)
    if config.engine != "tabulated" or algorithm_of(algorithm) is None:
        return False
    reason = why_not(config, algorithm, arguments)
    if context.callbacks:
        reason = "callbacks read and change what only SB3's own loop has"
    if reason is not None and not context.only_asked:
        tell(f"engine: stock, since {reason}")
    return reason is None


def why_not(config: SB3Config, algorithm: type[BaseAlgorithm], arguments: Mapping[str, Any]) -> str | None:
    """Why these settings need SB3's own loop, or None where the engine gives the same.

    It does where the network's outputs at a state follow from the parameters and that state alone: whatever
    the mode, the other states of the batch and the passes before. That is known of the classes listed alone.
    """
    where, given = "agent", vars(config)
    if isinstance(config, SB3ClassConfig):
        where, given = "agent.arguments", config.arguments
    classes = arguments.get("policy_kwargs", {})
    if arguments["policy"] not in (algorithm.policy_aliases[name] for name in ("MlpPolicy", "CnnPolicy")):
        return f"agent.policy={config.policy} may compute more than a function of the state"
    for name, known, reason in _CLASSES:
        if name in classes and classes[name] not in known:
            own = as_dict(given.get("policy_kwargs") or {}).get(name)
            chosen = f"{where}.policy_kwargs.{name}={own}"
            return f"{chosen if own else f'observation.features={classes[name].__name__}'} {reason}"
    counts = arguments.get("replay_buffer_class") is ReplayCounts and issubclass(algorithm, DQN)
    for name in ("replay_buffer", "rollout_buffer"):
        is_known = arguments.get(f"{name}_class") is None or (counts and name == "replay_buffer")
        if not is_known or arguments.get(f"{name}_kwargs"):
            return f"{where}.{name}_class is not the plain {name.replace('_', ' ')}"
    if arguments.get("optimize_memory_usage"):
        return f"{where}.optimize_memory_usage changes what the replay buffer samples"
    if issubclass(algorithm, OffPolicyAlgorithm) and arguments.get("n_steps", 1) > 1:
        return f"{where}.n_steps above 1 needs SB3's n-step replay buffer"
    return None
