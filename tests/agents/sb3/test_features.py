"""Features extractors: what they make of coordinates and of images."""

from itertools import product
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from torch import Tensor

import gridworld
from gridworld.agents.sb3.features import AgentByColour, FourierFeatures, PixelCNN
from gridworld.base.errors import InputError
from gridworld.envs.observations import make_observation

PLANE, IMAGE = spaces.Box(0, 1, (2,), np.float32), spaces.Box(0, 255, (3, 8, 9), np.uint8)


def places(rows: int, cols: int) -> Tensor:
    cells = product(np.linspace(0, 1, rows), np.linspace(0, 1, cols))
    return torch.tensor(np.array(list(cells)), dtype=torch.float32)


@pytest.mark.parametrize(("rows", "cols"), [(5, 6), (2, 2), (1, 7), (12, 9)])
def test_with_the_grids_own_orders_cells_are_orthonormal(rows: int, cols: int) -> None:
    features = FourierFeatures(PLANE, [rows - 1, cols - 1])(places(rows, cols))
    assert features.shape == (rows * cols, rows * cols)
    assert torch.allclose(features @ features.T, torch.eye(rows * cols), atol=1e-5)
    default = FourierFeatures(PLANE)  # any function of the cells is linear in these
    assert default.orders == [11, 11]
    assert torch.linalg.svdvals(default(places(rows, cols)).double())[rows * cols - 1] > 0.5
    nowhere = torch.tensor([[-1.0, -1.0], [1.0, 1.0]])  # a state without a place, and a cell
    assert (default(nowhere).norm(dim=1) > 0).tolist() == [False, True]


@pytest.mark.parametrize("cell_size", [8, 16])
@pytest.mark.parametrize("layout", ["classic", "cliff", "four_rooms"])
def test_images_of_different_cells_are_far_apart(layout: str, cell_size: int) -> None:
    mdp = gridworld.compose(f"env={layout}").env.compile()
    images = make_observation(mdp, "image", cell_size)
    features = AgentByColour(images.space)(torch.tensor(images.table()) / 255)
    assert torch.allclose(features.norm(dim=1), torch.ones(mdp.num_states))
    inside = features[~torch.tensor(mdp.absorbing)]
    distances = torch.cdist(inside, inside) + 9 * torch.eye(len(inside))
    assert distances.min() > 1  # unit vectors are 1.41 apart


def test_an_images_cells_are_their_brightest_colours() -> None:
    image = torch.zeros(1, 3, 5, 4)
    image[0, :, 0, 0] = 0.7  # grey
    image[0, :, 1, 1] = torch.tensor([0.2, 0.3, 0.9])
    image[0, :, 3, 2] = torch.tensor([0.8, 0.4, 0.0])
    cells = AgentByColour(spaces.Box(0, 255, (3, 5, 4), np.uint8), cell_size=2)
    found = cells(image).reshape(3, 2, 2) * np.hypot(0.6, 0.4)
    expected = torch.zeros(3, 2, 2)
    expected[2, 0, 0], expected[0, 1, 1] = 0.6, 0.4
    assert torch.allclose(found, expected)
    assert torch.equal(cells(torch.ones(1, 3, 5, 4)), torch.zeros(1, 12))


def an_image_network(**arguments: Any) -> tuple[PixelCNN, torch.Tensor]:
    images = make_observation(gridworld.compose("env=four_rooms").env.compile(), "image", 8)
    torch.manual_seed(0)
    return PixelCNN(images.space, **arguments), torch.tensor(images.table()) / 255


@pytest.mark.parametrize("cell_size", [8, 5, 3])  # of which the frame is no multiple
def test_a_convolution_of_squares_is_a_product_of_their_pixels(cell_size: int) -> None:
    network, images = an_image_network(cell_size=cell_size)
    kernel = network.first.weight.reshape(16, 3, cell_size, cell_size)
    rows, cols = (-(-side // cell_size) for side in images.shape[2:])
    padded = torch.zeros(len(images), 3, rows * cell_size, cols * cell_size)
    padded[:, :, : images.shape[2], : images.shape[3]] = images
    expected = torch.nn.functional.conv2d(padded, kernel, stride=cell_size).flatten(2)
    found = network.first(network.patches(images)).transpose(1, 2)
    assert torch.allclose(found, expected, atol=1e-5)


def test_learned_features_have_one_length_and_follow_from_distinct_squares() -> None:
    network, images = an_image_network(length=2.0)
    features = network(images)
    assert features.shape == (len(images), network.features_dim)
    assert torch.allclose(features.norm(dim=1), torch.tensor(2.0))
    patches = network.patches(images)
    distinct, where = patches.flatten(0, 1).unique(dim=0, return_inverse=True)
    assert len(distinct) < 20 < len(images)
    assert torch.allclose(network.learn(distinct, where.view(patches.shape[:2])), features, atol=1e-6)
    assert torch.allclose(network(images[3:5]), features[3:5], atol=1e-6)  # of one image alone
    features.sum().backward()
    assert all(weight.grad is not None and weight.grad.any() for weight in network.parameters())


@pytest.mark.parametrize(
    ("kind", "arguments", "words"),
    [
        (FourierFeatures, [spaces.Discrete(3)], "needs coordinates, a Box of shape (d,), not Discrete(3)"),
        (FourierFeatures, [PLANE, [3, -1]], "orders=[3, -1]: must be 2 whole numbers"),
        (FourierFeatures, [PLANE, [[1, 2], 3]], "orders=[[1, 2], 3]: must be 2 whole numbers"),
        (FourierFeatures, [PLANE, [99, 99]], "orders=[99, 99]: 10000 features; at most 4096"),
        (AgentByColour, [PLANE], "needs images, (channels, height, width)"),
        (AgentByColour, [IMAGE, 10], "from 1 to the image's 8 pixels"),
        (PixelCNN, [PLANE], "PixelCNN: needs images, (channels, height, width)"),
        (PixelCNN, [IMAGE, True], "PixelCNN: cell_size=True: must be from 1"),
    ],
)
def test_what_they_cannot_take(kind: Any, arguments: list[Any], words: str) -> None:
    with pytest.raises(InputError) as mistake:
        kind(*arguments)
    assert words in str(mistake.value)
