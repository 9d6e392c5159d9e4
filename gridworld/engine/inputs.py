"""What a policy's networks see of each state.

Features that no parameter has a part in are a table, made once. So are the distinct squares of pixels of all
images, which is what a network begins with that learns from pixels. A one-hot row times the first layer's
weights is a column of these: for one-hot observations that layer is a look-up, without a matrix of S x S.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from typing import Any, Literal, cast

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import preprocess_obs
from torch import Tensor, nn

from gridworld.envs.observations import ObservationTable
from gridworld.world.mdp import IntArray

_LARGEST_TABLE = 2**26  # numbers of 4 bytes


class Inputs:
    """Feeds a policy's networks with states.

    Args:
        policy: the policy.
        observation: what it sees of a state.
        nets: the layers of each of its outputs.
        extractors: the modules that make features of observations, one, or one for each output.
        extract: makes features of observations (U, *shape): a tensor, or one for each output.
        kind: of the extractors: `flat` changes nothing, `fixed` learns nothing, `patches` learns from squares
            of pixels (`agents.sb3.features.PixelCNN`), and `any` may do whatever.
    """

    def __init__(
        self,
        policy: BasePolicy,
        observation: ObservationTable,
        nets: Sequence[Sequence[nn.Module]],
        extractors: Sequence[Any],
        extract: Callable[[Tensor], Any],
        kind: Literal["flat", "fixed", "patches", "any"],
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
        """Run the policy's own modules.

        Args:
            states: (U,), which states; None: all.

        Returns:
            (U, n) of each output, with its graph.
        """
        if self.is_look_up:
            return tuple(_look_up(net, states) for net in self._nets)
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
    """Whether what a policy sees of a state is the unit vector of its number, as SB3 makes one of a number.

    Of a world in which states look alike it is that of another number.
    """
    if observation.kind not in ("one_hot", "none") or observation.stored is None:
        return observation.kind in ("one_hot", "none")
    numbers = np.arange(observation.num_states)
    own = np.eye(observation.num_states) if observation.kind == "one_hot" else numbers
    return np.array_equal(observation.stored.reshape(observation.num_states, -1), own.reshape(len(own), -1))


def _look_up(net: Sequence[nn.Module], states: IntArray | None) -> Tensor:
    first, *others = net
    weight = cast(nn.Linear, first).weight.t()
    columns = weight if states is None else weight[torch.as_tensor(states, device=weight.device)]
    return _run(others, columns + cast(nn.Linear, first).bias)


def _run(layers: Sequence[nn.Module], hidden: Tensor) -> Tensor:
    for layer in layers:
        hidden = layer(hidden)
    return hidden
