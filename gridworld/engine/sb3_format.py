"""The border to Stable-Baselines3: its own classes make the first network and write model files."""

from __future__ import annotations

import hashlib
import importlib
import io
import pkgutil
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, Literal, cast

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.preprocessing import preprocess_obs
from stable_baselines3.common.utils import FloatSchedule
from torch import Tensor, nn

import gridworld.engine
from gridworld.config.agents import Decay
from gridworld.engine.networks import copy_row, cut
from gridworld.engine.population import Population
from gridworld.engine.run import Run
from gridworld.envs.observations import ObservationTable
from gridworld.envs.statistics_env import StatisticsVectorEnv
from gridworld.storage.serialization import independent_generator
from gridworld.world.mdp import IntArray

# Of features extractors: `flat` changes nothing, `fixed` learns nothing, `patches` learns from squares of
# pixels (`agents.sb3.features.PixelCNN`), and `any` may do whatever.
Kind = Literal["flat", "fixed", "patches", "any"]
_LARGEST_TABLE = 2**26  # numbers of 4 bytes


def algorithm_of(model_class: type[BaseAlgorithm]) -> type[Population] | None:
    """The algorithm here of a class of SB3 or sb3-contrib, of the same module's and class's name, or None."""
    library, _, rest = model_class.__module__.partition(".")
    name = rest.rpartition(".")[2]
    known = {module.name for module in pkgutil.iter_modules(gridworld.engine.__path__)}
    if library not in ("stable_baselines3", "sb3_contrib") or name not in known:
        return None
    module = importlib.import_module(f"gridworld.engine.{name}")
    found: type[Population] | None = getattr(module, model_class.__name__, None)
    return found


def make_run(
    model: BaseAlgorithm,
    observation: ObservationTable,
    envs: StatisticsVectorEnv,
    seed: int,
    kind: Kind,
    reward_scale: float = 1.0,
    falling: Mapping[str, Decay] = MappingProxyType({}),
    log_interval: int = 1,
) -> Run:
    """A run of a model that SB3 has just made, so that its generators are where `learn` would find them.

    Args:
        model: SB3's.
        observation: what it sees of a state.
        envs: what it learns in.
        seed: of the run.
        kind: of its features extractors.
        reward_scale: see `Run`, as for the others.
    """
    torch_generator, numpy_generator = torch.Generator(), np.random.RandomState()
    torch_generator.set_state(torch.get_rng_state())
    numpy_generator.set_state(np.random.get_state())
    envs.np_random = independent_generator(seed)
    envs.reset()
    policy: Any = model.policy
    nets, inputs = _inputs(policy, observation, kind)
    run = Run(
        model,
        policy.optimizer.param_groups[0]["params"],
        *(inputs, nets, envs, reward_scale, falling),
        *(torch_generator, numpy_generator, log_interval),
    )
    for name in ("q_net_target", "quantile_net_target"):
        if hasattr(policy, name):
            _, run.target = _inputs(policy, observation, kind, getattr(policy, name))
            run.target_parameters = list(getattr(policy, name).parameters())
    return run


def _inputs(
    policy: Any, observation: ObservationTable, kind: Kind, network: Any = None
) -> tuple[Sequence[Sequence[nn.Module]], Inputs]:
    """The layers of each output, and what feeds them; `network`: None for the policy's own."""
    if isinstance(policy, ActorCriticPolicy):
        own = policy.mlp_extractor
        nets = [[*own.policy_net, policy.action_net], [*own.value_net, policy.value_net]]
        names = ["features_extractor"]
        if not policy.share_features_extractor:
            names = ["pi_features_extractor", "vf_features_extractor"]
        extractors = [getattr(policy, name) for name in names]
        return nets, Inputs(policy, observation, nets, extractors, policy.extract_features, kind)
    network = network or (policy.q_net if hasattr(policy, "q_net") else policy.quantile_net)
    nets = [[*(network.q_net if hasattr(network, "q_net") else network.quantile_net)]]
    extractor = network.features_extractor
    return nets, Inputs(
        policy, observation, nets, [extractor], lambda rows: network.extract_features(rows, extractor), kind
    )


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
        copy_row(networks.weights[run.row], parameters)
    shapes = [parameter.shape for parameter in population.fitted(run)]
    state = {name: torch.as_tensor(value) for name, value in population.optimizer.get_state(run.row).items()}
    cuts = {name: cut(value, shapes) for name, value in state.items() if value.dim()}
    for number, parameter in enumerate(population.fitted(run) if state else ()):
        optimizer.state[parameter] = {
            name: (cuts[name][number] if name in cuts else value).to(
                parameter.device if name in cuts else "cpu"
            )
            for name, value in state.items()
        }


def model_file(run: Run) -> bytes:
    """The content of SB3's model file."""
    put_weights(run)
    content = io.BytesIO()
    run.model.save(content, exclude=["rollout_buffer_class", "replay_buffer_class", "replay_buffer_kwargs"])
    return content.getvalue()


