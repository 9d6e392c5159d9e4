"""Pictures out of a run's folder, small enough and safe to stand in a page."""

from __future__ import annotations

import base64
import io
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from PIL import Image

from gridworld.config.pictures import PICTURES
from gridworld.report.analysis.analyse import Result
from gridworld.report.evidence.run_reader import Evidence
from gridworld.report.table import number
from gridworld.storage.safe_read import read_bytes, sha256

_LARGEST_PNG = 4 * 2**20  # bytes
_LARGEST_GIF = 256 * 2**10  # bytes; it stands in the page as it is
_MOST_PIXELS = 4_000_000
_WIDTH = 960  # pixels, where it is shown large


@dataclass(frozen=True)
class Picture:
    """An image as a data URI."""

    uri: str
    width: int
    height: int
    caption: str


def pictures(result: Result) -> Iterator[Picture]:
    """The pictures of the run with the median regret, if they are there, unchanged and not too large."""
    run = _shown(result)
    verdict = "certified optimal" if run.certified else f"regret {number(run.regret)}"
    for drawn in PICTURES:
        name = drawn.file
        if drawn.caption is None:
            continue
        embedded = embed(run.folder / name, run.pictures[name]) if name in run.pictures else None
        if embedded is not None:
            yield Picture(*embedded, f"{result.group.agent}, seed {run.seed}, {verdict}: {drawn.caption}")


def _shown(result: Result) -> Evidence:
    """The run with the median regret."""
    ranked = sorted(result.group.runs, key=lambda run: (run.regret, run.seed))
    return ranked[(len(ranked) - 1) // 2]


def _most(name: str) -> int:
    return _LARGEST_GIF if name.endswith(".gif") else _LARGEST_PNG


def embed(path: Path, digest: str | None = None) -> tuple[str, int, int] | None:
    """Read a PNG or GIF to stand in a page.

    Args:
        path: of the file; its suffix says which it is.
        digest: the file's SHA-256; None accepts any.

    Returns:
        Data URI, width and height in pixels; None where the file is missing, another, damaged or too large.
    """
    animated = path.suffix == ".gif"
    try:
        content = read_bytes(path, _most(path.name))
        if digest not in (None, sha256(content)):
            return None
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
    small.save(buffer, format="PNG")  # the highest compression takes four times as long for 6 %
    return _uri("png", buffer.getvalue()), small.width, small.height


def _uri(kind: str, content: bytes) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(content).decode('ascii')}"
