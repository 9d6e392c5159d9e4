"""From settings to an SB3 model and its callbacks: classes imported by their paths, schedules made."""

from __future__ import annotations

import inspect
import re
import warnings
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, cast

import numpy as np
import stable_baselines3
import torch
from gymnasium.spaces import flatdim
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import BaseBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.utils import LinearSchedule

from gridworld.agents import TrainingContext
from gridworld.agents.sb3.policy_outputs import CHUNK, why_unreadable
from gridworld.agents.sb3.settings import FALLING, SCHEDULES, SB3ClassConfig, SB3Config
from gridworld.agents.sb3.vec_env import GridWorldVecEnv
from gridworld.base.bounds import falls, parse_schedule
from gridworld.base.errors import InputError, in_short
from gridworld.base.user_input import check_memory, is_limited, named_object
from gridworld.base.workarounds import generator_of, keep_compiler_out
from gridworld.world.mdp import leaves_of

Arguments = dict[str, Any]

_EXTRACTOR, _ITS_KWARGS = "features_extractor_class", "features_extractor_kwargs"
_KINDS: dict[str, type] = {
    "activation_fn": torch.nn.Module,
    "optimizer_class": torch.optim.Optimizer,
    "features_extractor_class": BaseFeaturesExtractor,
    "replay_buffer_class": BaseBuffer,
    "rollout_buffer_class": BaseBuffer,
}
_MOST_LAYERS, _WIDEST_LAYER = 16, 4096  # what a processor's memory holds, whoever asks for them
_PIXEL_PASS, _NUMBER_PASS = 24, 8  # bytes of a pass for a pixel, which becomes a scaled number, or a number
_TARGET = "_target_"


def unfit(config: SB3Config, why: str) -> InputError:
    """The error to raise where the class cannot be used."""
    return InputError(f"agent={config.name}: {config.algorithm} {why}")


def failed(config: SB3Config, what: str, error: Exception) -> InputError:
    """The error to raise where the class fails, with the settings that only it can judge."""
    given = {f"policy_kwargs.{name}": value for name, value in config.policy_kwargs_given.items()}
    if isinstance(config, SB3ClassConfig):
        given |= {name: value for name, value in config.arguments.items() if name != "policy_kwargs"}
    suspects = ", ".join(f"{config.where}.{name}={value}" for name, value in given.items())
    hint = f"; check {suspects}" if suspects else ""
    hint = "; add observation=image" if "NatureCNN only with images" in str(error) else hint
    return unfit(config, f"{what}: {in_short(error)}{hint}")


def algorithm_and_arguments(
    config: SB3Config, features: Mapping[str, Any] = MappingProxyType({}), sees_dict: bool = False
) -> tuple[type[BaseAlgorithm], Arguments]:
    """A class of SB3's kind, and its keyword arguments but for environments, seed and device.

    `features` is what the observation adds to the settings of an `MlpPolicy`, which is a `MultiInputPolicy`
    where observations are a Dict.
    """
    name = type(config).algorithm  # of a class of SB3's, from which another may be derived
    own = BaseAlgorithm if isinstance(config, SB3ClassConfig) else getattr(stable_baselines3, name)
    algorithm = own if config.algorithm == name else import_class("agent.algorithm", config.algorithm, own)
    arguments = {
        name: _converted(f"{config.where}.{name}", name, each) for name, each in config.given.items()
    }
    kwargs = {
        name: _converted(f"{config.where}.policy_kwargs.{name}", name, each)
        for name, each in config.policy_kwargs_given.items()
    }
    if features and config.policy == "MlpPolicy" and _EXTRACTOR not in kwargs:
        extractor = import_class("observation.features", features[_EXTRACTOR], BaseFeaturesExtractor)
        kwargs |= {_EXTRACTOR: extractor, _ITS_KWARGS: features[_ITS_KWARGS] | kwargs.get(_ITS_KWARGS, {})}
    arguments.pop("policy_kwargs", None)
    return algorithm, {
        **arguments,
        "policy": _policy(config, algorithm, sees_dict),
        **({"policy_kwargs": kwargs} if kwargs else {}),
    }


def import_class(where: str, path: Any, kind: type = BaseAlgorithm) -> Any:
    """Import a class that is derived from `kind`; `where` is the setting that has its path, for messages."""
    where = f"{where}={path}"
    found = named_object(where, str(path))
    if not (inspect.isclass(found) and issubclass(found, kind)):
        what = "class" if kind is object else f"{kind.__name__} class"
        raise InputError(f"{where}: must be the import path of a {what}, as package.module.Name")
    return found


def _policy(config: SB3Config, algorithm: type[BaseAlgorithm], sees_dict: bool) -> type[BasePolicy]:
    name = "MultiInputPolicy" if sees_dict and config.policy == "MlpPolicy" else config.policy
    if name in algorithm.policy_aliases:
        return algorithm.policy_aliases[name]
    if re.search("[.:]", config.policy):
        policy: type[BasePolicy] = import_class("agent.policy", config.policy, BasePolicy)
        return policy
    known = ", ".join(algorithm.policy_aliases)
    raise InputError(f"agent.policy={config.policy}: {config.algorithm} has {known}")


