"""Features extractors without parameters: fixed functions of what an agent sees, which a network learns from.

Two numbers, or thousands of pixels of which few differ, are hard to tell apart for a small network. Here each
observation becomes a vector of length 1, and those of different cells are at right angles, or nearly, as the
unit vectors of `one_hot` are. They work in any model of Stable-Baselines3:

    DQN("MlpPolicy", env, policy_kwargs={"features_extractor_class": FourierFeatures})
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

import torch
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import Tensor
from torch.nn.functional import max_pool2d, normalize

from gridworld.envs.observations import IMAGE_CELL_SIZE
from gridworld.errors import InputError

_FEATURES, _MOST_FEATURES = 144, 4096


class FourierFeatures(BaseFeaturesExtractor):
    """The Fourier cosine basis of coordinates x in [0, 1]^d.

    The features are the products of cos(pi c_i x_i), c_i = 0, ..., n_i, divided by the length of all. Factors
    with c_i = 0 or n_i are multiplied by the root of 1/2, as in the discrete cosine transform of type I. With
    orders of rows - 1 and columns - 1 the features of a grid's cells are orthonormal. With these or larger
    ones, linear functions of them are all functions of the cell. A state without a place, whose coordinates
    are negative, has zeros.

    G. Konidaris, S. Osentoski, P. Thomas: Value Function Approximation in Reinforcement Learning using the
    Fourier Basis, AAAI 2011. R. Sutton, A. Barto: Reinforcement Learning, section 9.5.2.

    Args:
        observation_space: a Box of shape (d,).
        orders: n_i of each coordinate; None: the largest with which there are at most 144 features, the same
            for each. For two coordinates it is 11, enough for grids of 12 x 12.

    Raises:
        InputError: another space, other orders, or more features than 4096.
    """

    def __init__(self, observation_space: spaces.Space[Any], orders: Sequence[int] | None = None) -> None:
        if not isinstance(observation_space, spaces.Box) or len(observation_space.shape) != 1:
            raise InputError(
                "FourierFeatures: the observation must be coordinates, a Box of shape (d,); it is "
                f"{observation_space}"
            )
        (dimensions,) = observation_space.shape
        largest = max(int(_FEATURES ** (1 / dimensions) + 1e-9) - 1, 1)
        given = orders if isinstance(orders, Iterable) else [orders]
        self.orders: Any = [largest] * dimensions if orders is None else list(given)
        if len(self.orders) != dimensions or any(type(each) is not int or each < 0 for each in self.orders):
            raise InputError(
                f"FourierFeatures: orders={orders}: must be {dimensions} whole numbers, one for each "
                "coordinate"
            )
        size = math.prod(order + 1 for order in self.orders)
        if size > _MOST_FEATURES:
            raise InputError(
                f"FourierFeatures: {dimensions} coordinates of these orders make {size} features, more than "
                f"{_MOST_FEATURES}"
            )
        super().__init__(observation_space, size)

    def forward(self, observations: Tensor) -> Tensor:
        """The features (n, m) of coordinates (n, d)."""
        features = torch.ones_like(observations[:, :1])
        for x, order in zip(observations.unbind(dim=1), self.orders, strict=True):
            waves = torch.cos(math.pi * torch.arange(order + 1, device=x.device) * x[:, None])
            waves[:, [0, order]] *= math.sqrt(0.5)
            features = (features[:, :, None] * waves[:, None]).flatten(1)
        return normalize(features) * (observations >= 0).all(dim=1, keepdim=True)

    def extra_repr(self) -> str:
        """Its settings, by which networks are told apart."""
        return f"orders={self.orders}"


class ImageCells(BaseFeaturesExtractor):
    """The brightest colours of an image's cells.

    What counts of a pixel is by how much red, green or blue exceeds the other two: white and greys are 0. The
    features are the largest of each colour in each square of pixels, divided by the length of all.

    Args:
        observation_space: of images, (3, height, width), channels first.
        cell_size: side of a square, in pixels.

    Raises:
        InputError: another space, or squares that are larger than the image.
    """

    def __init__(self, observation_space: spaces.Space[Any], cell_size: int = IMAGE_CELL_SIZE) -> None:
        shape = observation_space.shape or ()
        if len(shape) != 3 or shape[0] != 3:
            raise InputError(
                "ImageCells: the observation must be an image of shape (3, height, width); it is "
                f"{observation_space}"
            )
        if not (type(cell_size) is int and 0 < cell_size <= min(shape[1:])):
            raise InputError(
                f"ImageCells: cell_size={cell_size}: must be from 1 to the image's {min(shape[1:])} pixels"
            )
        self.cell_size = cell_size
        super().__init__(observation_space, 3 * (shape[1] // cell_size) * (shape[2] // cell_size))

    def forward(self, observations: Tensor) -> Tensor:
        """The features (n, m) of images (n, 3, height, width), from 0 to 1."""
        others = torch.maximum(observations.roll(1, dims=1), observations.roll(2, dims=1))
        cells = max_pool2d((observations - others).clamp_min(0), self.cell_size)
        return normalize(cells.flatten(1))

    def extra_repr(self) -> str:
        """Its settings, by which networks are told apart."""
        return f"cell_size={self.cell_size}"


FIXED = (FourierFeatures, ImageCells)  # functions of an observation alone, which never change
