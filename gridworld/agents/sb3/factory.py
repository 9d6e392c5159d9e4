"""From settings to an SB3 model and its callbacks; what cannot work is refused in a sentence."""

from __future__ import annotations

import inspect
import itertools
import math
import warnings
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import BaseBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy

from gridworld.agents import TrainingContext
from gridworld.agents.sb3.policy_outputs import CHUNK, why_unreadable
from gridworld.agents.sb3.settings.constructor_arguments import (
    Arguments,
    algorithm_and_arguments,
    import_class,
)
from gridworld.agents.sb3.settings.schemas import SB3ClassConfig, SB3Config, as_dict, reward_scale
from gridworld.agents.sb3.vec_env import GridWorldVecEnv
from gridworld.errors import InputError
from gridworld.process.memory_budget import check_memory, is_limited

_SMALLEST_IMAGE = 36  # pixels that SB3's NatureCNN needs on each side
_CNN_FEATURES = 512  # of its last layer
_COPIES = 4  # of a weight: its gradient and what the optimiser keeps, or a file, its member and a tensor
_NUMBER = 4  # bytes of a weight, and of an activation
# A pass makes of each byte of an observation: numbers of 4 bytes, scaled, and the first layer's answer.
_PIXEL_PASS, _NUMBER_PASS = 24, 2
_DEVICES = ("cpu", "cuda", "mps")  # that tensors can be read from
_TARGET = "_target_"


class UnfitError(InputError):
    """The class itself refuses its settings, or fails at them; `reason` is what it does."""

    def __init__(self, config: SB3Config, reason: str) -> None:
        super().__init__(f"agent={config.name}: {config.algorithm} {reason}")
        self.reason = reason


class NoBuffer(BaseBuffer):
    """The buffer of a model that is only asked, which keeps nothing of what it meets."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        pass

    def _get_samples(self, *arguments: Any, **options: Any) -> Any:
        raise NotImplementedError("nothing was kept")


def first_line(error: Exception) -> str:
    """The message of a library's exception in one line."""
    lines = str(error).strip().splitlines()
    return lines[0] if lines else type(error).__name__


def unfit(config: SB3Config, what: str, error: Exception) -> UnfitError:
    """The error to raise where the class fails, with the settings that only it can judge."""
    where = "agent.arguments" if isinstance(config, SB3ClassConfig) else "agent"
    given = config.arguments if isinstance(config, SB3ClassConfig) else vars(config)
    kwargs = as_dict(given.get("policy_kwargs") or {})
    suspects = [f"{where}.policy_kwargs.{name}={value}" for name, value in kwargs.items() if value]
    if isinstance(config, SB3ClassConfig):
        suspects += [f"{where}.{name}={value}" for name, value in given.items() if name != "policy_kwargs"]
    why = f"; look at {', '.join(suspects)}" if suspects else ""
    return UnfitError(config, f"{what}: {first_line(error)}{why}")


def cannot_update(config: SB3Config, error: Exception) -> UnfitError:
    """The error to raise where the first update fails."""
    return unfit(config, "cannot make its first update", error)


def make_model(config: SB3Config, context: TrainingContext, with_buffers: bool = True) -> BaseAlgorithm:
    """Build a model on the context's environments; `with_buffers`: whether it keeps what it meets."""
    keep_compiler_out()
    algorithm, arguments = algorithm_and_arguments(config, context.features)
    kwargs, shape = arguments.get("policy_kwargs", {}), context.observation.space.shape or ()
    is_cnn = arguments["policy"].__name__.endswith("CnnPolicy") and "features_extractor_class" not in kwargs
    if is_cnn and min(shape[1:], default=0) < _SMALLEST_IMAGE:
        height, width = shape[1:] or (0, 0)
        raise InputError(
            f"observation=image: frames of {width} x {height} pixels are too small for CnnPolicy, "
            f"whose convolutions need {_SMALLEST_IMAGE}; take a larger observation.cell_size"
        )
    _check_size(config.name, kwargs, context, is_cnn)
    device = _device(context.device)
    envs = GridWorldVecEnv(context.envs, context.observation, reward_scale(config))
    if not with_buffers:
        taken = inspect.signature(algorithm).parameters
        names = ("replay_buffer_class", "rollout_buffer_class")
        arguments |= {name: NoBuffer for name in names if name in taken}
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
    reason = why_unreadable(model.policy)
    if reason is not None:
        raise UnfitError(config, reason)
    return model


def _check_size(name: str, policy_kwargs: Arguments, context: TrainingContext, is_cnn: bool) -> None:
    """Check an estimate of a network's memory against the budget for runs that somebody else may have made.

    Every whole number among the policy's settings is taken for the width of a layer.
    """
    if not is_limited():
        return
    observation, outputs = context.observation, context.envs.mdp.num_actions
    space: Any = observation.space
    size = math.prod(space.shape) if space.shape else int(space.n)
    widths = [size, *_whole_numbers(policy_kwargs), outputs]
    if "n_quantiles" in policy_kwargs:
        widths[-1] *= int(policy_kwargs["n_quantiles"])
    if is_cnn:  # an eighth of the image's sides, in 64 channels
        widths[:1] = [size // space.shape[0], _CNN_FEATURES]
    weights = 2 * sum(above * below for above, below in itertools.pairwise(widths))  # of two networks
    per_byte = _PIXEL_PASS if space.dtype == np.uint8 else _NUMBER_PASS
    row = per_byte * math.prod(space.shape) * np.dtype(space.dtype).itemsize + 3 * _NUMBER * max(widths[1:])
    table = 0 if observation.stored is None else observation.stored.nbytes
    asked = min(observation.num_states, CHUNK) * row
    check_memory(f"agent={name}: its network", table + _COPIES * _NUMBER * weights + asked)


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
    if kind not in _DEVICES:
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


def _make(where: str, entry: dict[str, Any], kind: type) -> Any:
    path = entry[_TARGET]
    found = import_class(f"{where}.{_TARGET}", path, kind)
    arguments = {name: _value(f"{where}.{name}", value) for name, value in entry.items() if name != _TARGET}
    try:
        return found(**arguments)
    except Exception as error:  # the class may be anybody's
        raise InputError(f"{where}: {path} cannot be built: {first_line(error)}") from error


def _value(where: str, value: Any) -> Any:
    if isinstance(value, list):
        return [_value(f"{where}[{index}]", item) for index, item in enumerate(value)]
    return _make(where, value, object) if isinstance(value, dict) and _TARGET in value else value
