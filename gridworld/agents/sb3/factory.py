"""From settings to an SB3 model and its callbacks: classes imported by their paths, schedules made.

What cannot work is refused in a sentence.
"""

from __future__ import annotations

import inspect
import itertools
import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, cast

import numpy as np
import stable_baselines3
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import BaseBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.utils import LinearSchedule

from gridworld.agents import TrainingContext
from gridworld.agents.sb3.policy_outputs import CHUNK, why_unreadable
from gridworld.agents.sb3.settings import (
    FALLING,
    SCHEDULES,
    SB3CheckedConfig,
    SB3ClassConfig,
    SB3Config,
    as_dict,
)
from gridworld.agents.sb3.vec_env import GridWorldVecEnv
from gridworld.config.fields import falls, parse_schedule
from gridworld.errors import InputError
from gridworld.process.memory_budget import check_memory, is_limited
from gridworld.process.user_input import imported

Arguments = dict[str, Any]

# Fields of the config that are ours, not arguments of the algorithm's class.
_OWN_FIELDS = {"name", "family", "algorithm", "engine", "log_interval", "reward_scale"}
_EXTRACTOR, _ITS_KWARGS = "features_extractor_class", "features_extractor_kwargs"
_KINDS: dict[str, type] = {
    "activation_fn": torch.nn.Module,
    "optimizer_class": torch.optim.Optimizer,
    "features_extractor_class": BaseFeaturesExtractor,
    "replay_buffer_class": BaseBuffer,
    "rollout_buffer_class": BaseBuffer,
}
_MOST_LAYERS, _WIDEST_LAYER = 16, 4096  # what a processor's memory holds, whoever asks for them
_SMALLEST_IMAGE = 36  # pixels that SB3's NatureCNN needs on each side
_CNN_FEATURES = 512  # of its last layer
_COPIES = 4  # of a weight: its gradient and what the optimiser keeps, or a file, its member and a tensor
_NUMBER = 4  # bytes of a weight, and of an activation
# A pass makes of each byte of an observation: numbers of 4 bytes, scaled, and the first layer's answer.
_PIXEL_PASS, _NUMBER_PASS = 24, 2
_TARGET = "_target_"


class UnfitError(InputError):
    """The class itself refuses its settings, or fails at them."""

    def __init__(self, config: SB3Config, reason: str) -> None:
        super().__init__(f"agent={config.name}: {config.algorithm} {reason}")


def unfit(config: SB3Config, what: str, error: Exception) -> UnfitError:
    """The error to raise where the class fails, with the settings that only it can judge."""
    is_any = isinstance(config, SB3ClassConfig)
    where = "agent.arguments" if is_any else "agent"
    kwargs = config.policy_kwargs_given
    suspects = [f"{where}.policy_kwargs.{name}={value}" for name, value in kwargs.items() if value]
    if is_any:
        given = config.given.items()
        suspects += [f"{where}.{name}={value}" for name, value in given if name != "policy_kwargs"]
    why = f"; look at {', '.join(suspects)}" if suspects else ""
    return UnfitError(config, f"{what}: {first_line(error)}{why}")


def first_line(error: Exception) -> str:
    """The message of a library's exception in one line."""
    lines = str(error).strip().splitlines()
    return lines[0] if lines else type(error).__name__


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
    if features and config.policy == "MlpPolicy" and _EXTRACTOR not in own:
        extractor = import_class("observation.features", features[_EXTRACTOR], BaseFeaturesExtractor)
        kwargs = features[_ITS_KWARGS] | own.get(_ITS_KWARGS, {})
        arguments["policy_kwargs"] = own | {_EXTRACTOR: extractor, _ITS_KWARGS: kwargs}
    return algorithm, arguments


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


