"""The border to Stable-Baselines3: its own classes make the first network and write model files."""

from __future__ import annotations

import importlib
import io
import pkgutil
from collections.abc import Sequence
from functools import partial
from typing import Any

import cloudpickle
import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.utils import FloatSchedule
from torch import nn

import gridworld.engine
from gridworld.base.serialization import independent_generator
from gridworld.engine.networks import StateNetwork, cut
from gridworld.engine.population import Population, Run
from gridworld.envs.observations import ObservationTable
from gridworld.envs.training_env import TrainingVectorEnv

Parameters = Sequence[nn.Parameter]


def algorithm_of(model_class: type[BaseAlgorithm]) -> type[Population] | None:
    """The algorithm here of a class of SB3 or sb3-contrib, of the same module's and class's name, or None."""
    library, _, rest = model_class.__module__.partition(".")
    name = rest.rpartition(".")[2]
    known = {module.name for module in pkgutil.iter_modules(gridworld.engine.__path__)}
    if library not in ("stable_baselines3", "sb3_contrib") or name not in known:
        return None
    module = importlib.import_module(f"gridworld.engine.{name}")
    return getattr(module, model_class.__name__, None)


def make_run(
    model: BaseAlgorithm, observation: ObservationTable, envs: TrainingVectorEnv, seed: int, **options: Any
) -> Run:
    """A run of a model that SB3 has just made, so that its generators are where `learn` would find them.

    `observation` is what it sees of a state, `options` are other fields of `Run`.
    """
    torch_generator, numpy_generator = torch.Generator(), np.random.RandomState()
    torch_generator.set_state(torch.get_rng_state())
    numpy_generator.set_state(np.random.get_state())
    envs.np_random = independent_generator(seed)
    envs.reset()
    policy: Any = model.policy
    parameters, target = policy.optimizer.param_groups[0]["params"], None
    if isinstance(policy, ActorCriticPolicy):
        network = _actor_critic(policy, observation, parameters)
    else:
        name = "q_net" if hasattr(policy, "q_net") else "quantile_net"
        network = _value_network(policy, observation, name, parameters)
        own = list(getattr(policy, f"{name}_target").parameters())
        target = _value_network(policy, observation, f"{name}_target", own)
    return Run(model, network, target, envs, torch_generator, numpy_generator, **options)


def _actor_critic(policy: Any, observation: ObservationTable, parameters: Parameters) -> StateNetwork:
    own = policy.mlp_extractor
    layers = [[*own.policy_net, policy.action_net], [*own.value_net, policy.value_net]]
    names = ["features_extractor"]
    if not policy.share_features_extractor:
        names = ["pi_features_extractor", "vf_features_extractor"]
    extractors = [getattr(policy, name) for name in names]
    return StateNetwork(policy, observation, layers, parameters, extractors, policy.extract_features)


def _value_network(
    policy: Any, observation: ObservationTable, name: str, parameters: Parameters
) -> StateNetwork:
    own = getattr(policy, name)
    layers, extractor = [[*getattr(own, name.removesuffix("_target"))]], own.features_extractor
    extract = partial(own.extract_features, features_extractor=extractor)
    return StateNetwork(policy, observation, layers, parameters, [extractor], extract)


def put_weights(run: Run) -> None:
    """Give SB3's model the weights, the optimiser's state and the settings that the run has."""
    population, model, optimizer = run.population, run.model, run.model.policy.optimizer
    progress = 1 - model._current_progress_remaining
    for name in run.falling:
        value = run.setting(name, progress)
        if name == "learning_rate":  # so that SB3's `load` reads the file anywhere
            model.lr_schedule = FloatSchedule(value)
        else:
            setattr(model, name, value)
    optimizer.param_groups[0]["lr"] = run.setting("learning_rate", progress)
    for networks, parameters in population.weights(run).values():
        parts = cut(networks.whole()[run.row], [parameter.shape for parameter in parameters])
        for parameter, part in zip(parameters, parts, strict=True):
            parameter.data.copy_(part)  # which may be a view of the row, and leaves a graph as it is
    shapes = [parameter.shape for parameter in run.network.parameters]
    state = {name: torch.as_tensor(value) for name, value in population.optimizer.get_state(run.row).items()}
    spread = population.networks.spread
    cuts = {name: cut(spread(value), shapes) for name, value in state.items() if value.dim()}
    for number, parameter in enumerate(run.network.parameters if state else ()):
        optimizer.state[parameter] = {
            name: (cuts[name][number] if name in cuts else value).to(
                parameter.device if name in cuts else "cpu"
            )
            for name, value in state.items()
        }


def model_file(model: BaseAlgorithm, exclude: Sequence[str] = ()) -> bytes:
    """SB3's own file of a model, which holds classes of this package by value: SB3 reads it without them."""
    content = io.BytesIO()
    cloudpickle.register_pickle_by_value(gridworld)
    try:
        model.save(content, exclude=exclude)
    finally:
        cloudpickle.unregister_pickle_by_value(gridworld)
    return content.getvalue()
