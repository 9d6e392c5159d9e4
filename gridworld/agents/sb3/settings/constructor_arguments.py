"""From settings to a class and its keyword arguments: classes imported by their paths, schedules made."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import stable_baselines3
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import BaseBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.utils import LinearSchedule

from gridworld.agents.sb3.settings.schemas import SB3CheckedConfig, SB3ClassConfig, SB3Config, as_dict
from gridworld.agents.sb3.settings.validation import FALLING, SCHEDULES
from gridworld.config.agents import falls, parse_schedule
from gridworld.errors import InputError
from gridworld.process.user_input import imported

Arguments = dict[str, Any]

# Fields of the config that are ours, not arguments of the algorithm's class.
_OWN_FIELDS = {"name", "family", "algorithm", "engine", "log_interval", "reward_scale"}
EXTRACTOR, _ITS_KWARGS = "features_extractor_class", "features_extractor_kwargs"
_MOST_LAYERS, _WIDEST_LAYER = 16, 4096
_EXAMPLES: dict[type, str] = {
    BaseAlgorithm: "stable_baselines3.A2C",
    BaseBuffer: "stable_baselines3.common.buffers.ReplayBuffer",
    BaseCallback: "stable_baselines3.common.callbacks.StopTrainingOnMaxEpisodes",
    BaseFeaturesExtractor: "gridworld.agents.sb3.features.FourierFeatures",
    torch.optim.Optimizer: "torch.optim.AdamW",
}
_PLAIN_TYPES = (bool, int, float, str)
_KINDS: dict[str, type] = {
    "activation_fn": torch.nn.Module,
    "optimizer_class": torch.optim.Optimizer,
    "features_extractor_class": BaseFeaturesExtractor,
    "replay_buffer_class": BaseBuffer,
    "rollout_buffer_class": BaseBuffer,
}


def algorithm_and_arguments(
    config: SB3Config, features: Mapping[str, Any] = MappingProxyType({})
) -> tuple[type[BaseAlgorithm], Arguments]:
    """Translate settings to a class of SB3's kind and its keyword arguments.

    Args:
        config: the agent's settings.
        features: what the observation adds to the settings of an `MlpPolicy`.

    Returns:
        The class; its arguments but for the environments, the seed and the device.
    """
    if isinstance(config, SB3ClassConfig):
        algorithm = algorithm_class("agent.algorithm", config.algorithm)
        _check_arguments(config, algorithm)
        arguments = _convert(config.arguments, "agent.arguments.")
    else:
        assert isinstance(config, SB3CheckedConfig)
        algorithm = getattr(stable_baselines3, config.algorithm)
        fields = (field.name for field in dataclasses.fields(config) if field.name not in _OWN_FIELDS)
        arguments = _convert({name: getattr(config, name) for name in fields}, "agent.")
    arguments["policy"] = _policy(config, algorithm)
    own = arguments.get("policy_kwargs", {})
    if features and config.policy == "MlpPolicy" and EXTRACTOR not in own:
        extractor = import_class("observation.features", features[EXTRACTOR], BaseFeaturesExtractor)
        kwargs = features[_ITS_KWARGS] | own.get(_ITS_KWARGS, {})
        arguments["policy_kwargs"] = own | {EXTRACTOR: extractor, _ITS_KWARGS: kwargs}
    return algorithm, arguments


def _check_arguments(config: SB3ClassConfig, algorithm: type[BaseAlgorithm]) -> None:
    """Names, and types where the class says plainly what it wants; SB3 itself looks at neither."""
    parameters = inspect.signature(algorithm).parameters
    takes_any = any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters.values())
    for name, value in config.arguments.items():
        if name not in parameters and not takes_any:
            known = ", ".join(key for key in parameters if not key.startswith("_"))
            raise InputError(
                f"agent.arguments.{name}: {config.algorithm} has no such argument; it has {known}"
            )
        wanted = parameters[name].annotation if name in parameters else None
        if name in FALLING and wanted is float and type(value) in (int, float, str):
            parse_schedule(f"agent.arguments.{name}", value)
        elif wanted in _PLAIN_TYPES and not _is_a(value, wanted):
            raise InputError(f"agent.arguments.{name}={value}: must be {wanted.__name__}")


def _is_a(value: Any, kind: type) -> bool:
    if isinstance(value, bool):
        return kind is bool
    return isinstance(value, (int, float) if kind is float else kind)


def _policy(config: SB3Config, algorithm: type[BaseAlgorithm]) -> type[BasePolicy]:
    if config.policy in algorithm.policy_aliases:
        return algorithm.policy_aliases[config.policy]
    if "." in config.policy:
        policy: type[BasePolicy] = import_class("agent.policy", config.policy, BasePolicy)
        return policy
    known = ", ".join(name for name in algorithm.policy_aliases if name != "MultiInputPolicy")
    raise InputError(f"agent.policy={config.policy}: {config.algorithm} has {known}")


def _convert(given: Arguments, where: str) -> Arguments:
    """Yaml's plain values as what SB3 takes; `where` names them in messages."""
    converted = {}
    for name, value in given.items():
        if (name in SCHEDULES and isinstance(value, str)) or (name in FALLING and falls(value)):
            decay = parse_schedule(where + name, value, linear_only=name not in FALLING)
            linear = name in SCHEDULES and decay.power == 1
            value = LinearSchedule(decay.initial, 0.0, 1.0) if linear else decay.initial
        elif name == "train_freq" and isinstance(value, list):
            value = tuple(value)
        elif name.endswith(("_class", "_fn")) and value is not None:
            value = import_class(where + name, value, _KINDS.get(name, object))
        elif name == "policy_kwargs":
            value = _policy_kwargs(value, f"{where}policy_kwargs.")
        converted[name] = value
    return converted


def _policy_kwargs(given: Any, where: str) -> Arguments:
    """What was given, the classes imported."""
    arguments = _convert({key: v for key, v in as_dict(given).items() if v is not None and v != {}}, where)
    if not _is_net_arch(arguments.get("net_arch", [])):
        raise InputError(
            f"{where}net_arch={arguments['net_arch']}: must be layer widths, e.g. [64,64]; at most "
            f"{_MOST_LAYERS} of at most {_WIDEST_LAYER}"
        )
    return arguments


def _is_net_arch(value: Any) -> bool:
    if isinstance(value, dict):
        return value.keys() <= {"pi", "vf"} and all(_is_widths(layers) for layers in value.values())
    return _is_widths(value)


def _is_widths(value: Any) -> bool:
    """Of no more and no wider layers than a processor's memory holds, whoever asks for them."""
    return (
        isinstance(value, list)
        and len(value) <= _MOST_LAYERS
        and all(type(width) is int and 0 < width <= _WIDEST_LAYER for width in value)
    )


def algorithm_class(where: str, path: Any) -> type[BaseAlgorithm]:
    """Import a class of SB3's kind; see `import_class`."""
    algorithm: type[BaseAlgorithm] = import_class(where, path, BaseAlgorithm)
    return algorithm


def import_class(where: str, path: Any, kind: type) -> Any:
    """Import a class of a kind.

    Args:
        where: the setting that has the path, for messages.
        path: its import path.
        kind: what it must be derived from.
    """
    found = imported(where, path)
    if not (inspect.isclass(found) and issubclass(found, kind)):
        what = "class" if kind is object else f"{kind.__name__} class"
        example = _EXAMPLES.get(kind, "torch.nn.ReLU")
        raise InputError(f"{where}={path}: must be the import path of a {what}, e.g. {example}")
    return found
