"""Pictures out of a run's folder, small enough and safe to stand in a page."""

from __future__ import annotations

import base64
import io
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from PIL import Image

from gridworld.data_files import read_bytes
from gridworld.report.analysis import Result
from gridworld.report.table import number

# What a run may hold, and how a page's reader is told what it is.
_PICTURES = (
    ("policy.png", "policy"),
    ("q_error.png", "error of its values"),
    ("visits.png", "visits while it learnt"),
    ("learning.gif", "policy while it learnt"),
)
_LARGEST_PNG = 4 * 2**20  # bytes
_LARGEST_GIF = 256 * 2**10  # bytes; it stands in the page as it is
_MOST_PIXELS = 4_000_000
_WIDTH = 480  # pixels


@dataclass(frozen=True)
class Picture:
    """An image as a data URI."""

    uri: str
    width: int
    height: int
    caption: str


def pictures(result: Result) -> Iterator[Picture]:
    """Those of the run with the median regret, of what there is."""
    ranked = sorted(result.group.runs, key=lambda run: (run.regret, run.seed))
    run = ranked[(len(ranked) - 1) // 2]
    verdict = "certified optimal" if run.certified else f"regret {number(run.regret)}"
    for name, told in _PICTURES:
        embedded = embed(run.folder / name)
        if embedded is not None:
            yield Picture(*embedded, f"{result.group.agent}, seed {run.seed}, {verdict}: {told}")


def embed(path: Path) -> tuple[str, int, int] | None:
    """Data URI, width and height of a PNG or GIF; None where there is none, or a damaged or huge one."""
    animated = path.suffix == ".gif"
    try:
        content = read_bytes(path, _LARGEST_GIF if animated else _LARGEST_PNG)
        with Image.open(io.BytesIO(content), formats=["GIF" if animated else "PNG"]) as image:
            if image.width * image.height > _MOST_PIXELS:
                return None
            if animated:
                return _uri("gif", content), image.width, image.height
            small = image.convert("RGB")
    # What Pillow raises for a damaged one; ValueError is ours, too.
    except (OSError, ValueError, SyntaxError, EOFError, struct.error, Image.DecompressionBombError):
        return None
    small.thumbnail((_WIDTH, 2 * _WIDTH), Image.Resampling.LANCZOS)
    buffer = io.BytesIO()
    small.quantize(128, dither=Image.Dither.NONE).save(buffer, format="PNG", optimize=True)
    return _uri("png", buffer.getvalue()), small.width, small.height


def _uri(kind: str, content: bytes) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(content).decode('ascii')}"
