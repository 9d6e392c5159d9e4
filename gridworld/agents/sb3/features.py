"""Features extractors, which make of each observation a vector that a small network can tell apart.

Those of different cells are at right angles, or nearly, as the unit vectors of `one_hot` are. They work in
any model of Stable-Baselines3:

    DQN("MlpPolicy", env, policy_kwargs={"features_extractor_class": FourierFeatures})
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, ClassVar

import torch
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import Tensor, nn
from torch.nn.functional import embedding, layer_norm, max_pool2d, normalize, pad, relu

from gridworld.base.errors import InputError
from gridworld.engine.networks import Kind
from gridworld.envs.observations import IMAGE_CELL_SIZE

_FEATURES, _MOST_FEATURES = 144, 4096


class _Extractor(BaseFeaturesExtractor):
    """One that is printed with its settings, by which networks are told apart."""

    kind: ClassVar[Kind] = "fixed"

    def extra_repr(self) -> str:
        given = {name: vars(self).get(name) for name in ("orders", "cell_size", "length")}
        return ", ".join(f"{name}={value}" for name, value in given.items() if value is not None)


class FourierFeatures(_Extractor):
    """The Fourier cosine basis of coordinates x in [0, 1]^d.

    The features are the products of cos(pi c_i x_i), c_i = 0, ..., n_i, divided by the length of all. Factors
    with c_i = 0 or n_i are multiplied by the root of 1/2, as in the discrete cosine transform of type I. With
    orders of rows - 1 and columns - 1 the features of a grid's cells are orthonormal; with these or larger
    ones any function of the cell is linear in them. A state without a place, whose coordinates are negative,
    has zeros.

    G. Konidaris et al.: Value Function Approximation in Reinforcement Learning using the Fourier Basis, 2011.

    Args:
        observation_space: a Box of shape (d,).
        orders: n_i of each coordinate; None: the largest with which there are at most 144 features, the same
            for each. For two coordinates it is 11, enough for grids of 12 x 12.
    """

    def __init__(self, observation_space: spaces.Space[Any], orders: Sequence[int] | None = None) -> None:
        if not isinstance(observation_space, spaces.Box) or len(observation_space.shape) != 1:
            raise InputError(
                f"FourierFeatures: needs coordinates, a Box of shape (d,), not {observation_space}"
            )
        (dimensions,) = observation_space.shape
        largest = max(int(_FEATURES ** (1 / dimensions) + 1e-9) - 1, 1)
        given = orders if isinstance(orders, Iterable) else [orders]
        self.orders: Any = [largest] * dimensions if orders is None else list(given)
        if len(self.orders) != dimensions or any(type(each) is not int or each < 0 for each in self.orders):
            raise InputError(f"FourierFeatures: orders={orders}: must be {dimensions} whole numbers")
        size = math.prod(order + 1 for order in self.orders)
        if size > _MOST_FEATURES:
            raise InputError(f"FourierFeatures: orders={orders}: {size} features; at most {_MOST_FEATURES}")
        super().__init__(observation_space, size)

    def forward(self, observations: Tensor) -> Tensor:
        """The features (n, m) of coordinates (n, d)."""
        features = torch.ones_like(observations[:, :1])
        for x, order in zip(observations.unbind(dim=1), self.orders, strict=True):
            waves = torch.cos(math.pi * torch.arange(order + 1, device=x.device) * x[:, None])
            waves[:, [0, order]] *= math.sqrt(0.5)
            features = (features[:, :, None] * waves[:, None]).flatten(1)
        return normalize(features) * (observations >= 0).all(dim=1, keepdim=True)


class AgentByColour(_Extractor):
    """The brightest colours of an image's squares, nearly where the agent stands: nothing is learned.

    The features are by how much red, green or blue exceeds the other two, the most in each square of pixels,
    divided by the length of all.

    Args:
        observation_space: of images, (3, height, width), channels first.
        cell_size: side of a square, in pixels.
    """

    def __init__(self, observation_space: spaces.Space[Any], cell_size: int = IMAGE_CELL_SIZE) -> None:
        colours, height, width = _image_shape("AgentByColour", observation_space, cell_size)
        self.cell_size = cell_size
        super().__init__(observation_space, colours * (height // cell_size) * (width // cell_size))

    def forward(self, observations: Tensor) -> Tensor:
        """The features (n, m) of images (n, 3, height, width), from 0 to 1."""
        others = torch.maximum(observations.roll(1, dims=1), observations.roll(2, dims=1))
        cells = max_pool2d((observations - others).clamp_min(0), self.cell_size)
        return normalize(cells.flatten(1))


class PixelCNN(_Extractor):
    """A small convolutional network that learns from an image's pixels.

    Two convolutions, of squares of pixels side by side and of one square's channels. Each channel of each is
    scaled to mean 0 and variance 1 over the image's squares, image by image, and rectified, so that the sizes
    of the weights do not matter. The third power lets what stands out in an image, as the agent does, weigh
    more than what fills it. The features are scaled to one length.

    What depends on no parameter (`patches`) is apart from what is learned (`learn`): it is computed once.

    D. Ulyanov, A. Vedaldi, V. Lempitsky: Instance Normalization, 2016.

    Args:
        observation_space: of images, (channels, height, width).
        cell_size: side of a square, in pixels; sides that are no multiples of it are padded with black.
        channels: of the two convolutions.
        length: of a feature vector. With 1, values as large as -100 are learned too slowly.
    """

    kind: ClassVar[Kind] = "patches"

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        cell_size: int = IMAGE_CELL_SIZE,
        channels: Sequence[int] = (16, 32),
        length: float = 3.0,
    ) -> None:
        depth, height, width = _image_shape("PixelCNN", observation_space, cell_size)
        self.rows, self.cols = -(-height // cell_size), -(-width // cell_size)
        first, second = channels
        super().__init__(observation_space, self.rows * self.cols * second)
        self.cell_size, self.length = cell_size, length
        self.padding = 0, self.cols * cell_size - width, 0, self.rows * cell_size - height
        self.first = nn.Linear(depth * cell_size**2, first, bias=False)
        self.second = nn.Linear(first, second, bias=False)

    def forward(self, observations: Tensor) -> Tensor:
        """The features (n, m) of images (n, channels, height, width), from 0 to 1."""
        return self.learn(self.patches(observations))

    def patches(self, images: Tensor) -> Tensor:
        """The squares (n, P, k) of images (n, channels, height, width), row by row."""
        side, whole = self.cell_size, pad(images, self.padding)
        cut = whole.view(len(images), -1, self.rows, side, self.cols, side)
        return cut.permute(0, 2, 4, 1, 3, 5).reshape(len(images), self.rows * self.cols, -1)

    def learn(self, patches: Tensor, where: Tensor | None = None) -> Tensor:
        """The features (n, m) of squares (n, P, k), or of distinct ones (D, k) that are at `where` (n, P)."""
        hidden = self.first(patches)
        if where is not None:
            hidden = embedding(where, hidden)
        hidden = _standing_out(hidden.transpose(1, 2))
        hidden = _standing_out(self.second(hidden.transpose(1, 2)).transpose(1, 2))
        return self.length * normalize((hidden**3).flatten(1))


def _standing_out(channels: Tensor) -> Tensor:
    """By how much each channel (n, c, P) exceeds its mean over an image, in standard deviations."""
    return relu(layer_norm(channels, channels.shape[2:]))


def _image_shape(name: str, space: spaces.Space[Any], cell_size: int) -> tuple[int, int, int]:
    shape = space.shape or ()
    if len(shape) != 3:
        raise InputError(f"{name}: needs images, (channels, height, width), not {space}")
    if not (type(cell_size) is int and 0 < cell_size <= min(shape[1:])):
        raise InputError(
            f"{name}: cell_size={cell_size}: must be from 1 to the image's {min(shape[1:])} pixels"
        )
    return shape[0], shape[1], shape[2]
