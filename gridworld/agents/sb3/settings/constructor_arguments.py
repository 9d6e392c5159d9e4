"""From settings to a class and its keyword arguments: classes imported by their paths, schedules made."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import stable_baselines3
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import BaseBuffer
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
_MOST_LAYERS, _WIDEST_LAYER = 16, 4096  # what a processor's memory holds, whoever asks for them
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
    """A class of SB3's kind, and its keyword arguments but for environments, seed and device.

    `features` is what the observation adds to the settings of an `MlpPolicy`.
    """
    if isinstance(config, SB3ClassConfig):
        algorithm = algorithm_class("agent.algorithm", config.algorithm)
        _check_types(config.arguments, algorithm)
        arguments = _convert(config.arguments, "agent.arguments.")
    else:
        assert isinstance(config, SB3CheckedConfig)
        algorithm = getattr(stable_baselines3, config.algorithm)
        given = {name: value for name, value in vars(config).items() if name not in _OWN_FIELDS}
        arguments = _convert(given, "agent.")
    arguments["policy"] = _policy(config, algorithm)
    own = arguments.get("policy_kwargs", {})
    if features and config.policy == "MlpPolicy" and EXTRACTOR not in own:
        extractor = import_class("observation.features", features[EXTRACTOR], BaseFeaturesExtractor)
        kwargs = features[_ITS_KWARGS] | own.get(_ITS_KWARGS, {})
        arguments["policy_kwargs"] = own | {EXTRACTOR: extractor, _ITS_KWARGS: kwargs}
    return algorithm, arguments


def _check_types(arguments: Arguments, algorithm: type[BaseAlgorithm]) -> None:
    """Types where the class says plainly what it wants; SB3 itself looks at none."""
    parameters = inspect.signature(algorithm).parameters
    for name, value in arguments.items():
        wanted: Any = parameters[name].annotation if name in parameters else None
        fitting = {float: (int, float), int: (int,), bool: (bool,), str: (str,)}.get(wanted)
        if fitting and type(value) not in fitting and not (name in FALLING and falls(value)):
            raise InputError(f"agent.arguments.{name}={value}: must be {wanted.__name__}")


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
            own = {key: each for key, each in as_dict(value).items() if each is not None and each != {}}
            value = _convert(own, f"{where}policy_kwargs.")
        elif name == "net_arch":
            _check_widths(where + name, value)
        converted[name] = value
    return converted


def _check_widths(key: str, value: Any) -> None:
    networks = list(value.values()) if isinstance(value, dict) and value.keys() <= {"pi", "vf"} else [value]
    for layers in networks:
        is_list = isinstance(layers, list) and len(layers) <= _MOST_LAYERS
        if not is_list or not all(type(width) is int and 0 < width <= _WIDEST_LAYER for width in layers):
            raise InputError(
                f"{key}={value}: must be layer widths, e.g. [64,64]; at most {_MOST_LAYERS} of at most "
                f"{_WIDEST_LAYER}"
            )


def algorithm_class(where: str, path: Any) -> type[BaseAlgorithm]:
    """Import a class of SB3's kind; see `import_class`."""
    algorithm: type[BaseAlgorithm] = import_class(where, path, BaseAlgorithm)
    return algorithm


def import_class(where: str, path: Any, kind: type) -> Any:
    """Import a class that is derived from `kind`; `where` is the setting that has its path, for messages."""
    found = imported(where, path)
    if not (inspect.isclass(found) and issubclass(found, kind)):
        what = "class" if kind is object else f"{kind.__name__} class"
        raise InputError(f"{where}={path}: must be the import path of a {what}, as package.module.Name")
    return found
