"""Animations as palette images that are drawn one at a time: however many there are, one is in memory.

The pictures of an animation share one palette. Those drawn here have few colours, so that every pixel stays
exact; what an environment of another library draws may have more than a palette, and is quantised.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from gridworld.envs import rendering as drawing
from gridworld.envs.rendering import Colour, Frame
from gridworld.envs.rollout import Episode
from gridworld.errors import InputError
from gridworld.world.layout import positive_int
from gridworld.world.mdp import IntArray, Mdp

_MOST_COLOURS = 256
_LONGEST_SIDE = 1000  # pixels, where no cell size is asked for
_SAMPLED = 3_000_000  # bytes of all frames that a common palette is made from

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
    empty = [drawing.draw_frame(mdp, None, size)]
    colours = _colours(empty, also=[drawing.AGENT])
    assert colours is not None  # of walls, cliffs, ends, lines and the greys of letters
    [background], palette = _numbered(empty, colours)

    def draw(state: int) -> Image.Image:
        left, top, width, height = drawing.agent_box(mdp, state, size)
        picture = background.copy()
        picture[top : top + height, left : left + width] = 0  # the palette's first
        return _image(picture, palette)

    return Animation(states.tolist(), draw)


def animation_of_cards(mdp: Mdp, episodes: Sequence[Episode], cell_size: int | None = None) -> Animation:
    """Tell episodes in text: each picture has a state, the action taken there, and the reward so far.

    Args:
        mdp: the world, of which only the names of states and actions are shown.
        episodes: one after the other.
        cell_size: pixels; None: see `automatic_cell_size`.

    Returns:
        A picture for each state of each episode.

    Raises:
        InputError: see `animation_of_states`.
    """
    size = automatic_cell_size(mdp) if cell_size is None else positive_int("cell_size", cell_size)
    frame_size = drawing.frame_size(mdp, size)
    cards = [lines for episode in episodes for lines in _cards(mdp, episode)]

    def draw(index: int) -> Image.Image:
        surface = drawing.import_pygame().Surface(frame_size)
        drawing.draw_card(surface, cards[index])
        greys = np.repeat(np.arange(_MOST_COLOURS, dtype=np.uint8)[:, None], 3, axis=1)
        return _image(np.ascontiguousarray(drawing.surface_to_frame(surface)[..., 0]), greys)

    return Animation(range(len(cards)), draw)


def _cards(mdp: Mdp, episode: Episode) -> Iterator[tuple[str, ...]]:
    actions = [f"action {mdp.action_names[action]}" for action in episode.actions.tolist()]
    earned = np.concatenate([[0.0], np.cumsum(episode.rewards)]).tolist()
    for step, state in enumerate(episode.states.tolist()):
        end = "goal" if mdp.goal[state] else "the end" if mdp.terminal[state] else "the step limit"
        what = actions[step] if step < len(actions) else end
        yield mdp.state_name(state), f"step {step}: {what}", f"reward so far {earned[step]:.6g}"


def animation_of_frames(frames: Sequence[Frame]) -> Animation:
    """Show frames one after the other.

    Args:
        frames: (height, width, 3) each, RGB.

    Returns:
        A picture for each frame.

    Raises:
        InputError: where they have more colours together than a palette holds.
    """
    colours = _colours(frames)
    if colours is None:
        raise InputError(f"more than {_MOST_COLOURS} colours are too many for a film, which has one palette")
    pictures, palette = _numbered(frames, colours)
    return Animation(range(len(pictures)), lambda index: _image(pictures[index], palette))


def animation_of_rendered(
    frames: Sequence[Frame], keys: Sequence[int], longest_side: int | None = None
) -> Animation:
    """Show frames of any number of colours in some order.

    Args:
        frames: (height, width, 3) each, RGB, all of one size.
        keys: the number of the frame that each picture shows.
        longest_side: pixels; larger frames are scaled down. None: they stay as they are.

    Returns:
        A picture for each key; quantised where the frames have more colours than a palette.
    """
    pictures = [_scaled_down(frame, longest_side) for frame in frames]
    colours = _colours(pictures)
    if colours is not None:
        numbers, palette = _numbered(pictures, colours)
        return Animation(keys, lambda key: _image(numbers[key], palette))
    every = 1 + sum(picture.size for picture in pictures) // _SAMPLED
    sample = np.concatenate([picture.reshape(-1, 3)[::every] for picture in pictures])[None]
    common = Image.fromarray(np.ascontiguousarray(sample)).quantize(_MOST_COLOURS)
    images = [Image.fromarray(each).quantize(palette=common, dither=Image.Dither.NONE) for each in pictures]
    return Animation(keys, lambda key: images[key].copy())


def _scaled_down(frame: Frame, longest_side: int | None) -> Frame:
    height, width, _ = frame.shape
    scale = 1.0 if longest_side is None else longest_side / max(height, width)
    if scale >= 1:
        return np.ascontiguousarray(frame)
    size = max(1, round(scale * width)), max(1, round(scale * height))
    return np.asarray(Image.fromarray(frame).resize(size, Image.Resampling.LANCZOS))


def _image(picture: NDArray[np.uint8], palette: Palette) -> Image.Image:
    image = Image.fromarray(picture)
    image.putpalette(palette.tobytes())
    return image


def _colours(frames: Sequence[Frame], also: Sequence[drawing.Colour] = ()) -> dict[Colour, int] | None:
    """The number of each colour, from `also` on; None where there are too many."""
    colours = {colour: number for number, colour in enumerate(also)}
    for frame in frames:
        found = Image.fromarray(frame).getcolors(_MOST_COLOURS)
        for _, colour in found or []:
            colours.setdefault(colour, len(colours))  # type: ignore[arg-type]
        if found is None or len(colours) > _MOST_COLOURS:
            return None
    return colours


def _numbered(frames: Sequence[Frame], colours: dict[Colour, int]) -> tuple[list[NDArray[np.uint8]], Palette]:
    """The frames as numbers into one palette."""
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