class NoBuffer(BaseBuffer):
    """The buffer of a model that is only asked, which keeps nothing of what it meets."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        pass

    def _get_samples(self, *arguments: Any, **options: Any) -> Any:
        raise NotImplementedError("nothing was kept")


def make_model(
    config: SB3Config,
    context: TrainingContext,
    algorithm: type[BaseAlgorithm],
    arguments: Arguments,
    with_buffers: bool,
) -> BaseAlgorithm:
    """Build a model on the context's environments; `with_buffers`: whether it keeps what it meets."""
    keep_compiler_out()
    kwargs, shape = arguments.get("policy_kwargs", {}), context.observation.space.shape or ()
    is_cnn = arguments["policy"].__name__.endswith("CnnPolicy") and "features_extractor_class" not in kwargs
    if is_cnn and min(shape[1:], default=0) < _SMALLEST_IMAGE:
        height, width = shape[1:] or (0, 0)
        raise InputError(
            f"observation=image: frames of {width} x {height} pixels are too small for CnnPolicy, "
            f"whose convolutions need {_SMALLEST_IMAGE}; take a larger observation.cell_size"
        )
    if is_limited():
        check_memory(f"agent={config.name}: its network", _network_bytes(kwargs, context, is_cnn))
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
    except InputError:
        raise
    except MemoryError:
        raise InputError(
            f"agent={config.name}: its buffers do not fit into memory; take a smaller agent.buffer_size, "
            "agent.n_steps or n_envs, or another observation"
        ) from None
    except Exception as error:  # the class may be anybody's
        raise unfit(config, "cannot be built", error) from error
    if not isinstance(getattr(model, "policy", None), BasePolicy):
        raise UnfitError(config, "cannot be built: it makes no policy")
    if model.observation_space._np_random is not None:
        # A network for images is shown a random one to see its size; SB3 seeds the actions' space only.
        model.observation_space.seed(context.seed)
    if (reason := why_unreadable(model.policy)) is not None:
        raise UnfitError(config, reason)
    return model


def _network_bytes(policy_kwargs: Arguments, context: TrainingContext, is_cnn: bool) -> int:
    """About the memory of a network, where every whole number of its settings is the width of a layer."""
    observation, space = context.observation, cast(Any, context.observation.space)
    shape: tuple[int, ...] = space.shape or ()
    size = math.prod(shape) if shape else int(space.n)
    widths = [size, *_whole_numbers(policy_kwargs), context.envs.mdp.num_actions]
    widths[-1] *= int(policy_kwargs.get("n_quantiles", 1))
    if is_cnn:  # an eighth of the image's sides, in 64 channels
        widths[:1] = [size // shape[0], _CNN_FEATURES]
    weights = 2 * sum(above * below for above, below in itertools.pairwise(widths))  # of two networks
    per_byte = _PIXEL_PASS if space.dtype == np.uint8 else _NUMBER_PASS
    row: int = per_byte * math.prod(shape) * np.dtype(space.dtype).itemsize + 3 * _NUMBER * max(widths[1:])
    table: int = 0 if observation.stored is None else observation.stored.nbytes
    return table + _COPIES * _NUMBER * weights + min(observation.num_states, CHUNK) * row


def _whole_numbers(node: Any) -> Iterator[int]:
    """Those in nested settings, in their order."""
    if isinstance(node, dict | list | tuple):
        for each in node.values() if isinstance(node, dict) else node:
            yield from _whole_numbers(each)
    elif type(node) is int and node > 0:
        yield node


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


def keep_compiler_out() -> None:
    """Spare a run the import of torch's compiler, which takes as long as half of SB3's own.

    Optimisers import it to exempt some methods from compilation. Nothing here is compiled, so these are
    marked as exempt beforehand; a torch that is built otherwise imports what it wants.
    """
    for name in ("add_param_group", "state_dict", "load_state_dict"):
        method = getattr(getattr(torch.optim.Optimizer, name), "__wrapped__", None)
        if method is not None and not hasattr(method, "__dynamo_disable"):
            method.__dict__["__dynamo_disable"] = method


def make_callbacks(entries: Sequence[Any]) -> list[BaseCallback]:
    """Build callbacks of mappings of `_target_` and the class's arguments, which may be such mappings."""
    return [_make(f"callbacks[{index}]", entry, BaseCallback) for index, entry in enumerate(entries)]


def _make(where: str, value: Any, kind: type = object) -> Any:
    if isinstance(value, list):
        return [_make(f"{where}[{index}]", item) for index, item in enumerate(value)]
    if not (isinstance(value, dict) and _TARGET in value):
        return value
    path = value[_TARGET]
    found = import_class(f"{where}.{_TARGET}", path, kind)
    arguments = {name: _make(f"{where}.{name}", each) for name, each in value.items() if name != _TARGET}
    try:
        return found(**arguments)
    except Exception as error:  # the class may be anybody's
        raise InputError(f"{where}: {path} cannot be built: {first_line(error)}") from error
