"""Animations as palette images that are drawn one at a time: however many there are, one is in memory.

The pictures of an animation share one palette. Those drawn here have few colours, so that every pixel stays
exact; what an environment of another library draws may have more than a palette, and is quantised.
"""

from __future__ import annotations

import functools
import math
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from gridworld.envs import rendering as drawing
from gridworld.envs.rendering import Frame, Packed
from gridworld.envs.rollout import Episode
from gridworld.errors import InputError
from gridworld.world.layout import positive_int
from gridworld.world.mdp import IntArray, Mdp

_MOST_COLOURS = 256
_LONGEST_SIDE = 1000  # pixels, where no cell size is asked for
_MOST_SIZES = 2  # of a world's boards that are kept: of the files, and of TensorBoard
_MOST_ENCODED = 8_000_000  # bytes that are kept of each
_SAMPLED = 3_000_000  # bytes of all frames that a common palette is made from

Palette = NDArray[np.uint8]  # (colours, 3), RGB
Numbered = tuple[list[NDArray[np.uint8]], Palette]  # pictures, (height, width) each, and what they refer to


# Parts of files, by the keys of the pictures that they depend on.
Encoded = dict[tuple[object, ...], bytes]


@dataclass(frozen=True, eq=False)
class Animation:
    """Pictures one after the other, at least one."""

    keys: Sequence[int]  # one per picture; equal keys are equal pictures
    draw: Callable[[int], Image.Image]  # a fresh palette image for a key, all of one size and palette
    encoded: Encoded = field(default_factory=dict)  # files' parts, by the keys that they depend on

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
    """
    size = automatic_cell_size(mdp) if cell_size is None else positive_int("cell_size", cell_size)
    empty = _empty_board(mdp, size)

    def draw(state: int) -> Image.Image:
        left, top, width, height = drawing.agent_box(mdp, state, size)
        picture = empty.picture.copy()
        picture[top : top + height, left : left + width] = 0  # the palette's first
        return _image(picture, empty.palette)

    return Animation(states.tolist(), draw, empty.encoded)


@dataclass(frozen=True, eq=False)
class _EmptyBoard:
    """What the episodes of all runs in a world have in common."""

    picture: NDArray[np.uint8]
    palette: Palette
    encoded: Encoded = field(default_factory=dict)


_boards: WeakKeyDictionary[Mdp, dict[int, _EmptyBoard]] = WeakKeyDictionary()


def _empty_board(mdp: Mdp, size: int) -> _EmptyBoard:
    """The board in cells of `size` pixels, drawn once per process; of a world the newest sizes are kept."""
    boards = _boards.setdefault(mdp, {})
    board = boards.pop(size, None)
    if board is None:
        empty = drawing.draw_frame(mdp, None, size)
        numbered = _number([empty], first=[drawing.AGENT, drawing.BACKGROUND])
        assert numbered is not None  # colours of walls, cliffs, ends, lines and the greys of letters
        board = _EmptyBoard(numbered[0][0], numbered[1])
    if sum(map(len, board.encoded.values())) > _MOST_ENCODED:
        board.encoded.clear()
    if board.picture.size <= _MOST_ENCODED:
        boards[size] = board
    for oldest in list(boards)[:-_MOST_SIZES]:
        del boards[oldest]
    return board


def animation_of_cards(mdp: Mdp, episodes: Sequence[Episode], cell_size: int | None = None) -> Animation:
    """Tell episodes in text: each picture has a state, the action taken there, and the reward so far.

    Args:
        mdp: the world, of which only the names of states and actions are shown.
        episodes: one after the other.
        cell_size: pixels; None: see `automatic_cell_size`.

    Returns:
        A picture for each state of each episode.
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


def animation_of_frames(frames: Iterable[Frame | Packed], likely: Iterable[Sequence[int]] = ()) -> Animation:
    """Show frames one after the other.

    Args:
        frames: (height, width, 3) each, RGB, or (height, width), see `envs.rendering.Packed`.
        likely: colours that the palette begins with; to know those of most pixels before saves time.

    Returns:
        A picture for each frame.
    """
    numbered = _number(frames, likely)
    if numbered is None:
        raise InputError(f"more than {_MOST_COLOURS} colours are too many for a film, which has one palette")
    pictures, palette = numbered
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
    if (numbered := _number(pictures)) is not None:
        numbers, palette = numbered
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


def _number(pictures: Iterable[Frame | Packed], first: Iterable[Sequence[int]] = ()) -> Numbered | None:
    """The pictures as numbers into one palette, which begins with these colours; None: too many colours."""
    palette = list(dict.fromkeys(red << 16 | green << 8 | blue for red, green, blue in first))
    numbered = []
    with _one_at_a_time:
        numbers = _colour_numbers()
        try:
            numbers[palette] = range(1, 1 + len(palette))
            for picture in pictures:
                # Bands of about a million pixels need little memory beside a large picture.
                bands: list[NDArray[Any]] = np.array_split(
                    picture, 1 + math.prod(picture.shape[:2]) // 1_000_000
                )
                numbered.append(np.concatenate([_look_up(band, numbers, palette) for band in bands]))
        except _TooManyColoursError:
            return None
        finally:
            numbers[palette] = 0
    return numbered, np.array(palette, dtype=">u4").view(np.uint8).reshape(-1, 4)[:, 1:]


def _look_up(band: NDArray[Any], numbers: NDArray[np.uint16], palette: list[int]) -> NDArray[np.uint8]:
    """The places of the band's colours in the palette, which gets those that are new."""
    packed = drawing.pack(band) if band.ndim == 3 else band
    found = numbers[packed]
    if not found.all():
        new = np.unique(packed[found == 0])
        if len(palette) + len(new) > _MOST_COLOURS:
            raise _TooManyColoursError
        numbers[new] = range(1 + len(palette), 1 + len(palette) + len(new))
        palette += new.tolist()
        found = numbers[packed]
    return np.subtract(found, 1, dtype=np.uint8, casting="unsafe")


class _TooManyColoursError(Exception):
    pass


_one_at_a_time = threading.Lock()  # they use one table


@functools.cache
def _colour_numbers() -> NDArray[np.uint16]:
    """Zeros for all RGB colours: 32 MB of which only the pages of used colours are ever touched."""
    return np.zeros(1 << 24, dtype=np.uint16)
