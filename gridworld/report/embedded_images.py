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
from gridworld.report.analysis.analyse import Result, TaskAnalysis
from gridworld.report.table import number
from gridworld.storage.safe_read import read_bytes, sha256

_LARGEST = {".png": 4 * 2**20, ".gif": 256 * 2**10}  # bytes; an animation stands in the page as it is
_MOST_PIXELS = 4_000_000
_WIDTH = 960  # pixels, where it is shown large


@dataclass(frozen=True)
class Picture:
    """An image as a data URI."""

    uri: str
    width: int
    height: int
    caption: str


def galleries(task: TaskAnalysis) -> list[list[Picture]]:
    """The pictures of each agent that has any, the best one first."""
    return [found for result in task.ranked if (found := list(_pictures(result)))]


def _pictures(result: Result) -> Iterator[Picture]:
    """Those of the run with the median regret that are there, unchanged and not too large."""
    ranked = sorted(result.group.runs, key=lambda run: (run.regret, run.seed))
    run = ranked[(len(ranked) - 1) // 2]
    verdict = "certified optimal" if run.certified else f"regret {number(run.regret)}"
    for picture in PICTURES:
        if picture.caption is None or picture.file not in run.pictures:
            continue
        if (found := _embedded(run.folder / picture.file, run.pictures[picture.file])) is not None:
            yield Picture(*found, f"{result.group.agent}, seed {run.seed}, {verdict}: {picture.caption}")


def _embedded(path: Path, digest: str | None) -> tuple[str, int, int] | None:
    """Data URI, width and height of a PNG or GIF.

    None where it is missing, damaged, too large, or has another SHA-256 than `digest`, of which None is any.
    """
    kind = path.suffix[1:]
    try:
        content = read_bytes(path, _LARGEST[path.suffix])
        if digest not in (None, sha256(content)):
            return None
        with Image.open(io.BytesIO(content), formats=[kind.upper()]) as image:
            if image.width * image.height > _MOST_PIXELS:
                return None
            width, height = image.size
            if kind == "png":
                small = image.convert("RGB")
                small.thumbnail((_WIDTH, 2 * _WIDTH), Image.Resampling.LANCZOS)
                buffer = io.BytesIO()
                small.save(buffer, format="PNG")  # the highest compression takes four times as long for 6 %
                content, (width, height) = buffer.getvalue(), small.size
    # What Pillow raises for a damaged one; ValueError is ours, too.
    except (OSError, ValueError, SyntaxError, EOFError, struct.error, Image.DecompressionBombError):
        return None
    return f"data:image/{kind};base64,{base64.b64encode(content).decode('ascii')}", width, height