class Inputs:
    """Feeds a policy's networks with states.

    Features that no parameter has a part in are a table, made once. So are the distinct squares of pixels of
    all images, which is what a network begins with that learns from pixels. A one-hot row times the first
    layer's weights is a column of these: for one-hot observations that layer is a look-up.

    Args:
        policy: the policy.
        observation: what it sees of a state.
        nets: the layers of each of its outputs.
        extractors: the modules that make features of observations, one, or one for each output.
        extract: makes features of observations (U, *shape): a tensor, or one for each output.
        kind: of the extractors, see `Kind`.
    """

    def __init__(
        self,
        policy: BasePolicy,
        observation: ObservationTable,
        nets: Sequence[Sequence[nn.Module]],
        extractors: Sequence[Any],
        extract: Callable[[Tensor], Any],
        kind: Kind,
    ) -> None:
        self._policy, self._observation, self._nets = policy, observation, nets
        self._extractors, self._extract = extractors, extract
        begin_linear = all(len(net) > 0 and isinstance(net[0], nn.Linear) for net in nets)
        self.is_look_up = kind == "flat" and begin_linear and _is_one_hot(observation)
        self._is_fixed = kind in ("flat", "fixed")
        self._is_learned = kind == "patches"
        self._all: Any = None  # of all states, the features if these never change, else the observations

    def rows(self, states: IntArray) -> NDArray[Any]:
        """The observations (U, *shape) of states (U,)."""
        return self._observation.rows(states)

    def digest(self) -> str:
        """Equal where the same is seen of all states."""
        rows = self.rows(np.arange(self._observation.num_states))
        return f"{self._observation.kind} {hashlib.sha256(rows.tobytes()).hexdigest()}"

    def table(self) -> Tensor | None:
        """The features (S, n) of all states; None where a parameter has a part in them, or they are large."""
        size = self._extractors[0].features_dim * self._observation.num_states
        if not self._is_fixed or self.is_look_up or size > _LARGEST_TABLE:
            return None
        return cast(Tensor, self._features(None))

    def forward(self, states: IntArray | None) -> tuple[Tensor, ...]:
        """Run the policy's own modules on states (U,), or on all: (U, n) of each output, with its graph."""
        if self.is_look_up:
            return tuple(_look_up(*net, states=states) for net in self._nets)
        features = self._features(states)
        given = features if isinstance(features, tuple) else (features,) * len(self._nets)
        return tuple(_run(net, each) for net, each in zip(self._nets, given, strict=True))

    def _features(self, states: IntArray | None) -> Any:
        if states is not None:
            return self._extract(self._tensor(states))
        if self._is_learned:
            if self._all is None:
                self._all = self._distinct_patches()
            found = [each.learn(*self._all) for each in self._extractors]
            return found[0] if len(found) == 1 else tuple(found)
        if self._all is None:
            self._all = self._tensor(np.arange(self._observation.num_states))
            if self._is_fixed:
                with torch.no_grad():
                    self._all = self._extract(self._all)
                    self._all = self._all[0] if isinstance(self._all, tuple) else self._all
        return self._all if self._is_fixed else self._extract(self._all)

    def _distinct_patches(self) -> tuple[Tensor, Tensor]:
        """The squares that occur in the states' images, (D, k), and which are in each image, (S, P).

        Images of one world share nearly all their squares, so that few pixels are left to run the network on.
        """
        patches = self._extractors[0].patches(self._tensor(np.arange(self._observation.num_states)))
        distinct, where = patches.flatten(0, 1).unique(dim=0, return_inverse=True)
        seen = preprocess_obs(distinct, self._policy.observation_space, self._policy.normalize_images)
        return cast(Tensor, seen), where.view(patches.shape[:2])

    def _tensor(self, states: IntArray) -> Tensor:
        tensor, _ = self._policy.obs_to_tensor(self._observation.rows(states))
        return cast(Tensor, tensor)


def _is_one_hot(observation: ObservationTable) -> bool:
    """Whether a policy sees the unit vector of a state's number; where states look alike, it is another's."""
    if observation.kind not in ("one_hot", "none") or observation.stored is None:
        return observation.kind in ("one_hot", "none")
    numbers = np.arange(observation.num_states)
    own = np.eye(observation.num_states) if observation.kind == "one_hot" else numbers
    return np.array_equal(observation.stored.reshape(observation.num_states, -1), own.reshape(len(own), -1))


def _look_up(first: Any, *others: nn.Module, states: IntArray | None) -> Tensor:
    weight = first.weight.t()
    columns = weight if states is None else weight[torch.as_tensor(states, device=weight.device)]
    return _run(others, columns + first.bias)


def _run(layers: Sequence[nn.Module], hidden: Tensor) -> Tensor:
    for layer in layers:
        hidden = layer(hidden)
    return hidden
