"""Animations as palette images that are drawn one at a time: however many there are, one is in memory.

The pictures of an animation share one palette. Frames of episodes drawn here have few colours, so that every
pixel stays exact; maps, whose shapes have smooth edges, and what another library draws may have more.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from gridworld.base.errors import InputError
from gridworld.envs import rendering as drawing
from gridworld.envs.rendering import Frame, Packed
from gridworld.world.mdp import IntArray, Mdp

_MOST_COLOURS = 256
_MOST_NUMBERED = 65_535  # colours, of which the most frequent are kept
_LONGEST_SIDE = 1000  # pixels, where no cell size is asked for
_MOST_ENCODED = 8_000_000  # bytes that are kept of a world's files
_SAMPLED = 3_000_000  # bytes of all frames that a common palette is made from

Picture = NDArray[np.uint8]  # (height, width), numbers of colours
Palette = NDArray[np.uint8]  # (colours, 3), RGB
Caption = tuple[str, ...]  # lines
Encoded = dict[tuple[object, ...], bytes]  # parts of files, by the keys of the pictures that they depend on


@dataclass(frozen=True, eq=False)
class Animation:
    """Pictures one after the other, at least one."""

    keys: Sequence[Any]  # one per picture; equal keys are equal pictures
    draw: Callable[[Any], Image.Image]  # a fresh palette image for a key, all of one size and palette
    encoded: Encoded = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.keys)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return self.draw(self.keys[0]).size


def animation_of_states(
    mdp: Mdp, states: IntArray, cell_size: int | None = None, captions: Sequence[Caption] = ()
) -> Animation:
    """Show the agent in one state (pictures,) after the other, with captions in the lower border."""
    size = cell_size or drawing.fitting_cell_size(mdp, _LONGEST_SIDE)
    empty, palette, encoded = _empty_board(mdp, size)
    if sum(map(len, encoded.values())) > _MOST_ENCODED:
        encoded.clear()

    def draw(key: tuple[int, Caption]) -> Image.Image:
        left, top, width, height = drawing.agent_box(mdp, key[0], size)
        picture = empty.copy()
        picture[top : top + height, left : left + width] = 0  # the palette's first; greys follow
        for number, line in enumerate(key[1]):
            fitting = drawing.text_size(line, min(round(0.4 * size), 20), picture.shape[1] - size - 4)
            if fitting is not None:
                alpha = drawing.import_pygame().surfarray.array_alpha(drawing.in_greys(line, fitting)).T
                top = picture.shape[0] - size + round((0.3 + 0.4 * number) * size) - alpha.shape[0] // 2
                place = picture[top : top + alpha.shape[0], size : size + alpha.shape[1]]
                height, width = place.shape  # letters may be a few pixels wider than they say
                place[...] = 1 + alpha[:height, :width] // (255 // (drawing.GREYS - 1))
        return _image(picture, palette)

    keys = zip(states.tolist(), captions or [()] * len(states), strict=True)
    return Animation(list(keys), draw, encoded)


@functools.lru_cache(maxsize=2)  # of the files, and of TensorBoard
def _empty_board(mdp: Mdp, size: int) -> tuple[Picture, Palette, Encoded]:
    """What the episodes of all runs in a world have in common."""
    greys = np.linspace(255, 0, drawing.GREYS, dtype=int).tolist()
    colours = [drawing.AGENT, *((grey,) * 3 for grey in greys)]
    numbered = _number([drawing.draw_frame(mdp, None, size)], first=colours)
    assert numbered is not None  # colours of walls, cliffs, ends, lines and the greys of letters
    return numbered[0][0], numbered[1], {}


def animation_of_cards(
    mdp: Mdp, states: IntArray, cell_size: int | None = None, captions: Sequence[Caption] = ()
) -> Animation:
    """Show states (pictures,) in text: their names, and captions below these."""
    frame_size = drawing.frame_size(mdp, cell_size or drawing.fitting_cell_size(mdp, _LONGEST_SIDE))
    names = map(mdp.state_name, states.tolist())
    cards = [(name, *caption) for name, caption in zip(names, captions, strict=True)]
    greys = np.repeat(np.arange(_MOST_COLOURS, dtype=np.uint8)[:, None], 3, axis=1)

    def draw(index: int) -> Image.Image:
        surface = drawing.import_pygame().Surface(frame_size)
        drawing.draw_card(surface, cards[index])
        return _image(np.ascontiguousarray(drawing.surface_to_frame(surface)[..., 0]), greys)

    return Animation(range(len(cards)), draw)


def animation_of_frames(frames: Iterable[Frame | Packed], likely: Iterable[Sequence[int]] = ()) -> Animation:
    """Show RGB or packed frames one after the other; `likely` colours of most pixels save time.

    Of more than 256 colours the most frequent stay exact, and each other one becomes the nearest of them.
    """
    numbered = _number(frames, likely, _MOST_NUMBERED)
    if numbered is None:
        raise InputError(f"a film can have at most {_MOST_NUMBERED:,} colours")
    pictures, palette = numbered
    if len(palette) > _MOST_COLOURS:
        counts = sum(np.bincount(each.ravel(), minlength=len(palette)) for each in pictures)
        kept = np.argsort(-counts, kind="stable")[:_MOST_COLOURS]
        colours = palette.astype(np.float32)  # |a - b|² up to what all b have in common
        distance = (colours[kept] ** 2).sum(axis=1) - 2 * colours @ colours[kept].T
        nearest, palette = distance.argmin(axis=1), palette[kept]
        pictures = [nearest.astype(np.uint8)[each] for each in pictures]
    return Animation(range(len(pictures)), lambda index: _image(pictures[index].astype(np.uint8), palette))


def animation_of_rendered(
    frames: Sequence[Frame], longest_side: int | None = None, captions: Sequence[Caption] = ()
) -> Animation:
    """Show RGB frames one after the other, scaled down to `longest_side` pixels, and quantised, if necessary.

    Captions, one a frame, are written below them where there is room for them.
    """
    pictures = [_scaled_down(frame, longest_side) for frame in frames]
    room, lines = pictures[0].shape[1] - 8, [line for caption in captions for line in caption]
    sizes = [drawing.text_size(line, 16, room) for line in lines]
    if sizes and None not in sizes:
        size = min(size for size in sizes if size is not None)
        below = drawing.import_pygame().Surface((room + 8, 3 * size))
        for index, caption in enumerate(captions):
            below.fill(drawing.BACKGROUND)
            for number, line in enumerate(caption):
                drawing.write(below, line, 4, round((0.85 + 1.3 * number) * size), size)
            pictures[index] = np.concatenate([pictures[index], drawing.surface_to_frame(below)])
    if (numbered := _number(pictures)) is not None:
        numbers, palette = numbered
        return Animation(range(len(numbers)), lambda key: _image(numbers[key], palette))
    every = 1 + sum(picture.size for picture in pictures) // _SAMPLED
    sample = np.concatenate([picture.reshape(-1, 3)[::every] for picture in pictures])[None]
    common = Image.fromarray(np.ascontiguousarray(sample)).quantize(_MOST_COLOURS)
    images = [Image.fromarray(each).quantize(palette=common, dither=Image.Dither.NONE) for each in pictures]
    return Animation(range(len(images)), lambda key: images[key].copy())


def _scaled_down(frame: Frame, longest_side: int | None) -> Frame:
    height, width, _ = frame.shape
    scale = 1.0 if longest_side is None else longest_side / max(height, width)
    if scale >= 1:
        return np.ascontiguousarray(frame)
    size = max(1, round(scale * width)), max(1, round(scale * height))
    return np.asarray(Image.fromarray(frame).resize(size, Image.Resampling.LANCZOS))


def _image(picture: Picture, palette: Palette) -> Image.Image:
    image = Image.fromarray(picture)
    image.putpalette(palette.tobytes())
    return image


def _number(
    pictures: Iterable[NDArray[Any]], first: Iterable[Sequence[int]] = (), most: int = _MOST_COLOURS
) -> tuple[list[NDArray[Any]], Palette] | None:
    """The pictures as numbers into one palette, which begins with these colours; None: more than `most`."""
    numbers, numbered = _colour_numbers(), []
    palette = list(dict.fromkeys(red << 16 | green << 8 | blue for red, green, blue in first))
    try:
        numbers[palette] = range(1, 1 + len(palette))
        for picture in pictures:
            packed = drawing.pack(picture) if picture.ndim == 3 else picture
            found = numbers[packed]
            if not found.all():
                new = np.unique(packed[found == 0])
                if len(palette) + len(new) > most:
                    return None
                numbers[new] = range(1 + len(palette), 1 + len(palette) + len(new))
                palette += new.tolist()
                found = numbers[packed]
            kind = np.uint8 if most <= _MOST_COLOURS else np.uint16
            numbered.append(np.subtract(found, 1, dtype=kind, casting="unsafe"))
    finally:
        numbers[palette] = 0
    return numbered, np.array(palette, dtype=">u4").view(np.uint8).reshape(-1, 4)[:, 1:]


@functools.cache
def _colour_numbers() -> NDArray[np.uint16]:
    """The number of each RGB colour in a palette, from 1: of its 32 MB few pages are ever touched."""
    return np.zeros(1 << 24, dtype=np.uint16)
