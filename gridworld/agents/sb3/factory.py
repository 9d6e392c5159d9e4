"""From settings to an SB3 model on the context's environments; what cannot work is refused in a sentence."""

from __future__ import annotations

import inspect
import warnings

import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy

from gridworld.agents import TrainingContext
from gridworld.agents.sb3.memory_size import NoBuffer, check_model, weighed
from gridworld.agents.sb3.policy_outputs import why_unreadable
from gridworld.agents.sb3.settings.constructor_arguments import Arguments, algorithm_and_arguments
from gridworld.agents.sb3.settings.schemas import SB3ClassConfig, SB3Config, as_dict, reward_scale
from gridworld.agents.sb3.vec_env import GridWorldVecEnv
from gridworld.envs.observations import ObservationTable
from gridworld.errors import InputError

_SMALLEST_IMAGE = 36  # pixels that SB3's NatureCNN needs on each side


class UnfitError(InputError):
    """The class itself refuses its settings, or fails at them.

    Args:
        config: the settings.
        reason: what it does, without its name.
    """

    def __init__(self, config: SB3Config, reason: str) -> None:
        super().__init__(f"agent={config.name}: {config.algorithm} {reason}")
        self.reason = reason


def said(error: Exception) -> str:
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
    return UnfitError(config, f"{what}: {said(error)}{why}")


def cannot_update(config: SB3Config, error: Exception) -> UnfitError:
    """The error to raise where the first update fails."""
    return unfit(config, "cannot make its first update", error)


def make_model(config: SB3Config, context: TrainingContext, with_buffers: bool = True) -> BaseAlgorithm:
    """Build a model on the context's environments.

    Args:
        config: its settings.
        context: what it learns on.
        with_buffers: whether it is to keep what it meets.
    """
    keep_compiler_out()
    algorithm, arguments = algorithm_and_arguments(config, context.features)
    own_extractor = "features_extractor_class" in arguments.get("policy_kwargs", {})
    if arguments["policy"].__name__.endswith("CnnPolicy") and not own_extractor:
        _check_image_size(context.observation)
    device = _device(context.device)
    envs = GridWorldVecEnv(context.envs, context.observation, reward_scale(config))
    try:
        with weighed(config.name, context.observation), warnings.catch_warnings():
            if not with_buffers:
                if context.only_asked:
                    warnings.simplefilter("ignore")  # of rollouts that there will not be
                arguments |= _without_buffers(algorithm)
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
    check_model(model, config.name, context.observation)
    reason = why_unreadable(model.policy)
    if reason is not None:
        raise UnfitError(config, reason)
    return model


def _without_buffers(algorithm: type[BaseAlgorithm]) -> Arguments:
    """The arguments by which a model keeps nothing of what it meets."""
    taken = inspect.signature(algorithm).parameters
    return {name: NoBuffer for name in ("replay_buffer_class", "rollout_buffer_class") if name in taken}


def keep_compiler_out() -> None:
    """Spare a run the import of torch's compiler, which takes as long as half of SB3's own.

    Optimisers import it to exempt some methods from compilation. Nothing here is compiled, so these are
    marked as exempt beforehand; a torch that is built otherwise imports what it wants.
    """
    for name in ("add_param_group", "state_dict", "load_state_dict"):
        method = getattr(getattr(torch.optim.Optimizer, name), "__wrapped__", None)
        if method is not None and not hasattr(method, "__dynamo_disable"):
            method.__dict__["__dynamo_disable"] = method


_DEVICES = ("cpu", "cuda", "mps")  # that tensors can be read from


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


def _check_image_size(observation: ObservationTable) -> None:
    height, width = observation.space.shape[1:] if observation.space.shape else (0, 0)
    if min(height, width) < _SMALLEST_IMAGE:
        raise InputError(
            f"observation=image: frames of {width} x {height} pixels are too small for CnnPolicy, "
            f"whose convolutions need {_SMALLEST_IMAGE}; take a larger observation.cell_size"
        )
