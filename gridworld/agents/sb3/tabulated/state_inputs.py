"""Run the network once per state, not once per sample: the idea, and what all algorithms share.

A batch of B transitions in a world of S states holds at most S different observations. For a network f with
parameters θ, whatever a loss makes of its outputs, it depends on θ only through the outputs at the states
that occur:

    L(θ) = ℓ(f_θ(x_1), ..., f_θ(x_S)),    ∂L/∂θ = Σ_s ∂ℓ/∂f(x_s) · ∂f_θ(x_s)/∂θ

So one forward and one backward pass over the distinct states give the loss and the gradient of the whole
batch, exactly: the same sums as sample by sample, added up in another order. While the parameters stand
still, the outputs are a table, and acting is looking up.

Features that no parameter has a part in, as those of `features.FIXED`, are a table as well, made once. So
are the distinct squares of pixels of all images, which is what those of `features.LEARNED` begin with.

A one-hot row times the first layer's weights is a column of these weights. So for one-hot observations that
layer is a look-up as well, and no matrix of S x S is ever made.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import Any, cast

import numpy as np
import torch
from stable_baselines3 import DQN
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import preprocess_obs
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, FlattenExtractor
from torch import Tensor, nn

from gridworld.agents.sb3.features import FIXED, LEARNED
from gridworld.agents.sb3.replay_counts import ReplayCounts
from gridworld.agents.sb3.settings.schemas import SB3ClassConfig, SB3Config, as_dict
from gridworld.agents.sb3.tabulated.flat_optimizer import ELEMENTWISE
from gridworld.agents.sb3.tabulated.stacked_layers import can_stand
from gridworld.agents.sb3.vec_env import StateStep
from gridworld.envs.observations import ObservationTable
from gridworld.process.parallel.together import mixed
from gridworld.world.mdp import IntArray

# Of torch.nn, what maps every number by itself, in training as in evaluation, and never draws at random.
ACTIVATIONS = (
    *(nn.CELU, nn.ELU, nn.GELU, nn.Hardshrink, nn.Hardsigmoid, nn.Hardswish, nn.Hardtanh, nn.Identity),
    *(nn.LeakyReLU, nn.LogSigmoid, nn.Mish, nn.PReLU, nn.ReLU, nn.ReLU6, nn.SELU, nn.SiLU, nn.Sigmoid),
    *(nn.Softplus, nn.Softshrink, nn.Softsign, nn.Tanh, nn.Tanhshrink),
)
# Of a policy's classes: those that are known to fit, and why another one need not.
_CLASSES: tuple[tuple[str, tuple[type, ...], str], ...] = (
    ("activation_fn", ACTIVATIONS, "is not known to give the same for the same number always"),
    ("features_extractor_class", (*FIXED, *LEARNED), "may keep more than a function of the state"),
    ("optimizer_class", ELEMENTWISE, "may look at more than a weight at a time"),
)
_FEW_STATES = 1024  # up to here all states are cheaper than finding out which ones a batch holds


def why_not(config: SB3Config, algorithm: type[BaseAlgorithm], arguments: Mapping[str, Any]) -> str | None:
    """Why these settings need SB3's own loop, or None where the tabulated one gives the same.

    It does where the network's outputs at a state follow from the parameters and that state alone: whatever
    the mode, the other states of the batch and the passes before. That is known of SB3's own networks with
    the classes that are listed; of any other class it is not, whatever its name.

    Args:
        config: the agent's settings.
        algorithm: its class, one of SB3's that has a tabulated version.
        arguments: of the class, with classes imported.
    """
    where, given = "agent", vars(config)
    if isinstance(config, SB3ClassConfig):
        where, given = "agent.arguments", config.arguments
    classes = arguments.get("policy_kwargs", {})
    if arguments["policy"] not in (algorithm.policy_aliases[name] for name in ("MlpPolicy", "CnnPolicy")):
        return f"agent.policy={config.policy} may compute more than a function of the state"
    for name, known, reason in _CLASSES:
        if name in classes and classes[name] not in known:
            own = as_dict(given.get("policy_kwargs") or {}).get(name)
            path = (
                f"{where}.policy_kwargs.{name}={own}"
                if own
                else f"observation.features={classes[name].__name__}"
            )
            return f"{path} {reason}"
    counts = arguments.get("replay_buffer_class") is ReplayCounts and issubclass(algorithm, DQN)
    for name in ("replay_buffer", "rollout_buffer"):
        is_known = arguments.get(f"{name}_class") is None or (counts and name == "replay_buffer")
        if not is_known or arguments.get(f"{name}_kwargs"):
            return f"{where}.{name}_class is not the plain {name.replace('_', ' ')}"
    if arguments.get("optimize_memory_usage"):
        return f"{where}.optimize_memory_usage changes what the replay buffer samples"
    if issubclass(algorithm, OffPolicyAlgorithm) and arguments.get("n_steps", 1) > 1:
        return f"{where}.n_steps above 1 needs SB3's n-step replay buffer"
    return None


def _is_look_up(observation: ObservationTable) -> bool:
    """Whether what a policy sees of a state is the unit vector of its number, as SB3 makes one of a number.

    Of a world in which states look alike it is that of another number.
    """
    if observation.kind not in ("one_hot", "none") or observation.stored is None:
        return observation.kind in ("one_hot", "none")
    numbers = np.arange(observation.num_states)
    own = np.eye(observation.num_states) if observation.kind == "one_hot" else numbers
    return np.array_equal(observation.stored.reshape(observation.num_states, -1), own.reshape(len(own), -1))


class StateInputs:
    """Feeds a policy's networks with states, all of them or some.

    Args:
        policy: the policy.
        observation: what it sees of a state.

    Attributes:
        mixes: whether it is run side by side with others of its kind whatever that does to its numbers.
    """

    def __init__(self, policy: BasePolicy, observation: ObservationTable) -> None:
        self.num_states = observation.num_states
        self.mixes = bool(mixed())
        self._policy = policy
        self._observation = observation
        extractors = {type(each) for each in policy.modules() if isinstance(each, BaseFeaturesExtractor)}
        self._one_hot = extractors == {FlattenExtractor} and _is_look_up(observation)
        self._is_fixed = extractors <= {FlattenExtractor, *FIXED}
        self._is_learned = extractors <= set(LEARNED)  # `learn` of `patches`
        self._all: Any = None  # of all states, the features if these never change, else the observations

    @functools.cached_property
    def kind(self) -> Hashable:
        """Equal for policies that can be run side by side: of one shape, with the same inputs."""
        may_agree = self._policy.device.type == "cpu"
        if self._is_learned or self.num_states > _FEW_STATES or not (may_agree or self.mixes):
            return id(self)
        if not can_stand(self._policy):
            return id(self)
        rows = b"" if self._one_hot else self._observation.rows(np.arange(self.num_states)).tobytes()
        return type(self._policy), repr(self._policy), self.num_states, self._observation.kind, rows

    def distinct(self, states: IntArray) -> tuple[IntArray | None, IntArray]:
        """Find the states to run the network on.

        Args:
            states: (B,), integers.

        Returns:
            (U,), these states, None for all; (B,), where in them each of `states` is.
        """
        if self.num_states <= max(_FEW_STATES, len(states)):
            return None, states
        return np.unique(states, return_inverse=True)

    def latent(self, network: nn.Sequential, states: IntArray | None, features: Tensor | None) -> Tensor:
        """Run a network.

        Args:
            network: of which the first layer is linear.
            states: (U,), integers; None: all.
            features: (U, n), of these states; None: the first layer is a look-up.
        """
        if features is not None:
            return cast(Tensor, network(features))
        first, *others = network
        weight = cast(nn.Linear, first).weight.t()
        hidden = weight if states is None else weight[torch.as_tensor(states, device=weight.device)]
        hidden = hidden + cast(nn.Linear, first).bias
        for layer in others:
            hidden = layer(hidden)
        return hidden

    def features(
        self,
        states: IntArray | None,
        extract: Callable[[Tensor], Any],
        *networks: nn.Sequential,
        extractors: Sequence[Any],
    ) -> Any:
        """What the networks are run on, of some states; computed once if no parameter has a part in it.

        Args:
            states: (U,), integers; None: all.
            extract: makes features of observations (U, *shape).
            networks: those to run on them.
            extractors: the modules by which `extract` makes features, with the same settings.

        Returns:
            What `extract` returns; None where all these networks begin with a look-up.
        """
        if self._one_hot and all(len(net) and isinstance(net[0], nn.Linear) for net in networks):
            return None
        if states is not None:
            return extract(self._tensor(states))
        if self._is_learned:
            if self._all is None:
                self._all = self._distinct_patches(extractors[0])
            found = [each.learn(*self._all) for each in extractors]
            return found[0] if len(found) == 1 else tuple(found)
        if self._all is None:
            self._all = self._tensor(np.arange(self.num_states))
            if self._is_fixed:
                with torch.no_grad():
                    self._all = extract(self._all)
        return self._all if self._is_fixed else extract(self._all)

    def _distinct_patches(self, extractor: Any) -> tuple[Tensor, Tensor]:
        """The squares that occur in the states' images, (D, k), and which are in each image, (S, P).

        Images of one world share nearly all their squares, so that few pixels are left to run the network on.
        """
        patches = extractor.patches(self._tensor(np.arange(self.num_states)))
        distinct, where = patches.flatten(0, 1).unique(dim=0, return_inverse=True)
        seen = preprocess_obs(distinct, self._policy.observation_space, self._policy.normalize_images)
        assert isinstance(seen, Tensor)
        return seen, where.view(patches.shape[:2])

    def _tensor(self, states: IntArray) -> Tensor:
        tensor, _ = self._policy.obs_to_tensor(self._observation.rows(states))
        assert isinstance(tensor, Tensor)
        return tensor


def infos_of(step: StateStep, num_envs: int) -> list[dict[str, Any]]:
    """SB3's infos, one per environment, for callbacks to read; environments that go on share an empty one."""
    infos: list[dict[str, Any]] = [{}] * num_envs
    for index, info in step.ended.items():
        infos[index] = info
    return infos


def smallest_integer(largest: int) -> np.dtype[Any]:
    """The smallest unsigned type that holds numbers up to `largest`."""
    return np.min_scalar_type(largest)
