"""From settings to an SB3 model: arguments converted, classes imported, what cannot work refused."""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import sys
from typing import Any

import stable_baselines3
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.utils import LinearSchedule

from gridworld.agents import Seat
from gridworld.agents.sb3.tabulated import why_not
from gridworld.agents.sb3.tabulated_dqn import TabulatedDQN
from gridworld.agents.sb3.tabulated_ppo import TabulatedPPO
from gridworld.agents.sb3.vec_env import GridWorldVecEnv
from gridworld.config import LINEAR, PolicyKwargs, SB3Config
from gridworld.errors import InputError
from gridworld.observations import ObservationTable

_SMALLEST_IMAGE = 36  # pixels that SB3's NatureCNN needs on each side

# Fields of the config that are ours, not arguments of the algorithm's class.
_OWN_FIELDS = {"name", "family", "algorithm", "engine", "log_interval"}
_SCHEDULES = {"learning_rate", "clip_range", "clip_range_vf"}


def make_model(config: SB3Config, seat: Seat) -> BaseAlgorithm:
    """The model on the seat's environments. Raises `InputError` for what only SB3 or torch can judge."""
    keep_compiler_out()
    algorithm = _algorithm(config)
    arguments = {
        field.name: getattr(config, field.name)
        for field in dataclasses.fields(config)
        if field.name not in _OWN_FIELDS
    }
    for name in _SCHEDULES & arguments.keys():
        arguments[name] = _schedule(arguments[name])
    if isinstance(arguments.get("train_freq"), list):
        arguments["train_freq"] = tuple(arguments["train_freq"])
    for name in arguments.keys() & {"replay_buffer_class", "rollout_buffer_class"}:
        if arguments[name] is not None:
            arguments[name] = _import(f"agent.{name}", arguments[name], object)
    if config.policy not in algorithm.policy_aliases:
        known = ", ".join(name for name in algorithm.policy_aliases if name != "MultiInputPolicy")
        raise InputError(f"agent.policy={config.policy}: {config.algorithm} has {known}")
    policy_class = algorithm.policy_aliases[config.policy]
    arguments["policy_kwargs"] = _policy_kwargs(config.policy_kwargs)
    if policy_class.__name__.endswith("CnnPolicy") and config.policy_kwargs.features_extractor_class is None:
        _check_image_size(seat.observation)
    device = _device(seat.device)
    try:
        return algorithm(
            env=GridWorldVecEnv(seat.envs, seat.observation),
            seed=seat.seed,
            device=device,
            **arguments,
        )
    except MemoryError:
        raise InputError(
            f"agent={config.name}: its buffers do not fit into memory; take a smaller agent.buffer_size, "
            "agent.n_steps or n_envs, or another observation"
        ) from None
    except (AssertionError, ValueError, TypeError, RuntimeError) as error:
        lines = str(error).strip().splitlines() or [type(error).__name__]
        raise InputError(f"agent={config.name}: SB3 cannot build it: {lines[0]}") from error


def keep_compiler_out() -> None:
    """Spare a run the import of torch's compiler, which takes as long as half of SB3's own.

    Optimisers import it to exempt some methods from compilation. Nothing here is compiled, so these are
    marked as exempt beforehand; a torch that is built otherwise imports what it wants.
    """
    for name in ("add_param_group", "state_dict", "load_state_dict"):
        method = getattr(getattr(torch.optim.Optimizer, name), "__wrapped__", None)
        if method is not None and not hasattr(method, "__dynamo_disable"):
            method.__dict__["__dynamo_disable"] = method


def _algorithm(config: SB3Config) -> type[BaseAlgorithm]:
    """SB3's own class, or the one that runs the network once per state where that gives the same."""
    if config.engine == "tabulated":
        reason = why_not(config)
        if reason is None:
            return TabulatedDQN if config.algorithm == "DQN" else TabulatedPPO
        print(f"engine: stock, since {reason}", file=sys.stderr)
    algorithm: type[BaseAlgorithm] = getattr(stable_baselines3, config.algorithm)
    return algorithm


def _device(name: str) -> str:
    """The name, if torch knows it and has it; SB3 would fall back to the processor without a word."""
    try:
        missing = name != "auto" and torch.device(name).type == "cuda" and not torch.cuda.is_available()
    except RuntimeError:
        raise InputError(f"device={name}: must be auto, cpu, cuda or cuda:N") from None
    if missing:
        raise InputError(f"device={name}: torch finds no CUDA device here; set device=cpu")
    return name


def _schedule(value: Any) -> Any:
    if isinstance(value, str):
        return LinearSchedule(float(value.removeprefix(LINEAR)), 0.0, 1.0)
    return value


def _check_image_size(observation: ObservationTable) -> None:
    height, width = observation.space.shape[1:] if observation.space.shape else (0, 0)
    if min(height, width) < _SMALLEST_IMAGE:
        raise InputError(
            f"observation=image: frames of {width} x {height} pixels are too small for CnnPolicy, "
            f"whose convolutions need {_SMALLEST_IMAGE}; take a larger observation.cell_size"
        )


def _policy_kwargs(given: PolicyKwargs) -> dict[str, Any]:
    """What was given, the classes imported."""
    kinds = {
        "activation_fn": torch.nn.Module,
        "optimizer_class": torch.optim.Optimizer,
        "features_extractor_class": BaseFeaturesExtractor,
    }
    arguments = {key: value for key, value in vars(given).items() if value is not None and value != {}}
    for key, value in arguments.items():
        if key in kinds:
            arguments[key] = _import(f"agent.policy_kwargs.{key}", value, kinds[key])
    if not _is_net_arch(arguments.get("net_arch", [])):
        raise InputError(
            f"agent.policy_kwargs.net_arch={arguments['net_arch']}: must be layer widths, e.g. [64,64]"
        )
    return arguments


def _is_net_arch(value: Any) -> bool:
    if isinstance(value, dict):
        return value.keys() <= {"pi", "vf"} and all(_is_widths(layers) for layers in value.values())
    return _is_widths(value)


def _is_widths(value: Any) -> bool:
    return isinstance(value, list) and all(type(width) is int and width > 0 for width in value)


def _import(where: str, path: Any, kind: type) -> Any:
    module, _, name = str(path).rpartition(".")
    try:
        found = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError):
        found = None
    if not (inspect.isclass(found) and issubclass(found, kind)):
        what = "class" if kind is object else f"{kind.__name__} class"
        raise InputError(f"{where}={path}: must be the import path of a {what}, e.g. torch.nn.ReLU")
    return found
