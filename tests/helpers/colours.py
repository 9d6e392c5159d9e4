"""Whether colours can be told from those below them, and what a transparent picture leaves of these."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

GROUNDS = ((255, 255, 255), (19, 20, 22), (0, 0, 0))  # a light page, the site when it is dark, a viewer


def luminance(colour: ArrayLike) -> NDArray[np.float64]:
    """Relative luminance of colours (..., 3) of 255. Reference: W3C, WCAG 2.1, 2018."""
    share = np.asarray(colour) / 255
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return np.asarray(linear @ [0.2126, 0.7152, 0.0722])


def contrast(one: ArrayLike, other: ArrayLike) -> NDArray[np.float64]:
    """The contrast of two colours, from 1 to 21, as in WCAG 2.1."""
    first, second = luminance(one) + 0.05, luminance(other) + 0.05
    return np.asarray(np.maximum(first / second, second / first))


def check_words(part: NDArray[np.uint8]) -> None:
    """A part of a picture (height, width, 4) has words alone, on nothing, readable on every ground."""
    letters = part[part[..., 3] > 240][:, :3]
    assert len(letters) > 20
    assert (part[..., 3] == 0).mean() > 0.5
    assert all(contrast(letters, ground).min() >= 3 for ground in GROUNDS)


def opaque(part: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A part of a picture, in RGB, through which nothing of the page is seen."""
    assert (part[..., 3:] == 255).all()
    return part[..., :3]