def _converted(key: str, name: str, value: Any) -> Any:
    """A plain value of yaml as what SB3 takes; `key` names it in messages."""
    if (name in SCHEDULES and isinstance(value, str)) or (name in FALLING and falls(value)):
        decay = parse_schedule(key, value, linear_only=name not in FALLING)
        is_sb3s = name in SCHEDULES and decay.power == 1
        return LinearSchedule(decay.initial, 0.0, 1.0) if is_sb3s else decay.initial
    if name == "train_freq" and isinstance(value, list):
        return tuple(value)
    if name.endswith(("_class", "_fn")) and value is not None:
        return import_class(key, value, _KINDS.get(name, object))
    if name == "net_arch":
        _check_widths(key, value)
    return value


def _check_widths(key: str, value: Any) -> None:
    networks = list(value.values()) if isinstance(value, dict) and value.keys() <= {"pi", "vf"} else [value]
    for layers in networks:
        is_list = isinstance(layers, list) and len(layers) <= _MOST_LAYERS
        if not is_list or not all(type(width) is int and 0 < width <= _WIDEST_LAYER for width in layers):
            raise InputError(
                f"{key}={value}: must be layer widths, e.g. [64,64]; at most {_MOST_LAYERS} of at most "
                f"{_WIDEST_LAYER}"
            )


class NoBuffer(BaseBuffer):
    """The buffer of a model that does not learn in SB3's own loop, which keeps nothing of what it meets."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        pass

    def _get_samples(self, *arguments: Any, **options: Any) -> Any:
        raise NotImplementedError("this buffer stores nothing")


def make_model(
    config: SB3Config,
    context: TrainingContext,
    algorithm: type[BaseAlgorithm],
    arguments: Arguments,
    with_buffers: bool,
) -> BaseAlgorithm:
    """Build a model on the context's environments; `with_buffers`: whether it keeps what it meets."""
    keep_compiler_out()
    torch.set_num_threads(context.threads)
    if is_limited():
        _check_network(config, context)
    device = _device(context.device)
    envs = GridWorldVecEnv(context.envs, context.observation, config.reward_factor)
    if not with_buffers:
        taken = inspect.signature(algorithm).parameters
        names = ("replay_buffer_class", "rollout_buffer_class")
        arguments = arguments | {name: NoBuffer for name in names if name in taken}
    try:
        with warnings.catch_warnings():
            if context.only_asked:
                warnings.simplefilter("ignore")  # of rollouts that there will not be
            model = algorithm(env=envs, seed=context.seed, device=device, **arguments)
        reason = why_unreadable(model.policy)
    except InputError:
        raise
    except Exception as error:  # the class may be anybody's
        raise failed(config, "cannot be built", error) from error
    if generator_of(model.observation_space) is not None:
        # A network for images is shown a random one to see its size; SB3 seeds the actions' space only.
        model.observation_space.seed(context.seed)
    if reason is not None:
        raise unfit(config, reason)
    return model


def _check_network(config: SB3Config, context: TrainingContext) -> None:
    """Refuse a network that would take more than the memory budget, alone or in a pass over the states."""
    observation, space = context.observation, cast(Any, context.observation.space)
    size = flatdim(space)
    per_number = _PIXEL_PASS if space.dtype == np.uint8 else _NUMBER_PASS
    table = 0 if observation.stored is None else sum(each.nbytes for each in leaves_of(observation.stored))
    needed = config.memory(size, context.envs.num_envs, 0) + table
    needed += min(observation.num_states, CHUNK) * per_number * size
    check_memory(f"agent={config.name}: its network", needed)


def _device(name: str) -> str:
    """The name, if torch knows it and has it; SB3 would fall back to the processor without a word."""
    try:
        kind = "cpu" if name == "auto" else torch.device(name).type
    except RuntimeError:
        kind = ""
    if kind not in ("cpu", "cuda", "mps"):  # that tensors can be read from
        raise InputError(f"device={name}: must be auto, cpu, cuda or cuda:N")
    if kind == "cuda" and not torch.cuda.is_available():
        raise InputError(f"device={name}: torch finds no CUDA device here; set device=cpu")
    return name


def make_callbacks(entries: Sequence[Any]) -> list[BaseCallback]:
    """Build callbacks of mappings of `_target_` and the class's arguments, which may be such mappings."""
    return [_make(f"callbacks[{index}]", entry, BaseCallback) for index, entry in enumerate(entries)]


def _make(where: str, value: Any, kind: type = object) -> Any:
    if isinstance(value, list):
        return [_make(f"{where}[{index}]", item) for index, item in enumerate(value)]
    if not (isinstance(value, dict) and _TARGET in value):
        return value
    found = import_class(f"{where}.{_TARGET}", value[_TARGET], kind)
    arguments = {name: _make(f"{where}.{name}", each) for name, each in value.items() if name != _TARGET}
    try:
        return found(**arguments)
    except Exception as error:  # the class may be anybody's
        hint = "; logging.wandb=true calls it" if "wandb.init" in str(error) else ""
        raise InputError(f"{where}: {value[_TARGET]} cannot be built: {in_short(error)}{hint}") from error
