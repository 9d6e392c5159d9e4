"""Animations as palette images that are drawn one at a time: however many there are, one is in memory.

The pictures of an animation share one palette, so nothing is quantised and every pixel stays exact.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from gridworld.envs import rendering as drawing
from gridworld.envs.rendering import Frame
from gridworld.errors import InputError
from gridworld.world.layout import positive_int
from gridworld.world.mdp import IntArray, Mdp

_MOST_COLOURS = 256
_SAMPLED = 16  # frames that a palette is chosen from
_LONGEST_SIDE = 1000  # pixels, where no cell size is asked for

Palette = NDArray[np.uint8]  # (colours, 3), RGB


@dataclass(frozen=True, eq=False)
class Animation:
    """Pictures one after the other, at least one."""

    keys: Sequence[int]  # one per picture; equal keys are equal pictures
    draw: Callable[[int], Image.Image]  # a fresh palette image for a key, all of one size and palette

    def __len__(self) -> int:
        return len(self.keys)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return self.draw(self.keys[0]).size


def automatic_cell_size(mdp: Mdp) -> int:
    """The cell size in pixels of an episode's pictures: 100, less where the frame would be far above 1000."""
    return drawing.fitting_cell_size(mdp, _LONGEST_SIDE)


def animation_of_states(mdp: Mdp, states: IntArray, cell_size: int | None = None) -> Animation:
    """Show the agent in one state after the other.

    Args:
        mdp: the world.
        states: (pictures,), the agent's states.
        cell_size: pixels; None: see `automatic_cell_size`.

    Returns:
        A picture for each state.

    Raises:
        InputError: for a cell size below 1, or where the frame would be too large to draw.
    """
    size = automatic_cell_size(mdp) if cell_size is None else positive_int("cell_size", cell_size)
    [background], palette = _indexed([drawing.draw_frame(mdp, None, size)], also=[drawing.AGENT])

    def draw(state: int) -> Image.Image:
        left, top, width, height = drawing.agent_box(mdp, state, size)
        picture = background.copy()
        picture[top : top + height, left : left + width] = 0  # the palette's first
        return _image(picture, palette)

    return Animation(states.tolist(), draw)


def animation_of_frames(frames: Sequence[Frame]) -> Animation:
    """Show frames one after the other.

    Args:
        frames: (height, width, 3) each, RGB.

    Returns:
        A picture for each frame.

    Raises:
        InputError: where they have more colours together than a palette holds.
    """
    pictures, palette = _indexed(frames)
    return Animation(range(len(pictures)), lambda index: _image(pictures[index], palette))


def animation_of_photos(frames: Sequence[Frame]) -> Animation:
    """Show frames of any colours one after the other, in the palette that is nearest to them all.

    Args:
        frames: (height, width, 3) each, RGB.

    Returns:
        A picture for each frame.
    """
    spread = np.linspace(0, len(frames) - 1, min(len(frames), _SAMPLED)).round().astype(int)
    sample = Image.fromarray(np.concatenate([frames[index] for index in spread]))
    palette = sample.quantize(_MOST_COLOURS)

    def draw(index: int) -> Image.Image:
        return Image.fromarray(frames[index]).quantize(palette=palette, dither=Image.Dither.NONE)

    return Animation(range(len(frames)), draw)


def _image(picture: NDArray[np.uint8], palette: Palette) -> Image.Image:
    image = Image.fromarray(picture)
    image.putpalette(palette.tobytes())
    return image


def _indexed(
    frames: Sequence[Frame], also: Sequence[drawing.Colour] = ()
) -> tuple[list[NDArray[np.uint8]], Palette]:
    """The frames as numbers into one palette, which begins with the colours of `also`."""
    colours = {colour: number for number, colour in enumerate(also)}
    for frame in frames:
        found = Image.fromarray(frame).getcolors(_MOST_COLOURS)
        for _, colour in found or []:
            colours.setdefault(colour, len(colours))  # type: ignore[arg-type]
        if found is None or len(colours) > _MOST_COLOURS:
            raise InputError(
                f"more than {_MOST_COLOURS} colours are too many for a film, which has one palette"
            )
    number = _colour_numbers()
    for (red, green, blue), index in colours.items():
        number[red << 16 | green << 8 | blue] = index
    pictures = [np.concatenate([number[_packed(part)] for part in _bands(frame)]) for frame in frames]
    return pictures, np.array(list(colours), dtype=np.uint8)


def _bands(frame: Frame) -> list[Frame]:
    """The frame cut into bands of about a million pixels, to need little memory beside a large one."""
    return np.array_split(frame, 1 + frame.size // 3_000_000)


def _packed(frame: Frame) -> NDArray[np.uint32]:
    """(height, width), a number per colour."""
    red, green, blue = np.moveaxis(frame.astype(np.uint32), -1, 0)
    packed: NDArray[np.uint32] = red << 16 | green << 8 | blue
    return packed


@functools.cache
def _colour_numbers() -> NDArray[np.uint8]:
    """A number for every RGB colour, 16 MB of which only the pages of used colours are ever touched."""
    return np.zeros(1 << 24, dtype=np.uint8)
