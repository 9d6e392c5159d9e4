"""Pictures as files: PNG, GIF, animated PNG (APNG), and MP4, which needs PyAV and alone is not exact."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Callable, Collection, Iterator
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import GifImagePlugin, ImageChops

from gridworld.base.atomic_write import replacing, replacing_folder, write_bytes
from gridworld.base.errors import InputError, install_command
from gridworld.envs.rendering import Frame
from gridworld.visualization.animation import Animation

FORMATS = ("png", "gif", "apng", "mp4")
MOST_APNG_PIXELS = 500_000_000  # of all pictures together, which Pillow holds in memory, a byte each
MOST_MP4_PIXELS = 4096 * 2304  # of a picture: level 5.2 of H.264, which is as far as most players go

_UP = 2  # number of a PNG filter: the difference from the row above
_LAST_FRAME_HOLD = 4  # frames; the last one is shown for so many more before the animation starts again
_LONGEST_GIF_FRAME = 0xFFFF  # hundredths of a second


def save(drawn: Frame | Animation, path: Path, fps: int) -> None:
    """Write a picture as its path's ending says, or numbered PNGs."""
    if not isinstance(drawn, Animation):
        write_bytes(path, encode_png(drawn))
    elif not path.suffix:
        save_pngs(drawn, path)
    elif path.suffix == ".mp4":
        _save_mp4(drawn, path, fps)
    else:
        write_bytes(path, encode_gif(drawn, fps) if path.suffix == ".gif" else encode_apng(drawn, fps))


def encode_png(pixels: NDArray[np.uint8], palette: bytes = b"") -> bytes:
    """Encode (height, width, 3), RGB, or 4, RGBA, or (height, width), numbers into a palette, without loss.

    In pictures of a grid most rows equal the row above. Pillow tries five filters on each row; this one
    compresses as well in less than half the time. References: W3C, PNG Specification, 2003.
    """
    height, width, *channels = pixels.shape
    kind = {(): 3, (3,): 2, (4,): 6}[tuple(channels)]
    pixels = pixels.reshape(height, -1)
    rows = np.empty((height, 1 + pixels.shape[1]), dtype=np.uint8)
    rows[:, 0] = _UP
    rows[0, 1:] = pixels[0]
    np.subtract(pixels[1:], pixels[:-1], out=rows[1:, 1:])  # modulo 256
    packer = zlib.compressobj(1, strategy=zlib.Z_RLE if palette else zlib.Z_DEFAULT_STRATEGY)
    chunks = {
        b"IHDR": struct.pack(">IIBBBBB", width, height, 8, kind, 0, 0, 0),
        **({b"PLTE": palette} if palette else {}),
        b"IDAT": packer.compress(rows.data) + packer.flush(),
        b"IEND": b"",
    }
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        for name, data in chunks.items()
    )


def save_pngs(film: Animation, folder: Path) -> None:
    """Write 0000.png, 0001.png, ... into `folder`, which is replaced as a whole, also where it is a link."""

    def encode(key: int) -> bytes:
        picture = film.draw(key)
        return encode_png(np.asarray(picture), bytes(picture.getpalette("RGB") or []))

    digits = max(4, len(str(len(film) - 1)))
    with replacing_folder(folder) as part:
        for index, key in enumerate(film.keys):
            (part / f"{index:0{digits}}.png").write_bytes(_encoded(film, encode, key))


def _encoded(film: Animation, encode: Callable[..., bytes], *keys: int | None) -> bytes:
    """Call `encode` unless the film, or another one in the same world, has this part already."""
    place = encode.__name__, *keys
    if place not in film.encoded:
        film.encoded[place] = encode(*keys)
    return film.encoded[place]


def encode_gif(film: Animation, fps: int) -> bytes:
    """Encode an endless GIF, of each picture the box that changed; `fps` is rounded to 1/100 s.

    Pillow's `save_all` would hold all pictures in memory, write the palette again with each, and fail where
    one is shown for longer than GIF can say.
    """

    def encode_part(before: int | None, key: int, duration: int) -> bytes:
        now, header = film.draw(key), []
        if before is None:
            header = GifImagePlugin.getheader(now, info={"loop": 0})[0]
            box = (0, 0, *now.size)
        else:
            box = ImageChops.subtract_modulo(now, film.draw(before)).getbbox() or (0, 0, 1, 1)
        # milliseconds; disposal 1: the next picture is drawn over this one
        data = GifImagePlugin.getdata(now.crop(box), box[:2], duration=10 * duration, disposal=1)
        return b"".join([*header, *data])

    parts: list[bytes] = []
    before: int | None = None
    for key, duration in _gif_frames(film, round(100 / fps)):
        parts.append(_encoded(film, encode_part, before, key, duration))
        before = key
    return b"".join([*parts, b";"])


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
    first, *others = [film.draw(key) for key in film.keys]
    durations = [1000 / fps] * len(others) + [(1 + _LAST_FRAME_HOLD) * 1000 / fps]
    buffer = io.BytesIO()
    first.save(buffer, "PNG", save_all=True, append_images=others, duration=durations, loop=0)
    return buffer.getvalue()


def _save_mp4(film: Animation, path: Path, fps: int) -> None:
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
            f"apng: {len(film)} pictures of {width} x {height} pixels are too many for one file; use "
            "smaller cells, fewer episodes, or gif"
        )
    if "mp4" in formats and width * height > MOST_MP4_PIXELS:
        raise InputError(
            f"mp4: {width} x {height} pixels are too many for a video; use smaller cells, or gif"
        )


def require_video() -> None:
    """Check that PyAV is installed."""
    if find_spec("av") is None:
        raise InputError(f"mp4: needs PyAV, which is not installed; {install_command('video')} (or av)")
