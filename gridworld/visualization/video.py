"""Animations as files: numbered PNGs, GIF, animated PNG (APNG) and MP4.

PNG, APNG and GIF keep every pixel exact. MP4 needs PyAV (the extra `video`).
"""

from __future__ import annotations

import io
from collections.abc import Callable, Collection, Iterator
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from PIL import GifImagePlugin, ImageChops

from gridworld.envs.rendering import Frame
from gridworld.errors import InputError, install_command
from gridworld.storage.atomic_write import replacing, replacing_folder, write_bytes
from gridworld.visualization.animation import Animation
from gridworld.visualization.png import encode_palette_png, encode_png

FORMATS = ("png", "gif", "apng", "mp4")
MOST_APNG_PIXELS = 500_000_000  # of all pictures together, which Pillow holds in memory, a byte each
MOST_MP4_PIXELS = 4096 * 2304  # of a picture: level 5.2 of H.264, which is as far as most players go

_LAST_FRAME_HOLD = 4  # frames; the last one is shown for so many more before the animation starts again
_LONGEST_GIF_FRAME = 0xFFFF  # hundredths of a second


def save_pngs(film: Animation, folder: Path) -> None:
    """Write 0000.png, 0001.png, ... into `folder`, which is replaced as a whole, also where it is a link."""
    digits = max(4, len(str(len(film) - 1)))
    with replacing_folder(folder) as part:
        for index, key in enumerate(film.keys):
            content = _encoded(film, ("png", key), partial(_encode_png_frame, film, key))
            (part / f"{index:0{digits}}.png").write_bytes(content)


def _encode_png_frame(film: Animation, key: int) -> bytes:
    return encode_palette_png(film.draw(key))


def _encoded(film: Animation, place: tuple[object, ...], encode: Callable[[], bytes]) -> bytes:
    if place not in film.encoded:
        film.encoded[place] = encode()
    return film.encoded[place]


def save_png(frame: Frame, path: Path) -> None:
    """Write one picture as a PNG file."""
    write_bytes(path, encode_png(frame))


def encode_gif(film: Animation, fps: int) -> bytes:
    """Encode an endless GIF.

    Pillow encodes each picture. Its `save_all` is not used: it holds all pictures in memory, writes the
    palette again with each, and fails where a picture is shown for longer than GIF can say.

    Args:
        film: its pictures share one palette, so that comparing them as numbers tells what changed.
        fps: pictures per second. GIF counts hundredths of a second, so it is rounded to those.

    Returns:
        The file's content. After the first picture it has only the box of each in which something changed.
    """
    parts: list[bytes] = []
    before: int | None = None
    for key, duration in _gif_frames(film, round(100 / fps)):
        encode = partial(_encode_gif_frame, film, before, key, duration)
        parts.append(_encoded(film, ("gif", before, key, duration), encode))
        before = key
    return b"".join([*parts, b";"])


def _encode_gif_frame(film: Animation, before: int | None, key: int, duration: int) -> bytes:
    """A picture after another one, for hundredths of a second; the first one with the file's header."""
    now, header = film.draw(key), []
    if before is None:
        header = GifImagePlugin.getheader(now, info={"loop": 0})[0]
        box = (0, 0, *now.size)
    else:
        box = ImageChops.subtract_modulo(now, film.draw(before)).getbbox() or (0, 0, 1, 1)
    # milliseconds; disposal 1: the next picture is drawn over this one
    return b"".join(
        [*header, *GifImagePlugin.getdata(now.crop(box), box[:2], duration=10 * duration, disposal=1)]
    )


def _gif_frames(film: Animation, delay: int) -> Iterator[tuple[int, int]]:
    """(key, hundredths of a second), with equal neighbours in one as far as one frame can last."""
    current, duration = film.keys[0], 0
    for index, key in enumerate(film.keys):
        longer = delay * (1 + _LAST_FRAME_HOLD if index == len(film) - 1 else 1)
        if key != current or duration + longer > _LONGEST_GIF_FRAME:
            yield current, duration
            current, duration = key, 0
        duration += longer
    yield current, duration


def encode_apng(film: Animation, fps: int) -> bytes:
    """Encode an endless animated PNG of `fps` pictures per second."""
    check_size(film, ["apng"])
    duration = 1000 / fps
    durations = [duration] * (len(film) - 1) + [duration * (1 + _LAST_FRAME_HOLD)]
    first, *others = [film.draw(key) for key in film.keys]
    buffer = io.BytesIO()
    first.save(buffer, "PNG", save_all=True, append_images=others, duration=durations, loop=0)
    return buffer.getvalue()


def save_mp4(film: Animation, path: Path, fps: int) -> None:
    """Write an H.264 video. An odd width or height is padded by repeating the last row or column."""
    require_video()
    check_size(film, ["mp4"])
    import av

    width, height = (side + side % 2 for side in film.size)
    with replacing(path) as part, av.open(str(part), "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=fps)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        for key in [*film.keys, *[film.keys[-1]] * _LAST_FRAME_HOLD]:
            frame = np.asarray(film.draw(key).convert("RGB"))
            padding = ((0, height - frame.shape[0]), (0, width - frame.shape[1]), (0, 0))
            picture = av.VideoFrame.from_ndarray(np.pad(frame, padding, mode="edge"), format="rgb24")
            container.mux(stream.encode(picture))
        container.mux(stream.encode())


def check_size(film: Animation, formats: Collection[str]) -> None:
    """Refuse an animation that is too large for one of the formats. PNG and GIF take any."""
    width, height = film.size
    if "apng" in formats and len(film) * width * height > MOST_APNG_PIXELS:
        raise InputError(
            f"apng: {len(film)} pictures of {width} x {height} pixels are too many for one file; "
            "take smaller cells, fewer episodes, or gif"
        )
    if "mp4" in formats and width * height > MOST_MP4_PIXELS:
        raise InputError(
            f"mp4: {width} x {height} pixels are too many for a video; take smaller cells, or gif"
        )


def require_video() -> None:
    """Check that PyAV is installed."""
    if find_spec("av") is None:
        raise InputError(f"mp4: needs PyAV, which is not installed; {install_command('video')} (or av)")


def save_animation(film: Animation, path: Path, fps: int) -> None:
    """Write GIF, APNG or MP4, chosen by the path's suffix."""
    if path.suffix == ".mp4":
        save_mp4(film, path, fps)
        return
    encode = {".gif": encode_gif, ".apng": encode_apng}[path.suffix]
    write_bytes(path, encode(film, fps))
