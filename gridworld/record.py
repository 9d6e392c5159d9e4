"""Frames into files: numbered PNGs, animated GIF and APNG, MP4.

The world's frames have a handful of colours, so PNG, APNG and GIF keep every pixel exact. Encoding is
Pillow's; MP4 needs PyAV (the extra `video`).
"""

from __future__ import annotations

import functools
import io
import shutil
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from gridworld.errors import InputError
from gridworld.files import replacing
from gridworld.layout import positive_int
from gridworld.mdp import IntArray, Mdp
from gridworld.render import Frame, draw_frame, fitting_cell_size

FORMATS = ("png", "gif", "apng", "mp4")

_LONGEST_SIDE = 1000  # pixels, where no cell size is asked for
_LAST_FRAME_HOLD = 4  # frames; an animation rests on its end before it starts again


def automatic_cell_size(mdp: Mdp) -> int:
    """The environment's own 100 pixels where the frame stays near 1000, less on larger maps."""
    return fitting_cell_size(mdp, _LONGEST_SIDE)


def draw_states(mdp: Mdp, states: IntArray, cell_size: int | None = None) -> list[Frame]:
    """A frame per state; one drawing serves all visits of a state."""
    size = automatic_cell_size(mdp) if cell_size is None else positive_int("cell_size", cell_size)
    drawn = {state: draw_frame(mdp, state, size) for state in dict.fromkeys(states.tolist())}
    return [drawn[state] for state in states.tolist()]


def save_pngs(frames: Sequence[Frame], folder: Path) -> None:
    """0000.png, 0001.png, ... in `folder`, which is replaced as a whole."""
    part = folder.with_name(f".{folder.name}.part")
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir(parents=True)
    digits = max(4, len(str(len(frames) - 1)))
    encoded: dict[int, bytes] = {}
    for index, (frame, image) in enumerate(zip(frames, _with_palette(frames), strict=True)):
        if id(frame) not in encoded:
            encoded[id(frame)] = _png(image)
        (part / f"{index:0{digits}}.png").write_bytes(encoded[id(frame)])
    if folder.exists():
        shutil.rmtree(folder)
    part.rename(folder)


def save_png(frame: Frame, path: Path) -> None:
    """One picture."""
    save_bytes(_png(Image.fromarray(frame)), path)


def encode_gif(frames: Sequence[Frame], fps: int) -> bytes:
    """An endless GIF. GIF counts hundredths of a second, so the rate is rounded to those."""
    return _animation(frames, "GIF", duration=10 * round(100 / fps))


def encode_apng(frames: Sequence[Frame], fps: int) -> bytes:
    """An endless animated PNG."""
    return _animation(frames, "PNG", duration=1000 / fps)


def save_mp4(frames: Sequence[Frame], path: Path, fps: int) -> None:
    """An H.264 video; an odd width or height gets one more row or column of its edge."""
    require_video()
    import av

    height, width = (side + side % 2 for side in frames[0].shape[:2])
    with replacing(path) as part, av.open(str(part), "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=fps)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        for frame in [*frames, *[frames[-1]] * _LAST_FRAME_HOLD]:
            padding = ((0, height - frame.shape[0]), (0, width - frame.shape[1]), (0, 0))
            picture = av.VideoFrame.from_ndarray(np.pad(frame, padding, mode="edge"), format="rgb24")
            container.mux(stream.encode(picture))
        container.mux(stream.encode())


def require_video() -> None:
    """Raise `InputError` where PyAV is not installed."""
    if find_spec("av") is None:
        raise InputError("mp4: needs PyAV, which is not installed; pip install 'gridworld[video]' (or av)")


def save_animation(frames: Sequence[Frame], path: Path, fps: int) -> None:
    """Write GIF, APNG or MP4, by the path's ending."""
    if path.suffix == ".mp4":
        save_mp4(frames, path, fps)
        return
    encode = {".gif": encode_gif, ".apng": encode_apng}[path.suffix]
    save_bytes(encode(frames, fps), path)


def save_bytes(content: bytes, path: Path) -> None:
    """Write an encoded animation."""
    with replacing(path) as part:
        part.write_bytes(content)


def _animation(frames: Sequence[Frame], file_format: str, duration: float) -> bytes:
    images = _with_palette(frames)
    buffer = io.BytesIO()
    durations = [duration] * (len(images) - 1) + [duration * (1 + _LAST_FRAME_HOLD)]
    images[0].save(buffer, file_format, save_all=True, append_images=images[1:], duration=durations, loop=0)
    return buffer.getvalue()


def _with_palette(frames: Sequence[Frame]) -> list[Image.Image]:
    """The frames as palette images over one palette, exact; more than 256 colours stay as they are.

    A frame that stands in the sequence several times is converted once.
    """
    unique = {id(frame): frame for frame in frames}
    images = {key: Image.fromarray(frame) for key, frame in unique.items()}
    colours: dict[tuple[int, int, int], int] = {}
    for image in images.values():
        found = image.getcolors(maxcolors=256)
        for _, colour in found or []:
            colours.setdefault(colour, len(colours))  # type: ignore[arg-type]
        if found is None or len(colours) > 256:
            return [images[id(frame)] for frame in frames]
    index = _colour_index()
    for (red, green, blue), number in colours.items():
        index[(red << 16) | (green << 8) | blue] = number
    palette = bytes(channel for colour in colours for channel in colour)
    converted: dict[int, Image.Image] = {}
    for key, frame in unique.items():
        wide = frame.astype(np.uint32)
        indexed = Image.fromarray(index[(wide[..., 0] << 16) | (wide[..., 1] << 8) | wide[..., 2]])
        indexed.putpalette(palette)
        converted[key] = indexed
    return [converted[id(frame)] for frame in frames]


@functools.cache
def _colour_index() -> NDArray[np.uint8]:
    """A number for every RGB colour, 16 MB of which only the pages of used colours are ever touched."""
    return np.zeros(1 << 24, dtype=np.uint8)


def _png(image: Image.Image) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, "PNG")
    return buffer.getvalue()
