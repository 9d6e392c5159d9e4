"""P networks of one shape, run at once on the states of a world.

Row p of `weights` (P, W) holds network p as Stable-Baselines3 does: the parameters in its optimiser's order,
each (out, in), one behind the other. So a model file is a row that is cut up, and a gradient's norm adds up
in the same order. Rows begin at multiples of 64 bytes, as tensors of their own would.
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
from stable_baselines3.common.torch_layers import FlattenExtractor
from torch import Tensor, nn

from gridworld.envs.observations import ObservationTable
from gridworld.world.mdp import IntArray

Array = NDArray[Any]
# Of features extractors, `kind` of those in `agents.sb3.features`: `flat` changes nothing, `fixed` learns
# nothing, `patches` learns from squares of pixels, and `any` may do whatever.
Kind = Literal["flat", "fixed", "patches", "any"]
_LARGEST_TABLE = 2**26  # numbers of 4 bytes
ALIGNMENT = 16  # float32 numbers in 64 bytes
_FORWARD: dict[type[nn.Module], Callable[[Tensor], Tensor]] = {nn.Tanh: torch.tanh, nn.ReLU: torch.relu}
_BACKWARD: dict[type[nn.Module], Any] = {  # (slope after, output) -> slope before
    nn.Tanh: torch.ops.aten.tanh_backward,
    nn.ReLU: lambda slope, output: torch.ops.aten.threshold_backward(slope, output, 0),
}


def aligned(vectors: Tensor) -> Tensor:
    """A copy of (P, W) of which every row begins at a multiple of 64 bytes."""
    count, width = vectors.shape
    room = vectors.new_zeros(count, -(-width // ALIGNMENT) * ALIGNMENT)
    return room[:, :width].copy_(vectors)


def cut(vectors: Tensor, shapes: Sequence[torch.Size]) -> list[Tensor]:
    """Views (..., *shape) of vectors (..., W), one behind the other."""
    parts = torch.split(vectors, [shape.numel() for shape in shapes], dim=-1)
    return [part.view(*part.shape[:-1], *shape) for part, shape in zip(parts, shapes, strict=True)]


class _Rows:
    """The weights of P networks, whole or the part of them that can change.

    Attributes:
        weights: (P, W), those that learn.
        kept: (W,), which places of an SB3 row they are, where a row holds more; None: all of it.
    """

    weights: Tensor
    kept: Tensor | None = None
    _whole: Tensor  # where a row holds more, all of it; stale until `whole`

    def whole(self) -> Tensor:
        """All weights, one row for each network."""
        if self.kept is None:
            return self.weights
        self._whole[:, self.kept] = self.weights
        return self._whole

    def set_row(self, run: int, row: Tensor) -> None:
        """Set all weights of one network."""
        if self.kept is not None:
            self._whole[run] = row
        self.weights[run] = row if self.kept is None else row[self.kept]

    def spread(self, vector: Tensor) -> Tensor:
        """A row of all weights, from one (W,) of those that learn; the others are 0."""
        if self.kept is None:
            return vector
        row = vector.new_zeros(self._whole.shape[1])
        row[self.kept] = vector
        return row


class DenseNetworks(_Rows):
    """Linear layers with tanh or ReLU between them, differentiated by hand.

    A layer is a batched product of (P, U, in) with (P, in, out), which makes for each network the product
    that it makes alone. The first layer's product with a unit vector is a column of its weights.

    `gradients` (P, W) are those of the last `backward`. `met` (U,) are the only states that are ever met: in
    their columns alone, first layers of unit vectors learn. None: all are.
    """

    def __init__(self, networks: Sequence[StateNetwork], met: IntArray | None = None) -> None:
        vectors, parameters = torch.stack([each.vector() for each in networks]), networks[0].parameters
        nets, features = networks[0].layers, networks[0].table()
        place = {id(parameter): number for number, parameter in enumerate(parameters)}
        self._shapes = [parameter.shape for parameter in parameters]
        self._met = None if met is None else torch.as_tensor(met, device=vectors.device)
        if self._met is not None:
            self._whole, firsts = vectors.clone(), [place[id(net[0].weight)] for net in nets]
            self._columns = [cut(self._whole, self._shapes)[first].transpose(1, 2) for first in firsts]
            places = cut(torch.arange(vectors.shape[1], device=vectors.device), self._shapes)
            for first in firsts:
                places[first] = places[first][:, self._met]
            self._shapes = [each.shape for each in places]
            self.kept = torch.cat([each.reshape(-1) for each in places])
            vectors = vectors[:, self.kept]
        self.weights, self.gradients = aligned(vectors), aligned(torch.zeros_like(vectors))
        self._features = None if features is None else features.expand(len(vectors), *features.shape)
        self._places = [
            [(place[id(each.weight)], place[id(each.bias)]) for each in layers if isinstance(each, nn.Linear)]
            for layers in nets
        ]
        self._nets, self._slopes = self._by_layer(self.weights), self._by_layer(self.gradients)
        kinds = {type(layer) for layers in nets for layer in layers if not isinstance(layer, nn.Linear)}
        self._activation = kinds.pop() if kinds else nn.Tanh
        self._passes: list[list[Tensor | None]] = []
        self._states: Tensor | None = None

    def _by_layer(self, vectors: Tensor) -> list[list[tuple[Tensor, Tensor]]]:
        """Views of the weights and the biases in vectors (P, W), layer by layer of each output."""
        views = cut(vectors, self._shapes)
        return [[(views[weight], views[bias]) for weight, bias in pairs] for pairs in self._places]

    @staticmethod
    def fit(network: StateNetwork) -> bool:
        """Whether a network is made of such layers alone, and has no other parameters."""
        layers = [layer for net in network.layers for layer in net]
        linear = [layer for layer in layers if isinstance(layer, nn.Linear)]
        kinds = {type(layer) for layer in layers} - {nn.Linear}
        own = {id(each) for layer in linear for each in (layer.weight, layer.bias)}
        alternate = all(
            isinstance(layer, nn.Linear) == (place % 2 == 0)
            for net in network.layers
            for place, layer in enumerate(net)
        )
        known = len(kinds) <= 1 and kinds <= _FORWARD.keys()
        return known and alternate and own == {id(each) for each in network.parameters}

    def run(self, states: IntArray | None = None) -> tuple[Array, ...]:
        """Outputs (P, U, n) of states (U,), only where P is 1, or of all; the next run may overwrite them."""
        self._states = None if states is None else torch.as_tensor(states, device=self.weights.device)
        if self._met is not None:
            if self._states is None:
                self.whole()
            else:
                self._states = torch.searchsorted(self._met, self._states)
        self._passes = [self._run(number) for number in range(len(self._nets))]
        return tuple(np.asarray(passed[-1].cpu()) for passed in self._passes if passed[-1] is not None)

    def run_met(self) -> tuple[Array, ...]:
        """Outputs (P, S, n), of the states that are ever met; 0 in the others."""
        if self._met is None:
            return self.run()
        met = self._met.cpu().numpy()
        found, count = self.run(met), self._columns[0].shape[1]
        tables = [np.zeros((each.shape[0], count, each.shape[2]), each.dtype) for each in found]
        for table, each in zip(tables, found, strict=True):
            table[:, met] = each
        return tuple(tables)

    def _run(self, output: int) -> list[Tensor | None]:
        """The inputs of all layers, and the output behind the last one."""
        net, states, features = self._nets[output], self._states, self._features
        found: list[Tensor | None] = [
            features if features is None or states is None else features.index_select(1, states)
        ]
        for number, (weight, bias) in enumerate(net, 1):
            inputs = found[-1]
            if inputs is None:
                columns = weight.transpose(1, 2)
                if states is not None:
                    columns = columns[:, states]
                elif self._met is not None:
                    columns = self._columns[output]
                outputs = columns + bias[:, None]
            elif weight.shape[1] == 1 and inputs.stride(1) == 1:  # which a batch would add up otherwise
                rows = zip(inputs, weight, bias, strict=True)
                outputs = torch.stack([nn.functional.linear(*row) for row in rows])
            elif weight.shape[1] == 1:  # a batch of these adds up as one alone does, not of those below
                outputs = torch.bmm(weight, inputs.transpose(1, 2)).transpose(1, 2) + bias[:, None]
            else:
                outputs = torch.baddbmm(bias[:, None], inputs, weight.transpose(1, 2))
            found.append(_FORWARD[self._activation](outputs) if number < len(net) else outputs)
        return found

    def backward(self, *slopes: Array) -> None:
        """Set `gradients` to those of losses with these slopes in the outputs of the last run."""
        for given, net, passed, gradients in zip(slopes, self._nets, self._passes, self._slopes, strict=True):
            slope = torch.as_tensor(given.astype(np.float32), device=self.weights.device)
            for number in range(len(net) - 1, -1, -1):
                (weight, _), (of_weight, of_bias) = net[number], gradients[number]
                inputs = passed[number]
                if inputs is not None:
                    pairs = [(slope.transpose(1, 2), inputs)]
                    if slope.shape[2] == 1:  # which a batch adds up differently on some processors
                        pairs = list(zip(*(torch.split(each, 1) for each in pairs[0]), strict=True))
                    of_weight.copy_(torch.cat([torch.bmm(*pair) for pair in pairs]))
                elif self._states is None:
                    columns = slope if self._met is None else slope[:, self._met]
                    of_weight.copy_(columns.transpose(1, 2))
                else:
                    of_weight.zero_()
                    of_weight[:, :, self._states] = slope.transpose(1, 2)
                if inputs is None and self._states is None:
                    of_bias.copy_(of_weight.sum(2))
                else:
                    of_bias.copy_(slope.sum(1))
                if number:
                    slope = _BACKWARD[self._activation](torch.bmm(slope, weight), inputs)


class ModuleNetworks(_Rows):
    """Any network of one run, differentiated by torch; its parameters become views of its row of weights."""

    def __init__(self, network: StateNetwork) -> None:
        vectors, parameters = network.vector()[None], network.parameters
        self.weights, self.gradients = aligned(vectors), aligned(torch.zeros_like(vectors))
        shapes = [each.shape for each in parameters]
        rows = zip(parameters, cut(self.weights[0], shapes), cut(self.gradients[0], shapes), strict=True)
        for parameter, data, grad in rows:
            parameter.data, parameter.grad = data, grad
        self._forward, self._parameters = network.forward, parameters
        self._outputs: tuple[Tensor, ...] = ()

    def run(self, states: IntArray | None = None) -> tuple[Array, ...]:
        self._outputs = ()
        with torch.enable_grad():
            self._outputs = self._forward(states)
        return tuple(output.detach().cpu().numpy()[None] for output in self._outputs)

    def run_met(self) -> tuple[Array, ...]:
        return self.run()

    def backward(self, *slopes: Array) -> None:
        self.gradients.zero_()
        given = [
            torch.as_tensor(slope, dtype=output.dtype, device=output.device).view_as(output)
            for slope, output in zip(slopes, self._outputs, strict=True)
        ]
        torch.autograd.backward(self._outputs, given, retain_graph=True, inputs=self._parameters)


Networks = DenseNetworks | ModuleNetworks


class StateNetwork:
    """A network of SB3's policy, or its target network, which sees states.

    Features that no parameter has a part in are a table, made once. So are the distinct squares of pixels of
    all images, which is what a network begins with that learns from pixels. A one-hot row times the first
    layer's weights is a column of these: for one-hot observations that layer is a look-up.

    Args:
        policy: the policy.
        observation: what it sees of a state.
        layers: those of each output, behind the features.
        parameters: its own, in the order of its optimiser and of a row.
        extractors: the modules that make features of observations, one, or one for each output.
        extract: makes features of observations (U, *shape): a tensor, or one for each output.
    """

    def __init__(
        self,
        policy: BasePolicy,
        observation: ObservationTable,
        layers: Sequence[Sequence[nn.Module]],
        parameters: Sequence[nn.Parameter],
        extractors: Sequence[Any],
        extract: Callable[[Tensor], Any],
    ) -> None:
        self.layers, self.parameters = layers, parameters
        self._policy, self._observation = policy, observation
        self._extractors, self._extract = extractors, extract
        kinds = {_kind(each) for each in extractors}
        kind = kinds.pop() if len(kinds) == 1 else "any"
        begin_linear = all(len(net) > 0 and isinstance(net[0], nn.Linear) for net in layers)
        self.is_look_up = kind == "flat" and begin_linear and _is_one_hot(observation)
        self._is_fixed = kind in ("flat", "fixed")
        self._is_learned = kind == "patches"
        self._all: Any = None  # of all states, the features if these never change, else the observations

    def vector(self) -> Tensor:
        """(W,), its weights as they are in SB3's model."""
        return torch.cat([parameter.detach().reshape(-1) for parameter in self.parameters])

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
            return tuple(_look_up(*net, states=states) for net in self.layers)
        features = self._features(states)
        given = features if isinstance(features, tuple) else (features,) * len(self.layers)
        return tuple(_run(net, each) for net, each in zip(self.layers, given, strict=True))

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


def make_networks(networks: Sequence[StateNetwork], met: IntArray | None = None) -> Networks:
    """Those of P policies at once, with the weights that SB3's models have; see `DenseNetworks` for `met`."""
    first = networks[0]
    if DenseNetworks.fit(first) and (first.is_look_up or first.table() is not None):
        return DenseNetworks(networks, met)
    (alone,) = networks
    return ModuleNetworks(alone)


def _kind(extractor: Any) -> Kind:
    return "flat" if type(extractor) is FlattenExtractor else getattr(extractor, "kind", "any")


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
