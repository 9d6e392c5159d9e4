"""Text on pygame's surfaces. pygame is imported when the first text is measured or written."""

from __future__ import annotations

import functools
import os
import sys
from types import ModuleType
from typing import Any

Colour = tuple[int, int, int]

INK: Colour = (0, 0, 0)
SMALLEST_TEXT = 10  # pixels

_GREYS = 17  # steps between ink and paper at the edge of a letter

_fonts: dict[int, Any] = {}  # a font draws its letters once, and takes its time over it


@functools.cache  # it is asked for by every line of a picture
def import_pygame() -> ModuleType:
    """pygame, without its greeting, and without `pkg_resources`, which takes longest to import."""
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    hidden = {"pygame", "pkg_resources"}.isdisjoint(sys.modules)
    if hidden:
        sys.modules["pkg_resources"] = None  # type: ignore[assignment]
    try:
        import pygame
    finally:
        if hidden:
            del sys.modules["pkg_resources"]
    return pygame


def font(size: int) -> Any:
    """pygame's font of a size in pixels."""
    pygame = import_pygame()
    if not (_fonts and pygame.font.get_init()):
        _fonts.clear()
        pygame.font.init()
        pygame.register_quit(_fonts.clear)  # they end with pygame
    if size not in _fonts:
        _fonts[size] = pygame.font.Font(None, round(1.2 * size))
    return _fonts[size]


@functools.lru_cache(maxsize=1 << 12)
def text_width(text: str, size: int) -> int:
    """The width of a text in pixels."""
    return int(font(size).size(text)[0])


def text_size(text: str, size: int, room: float) -> int | None:
    """The size, at most `size`, at which a text is at most `room` pixels wide; None: too small to read."""
    if size < SMALLEST_TEXT:
        return None
    fitting = int(size * min(1.0, room / max(1, text_width(text, size))))
    return fitting if fitting >= SMALLEST_TEXT else None


def write(surface: Any, text: str, left: int, middle: int, size: int) -> int:
    """Write a text on paper, in few greys for the palettes of animations; where it ends, in pixels."""
    image = _in_greys(text, size)
    surface.blit(image, (left, middle - image.get_height() // 2))
    return left + int(image.get_width())


@functools.lru_cache(maxsize=1 << 7)  # captions and legends of a run's pictures have many words in common
def _in_greys(text: str, size: int) -> Any:
    image = font(size).render(text, True, INK)
    alpha = import_pygame().surfarray.pixels_alpha(image)
    step = 255 // (_GREYS - 1)
    alpha[...] = alpha // step * step
    del alpha  # unlocks the image
    return image
