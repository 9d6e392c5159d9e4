"""An SB3 model behind the `Agent` protocol."""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np
import stable_baselines3
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.distributions import CategoricalDistribution
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.utils import LinearSchedule

from gridworld.agents import Beliefs, Seat, WriteScalars
from gridworld.agents.sb3.checks import LINEAR
from gridworld.agents.sb3.vec_env import GridWorldVecEnv
from gridworld.config import AgentConfig, PolicyKwargs, SB3Config
from gridworld.errors import InputError
from gridworld.files import replacing
from gridworld.observations import ObservationTable
from gridworld.solve import one_hot_policy

_CHUNK = 4096  # states a forward pass
_SMALLEST_IMAGE = 36  # pixels that SB3's NatureCNN needs on each side

# Fields of the config that are ours, not arguments of the algorithm's class.
_OWN_FIELDS = {field.name for field in dataclasses.fields(AgentConfig)} | {"algorithm", "log_interval"}
_SCHEDULES = {"learning_rate", "clip_range", "clip_range_vf"}


class SB3Agent:
    """One SB3 model. Building it raises `InputError` for settings that only SB3 itself can judge."""

    def __init__(self, config: AgentConfig, seat: Seat) -> None:
        assert isinstance(config, SB3Config)
        torch.set_num_threads(seat.threads)
        self.config = config
        self.observation = seat.observation
        self.model = _make_model(config, seat)
        writers = [] if seat.write_scalars is None else [_ScalarsOnly(seat.write_scalars)]
        self.model.set_logger(Logger(folder=None, output_formats=list(writers)))

    def learn(self, total_timesteps: int, on_step: Callable[[int], bool]) -> None:
        try:
            self.model.learn(
                total_timesteps, callback=_OnStep(on_step), log_interval=self.config.log_interval
            )
        except ValueError as error:  # torch's distributions refuse NaN, which SB3 lets through
            if self._is_finite():
                raise
            raise InputError(
                f"agent={self.config.name}: training diverged, the network's weights are no finite numbers "
                f"after {self.model.num_timesteps} steps; try a smaller agent.learning_rate"
            ) from error

    def _is_finite(self) -> bool:
        return all(bool(torch.isfinite(weights).all()) for weights in self.model.policy.parameters())

    def beliefs(self) -> Beliefs:
        states = np.arange(self.observation.num_states)
        parts = [self._forward(states[start : start + _CHUNK]) for start in range(0, len(states), _CHUNK)]
        scores, values = (np.concatenate(part).astype(np.float64) for part in zip(*parts, strict=True))
        greedy = np.argmax(scores, axis=1)
        if isinstance(self.model.policy, ActorCriticPolicy):
            return Beliefs(greedy, scores, values)
        epsilon = float(getattr(self.model, "exploration_rate", 0.0))
        sampled = (1 - epsilon) * one_hot_policy(greedy) + epsilon / scores.shape[1]
        return Beliefs(greedy, sampled, values, q=scores)

    def _forward(self, states: np.ndarray[Any, Any]) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
        """Action probabilities or Q values (n, A), and values (n,), of these states."""
        policy = self.model.policy
        policy.set_training_mode(False)
        observations, _ = policy.obs_to_tensor(self.observation.rows(states))
        with torch.no_grad():
            if isinstance(policy, ActorCriticPolicy):
                distribution = policy.get_distribution(observations)
                assert isinstance(distribution, CategoricalDistribution)
                probabilities = distribution.distribution.probs
                return probabilities.cpu().numpy(), policy.predict_values(observations)[:, 0].cpu().numpy()
            q = cast(torch.nn.Module, policy.q_net)(observations)
            return q.cpu().numpy(), q.max(dim=1).values.cpu().numpy()

    def save(self, path: Path) -> None:
        # A file object, since SB3 would add .zip to a path.
        with replacing(path) as part, part.open("wb") as file:
            self.model.save(file)

    def load(self, path: Path) -> None:
        """Reads tensors (`weights_only`) and one number: nothing in the file is unpickled or run."""
        try:
            _, parameters, _ = load_from_zip_file(path, device=self.model.device, load_data=False)
            self.model.set_parameters(parameters, exact_match=True, device=self.model.device)
            with zipfile.ZipFile(path) as archive:
                rate = json.loads(archive.read("data")).get("exploration_rate")
            if isinstance(rate, float):
                self.model.exploration_rate = rate  # type: ignore[attr-defined]
        except (OSError, ValueError, RuntimeError, KeyError, AssertionError, zipfile.BadZipFile) as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise InputError(
                f"{path}: not a model of {self.config.name} for this world and observation ({reason})"
            ) from None
        except Exception as error:  # torch raises pickle errors of its own for a file that is no checkpoint
            raise InputError(f"{path}: not a model file that can be read ({type(error).__name__})") from None


class _OnStep(BaseCallback):
    def __init__(self, on_step: Callable[[int], bool]) -> None:
        super().__init__()
        self._hook = on_step

    def _on_step(self) -> bool:
        return self._hook(self.num_timesteps)


class _ScalarsOnly(KVWriter):
    """Hands SB3's numbers on to the run's one event file."""

    def __init__(self, write_scalars: WriteScalars) -> None:
        self._write_scalars = write_scalars

    def write(
        self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0
    ) -> None:
        self._write_scalars(
            {
                key: float(value)
                for key, value in key_values.items()
                if isinstance(value, int | float | np.number)
                and "tensorboard" not in (key_excluded[key] or ())
            },
            step,
        )

    def close(self) -> None:
        """Nothing of its own to close."""


def _make_model(config: SB3Config, seat: Seat) -> BaseAlgorithm:
    algorithm: type[BaseAlgorithm] = getattr(stable_baselines3, config.algorithm)
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
    except (AssertionError, ValueError, TypeError, RuntimeError) as error:
        lines = str(error).strip().splitlines() or [type(error).__name__]
        raise InputError(f"agent={config.name}: SB3 cannot build it: {lines[0]}") from error


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
        return all(key in ("pi", "vf") and _is_net_arch(layers) for key, layers in value.items())
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
